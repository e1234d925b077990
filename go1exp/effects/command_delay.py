"""``effect=command_delay``: targets take force late."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.effects.base import Param
from go1exp.effects.delayed import Delayed
from go1exp.effects.identification import Identification
from go1exp.schema.registry import effect

if TYPE_CHECKING:
    from torch import Tensor


@effect("command_delay")
class CommandDelay(Delayed):
    """The drive acts on the target of a while ago: target(t - delay); its own feedback is not delayed.

    Computer, bus and motor controller take their time: 2 to 40 ms on robots of this class (a judgement). The published
    Go1 actuator net acts one policy step (20 ms) late. A log whose commands and states have clocks of their own shows a
    shift between them as a delay; in a narrow band so do ``kp_scale`` and armature.
    """

    title = "a delay of commands"
    params = (Param("delay", "s", 0.0, 0.06, 0.0, 0.001, "joint", "age of the target"),)
    identification = Identification(
        nominal=True,
        rank=10,
        levels=({"delay": 0.01},),
        excitation="steps",
    )

    def on_target(self, target: Tensor) -> Tensor:
        """Return the target of ``delay`` ago."""
        return self.late(target)
