"""``effect=torque_delay``: the motor's torque comes late."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.delayed import Delayed
from go1exp.sim.effects.identification import SHARP_EDGES, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("torque_delay")
class TorqueDelay(Delayed):
    """The motor makes the torque that the drive asked for a while ago: tau(t) = demand(t - delay).

    Feedback is late too, unlike with ``command_delay``, so that a joint rings: the delay acts like a kd that is smaller
    by kp delay. Loops that run over the bus have 1 to 8 ms (a judgement). To first order the same as ``lag``; sharp
    command edges tell them apart.
    """

    title = "a delay of torque"
    params = (Param("delay", "s", 0.0, 0.02, 0.0, 0.001, "joint", "age of the torque"),)
    identification = Identification(
        nominal=True,
        rank=11,
        excitation="steps",
        confounded=("lag",),
        told_apart_by=SHARP_EDGES,
    )
    order = 30

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque asked for ``delay`` ago."""
        return self.late(torque)
