"""``actuator=delay``: any actuator, with delayed commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from go1exp.base.tensors.memory import CommandLine
from go1exp.config.schema.registry import actuator, bind, members, ordered
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.motors import Actuator, takes_feedforward

if TYPE_CHECKING:
    from torch import Tensor


def _checked(settings: dict[str, Any]) -> dict[str, Any]:
    """Check the term in ``settings`` as the registry does; return it with its defaults filled in."""
    if "term" not in settings:
        problems = ["drive.term: required, but not given"]
    else:
        term, problems = bind("actuator", str(settings["term"]), settings, "drive")
        if term is not None:
            return {"term": term.entry.name, **term.parameters}
    raise PydanticCustomError("problems", "{lines}", {"lines": "\n".join(problems)})


InnerActuator = Annotated[dict[str, Any], AfterValidator(_checked)]
"""``{term: pd, kp: 20.0, ...}``: type of a parameter called ``drive``."""


def build(setup: ActuatorSetup, drive: dict[str, Any]) -> Actuator:
    """Return the actuator that ``drive`` describes."""
    parameters = {k: v for k, v in drive.items() if k != "term"}
    return members("actuator")[drive["term"]].target(setup, **parameters)


Seconds = Annotated[float, Field(ge=0.0, le=0.2)]
Delays = Annotated[tuple[Seconds, Seconds], AfterValidator(ordered)]
"""``[shortest, longest]``, s."""


@actuator("delay")
class Delay:
    """Another actuator, whose command is delayed by a time that each robot draws anew for each episode.

    tau(t) = actuator(target(t - delay), q(t), qd(t)): computer and bus delay the command, and the motor controller's
    own feedback is not delayed. Between two physics steps the target is interpolated. The default goes from none to
    what the actuator net of walk-these-ways has learnt from a Go1: a command delay of 20 ms.

    Attributes:
        drive: the actuator inside.
        delay: (N, 1) each robot's delay, s; the shortest before the first reset.
    """

    def __init__(self, setup: ActuatorSetup, *, command: Delays = (0.0, 0.02), drive: InnerActuator) -> None:
        """Wrap ``drive``; ``command`` is the range that delays are drawn from, s."""
        self.drive: Actuator = build(setup, drive)
        self.delay = setup.zeros()[:, :1] + command[0]
        self._range: tuple[float, float] | Tensor = command
        self._random = setup.random
        joints = len(setup.joints)
        self._line = CommandLine(setup.num_envs, joints, command[1], setup.physics_dt, setup.dtype, setup.device)

    @property
    def kp(self) -> Tensor:
        """Position gain (N, J) of the actuator inside, live, N m/rad; AttributeError if it has none."""
        return self.drive.kp  # type: ignore[attr-defined]

    @property
    def kd(self) -> Tensor:
        """Velocity gain (N, J) of the actuator inside, live, N m s/rad; AttributeError if it has none."""
        return self.drive.kd  # type: ignore[attr-defined]

    def set_range(self, shortest: float, longest: float) -> None:
        """Draw delays from another range, s, within that of ``command``; from each robot's next episode on.

        In place from the second call on: the first one comes before a step is captured.
        """
        if isinstance(self._range, tuple):
            self._range = torch.zeros(2, dtype=self.delay.dtype, device=self.delay.device)
        for bound, value in zip(self._range, (shortest, longest), strict=True):
            bound.fill_(value)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; ``feedforward`` is delayed too."""
        steps = self._line.steps(self.delay)
        delayed = self._line.at(target, steps)
        if feedforward is None:
            return self.drive.torque(delayed, q, qd)
        assert takes_feedforward(self.drive)  # the plant has asked
        return self.drive.torque(delayed, q, qd, self._line.fed(feedforward, steps))

    def reset(self, mask: Tensor) -> None:
        """Draw new delays in the rows of ``mask`` (N,) and take the next target for one long in force."""
        low, high = self._range
        drawn = self._random.stream("actuator.delay").uniform(1, low=low, high=high).to(self.delay.dtype)
        self.delay.copy_(torch.where(mask.unsqueeze(1), drawn.clamp(low, high), self.delay))
        self._line.reset(mask)
        self.drive.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return the delays, the targets on their way and the history of the actuator inside."""
        return {"delay": self.delay.clone(), "line": self._line.state_dict(), "drive": self.drive.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, in place."""
        self.delay.copy_(state["delay"])
        self._line.load_state_dict(state["line"])
        self.drive.load_state_dict(state["drive"])
