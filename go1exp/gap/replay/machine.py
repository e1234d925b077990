"""What the gap workflow must know of a robot to replay it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import go1exp.sim.actuator
import go1exp.sim.effects  # noqa: F401  (registers every effect)
from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import Term, bind
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.tolerances import Tolerances


class Machine(Protocol):
    """A robot that can be replayed."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Joints that move together, equally many in each group; groups do not feel each other."""

    @property
    def base_probe(self) -> tuple[float, ...]:
        """Changes of a free base's initial state by which its influence is measured; empty for one that is held.

        Of a base that is moved as an IMU says, errors of that IMU.
        """

    @property
    def on_ground(self) -> bool:
        """Whether it stands on its feet, so that it feels what acts on its trunk and on the ground."""

    @property
    def effort(self) -> tuple[float, ...]:
        """Peak torque (J,), N m."""

    @property
    def tolerances(self) -> Tolerances:
        """How far the nominal parameters may be off."""

    def drive(self) -> Term:
        """Return what turns commands into torques."""

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[Any, ActuatorSetup]:
        """Return a backend with ``num`` robots, and their drives.

        Args:
            num: of the robots.
            physics_dt: step, s.
            base_quat: attitude of a held base, w-x-y-z.
            threads: of the engine.
            mounted: a held base has the joints of ``sim/physics/scene.py``; nothing to one that is free.
        """


def pd() -> Term:
    """Return the ideal PD law."""
    return _bound("pd", {})


def voltage(stall: JointValues | None) -> Term:
    """Return a motor at a voltage, whose line goes from ``stall``, N m, to the robot's top speed.

    None: from the robot's peak torque.
    """
    return _bound("voltage", {"stall": stall})


def _bound(actuator: str, settings: Mapping[str, Any]) -> Term:
    term = bind("actuator", actuator, settings, actuator)[0]
    assert term is not None
    return term
