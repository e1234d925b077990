"""What the effects that let a signal through late have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from go1exp.base.tensors.memory import DelayLine
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Effect

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.config.schema.joint_values import JointValues


class Delayed(Effect):
    """Base of effects with a parameter ``delay`` in s, up to that parameter's upper bound."""

    delay: Tensor

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Allocate the past."""
        super().__init__(setup, **values)
        (longest,) = (p.high for p in self.params if p.name == "delay")
        self._line = DelayLine(setup.num_envs, len(setup.joints), longest, setup.physics_dt, setup.dtype, setup.device)
        self._steps = self._line.steps(self.delay)

    def prepare(self) -> None:
        """Work out how many samples ago the delays are."""
        self._steps.copy_(self._line.steps(self.delay))

    def late(self, signal: Tensor) -> Tensor:
        """Take the newest ``signal`` (N, J) and return that of ``delay`` ago; once a step."""
        return self._line.at(signal, self._steps)

    def reset(self, mask: Tensor) -> None:
        """Let the next signal stand for the whole past in the rows of ``mask`` (N,)."""
        self._line.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the values and the past."""
        return {**super().state_dict(), **self._line.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Write values and past back, in place."""
        super().load_state_dict(state)
        self._line.load_state_dict(state)
