"""A Go1 that hangs in a stand, its trunk held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import ContactConfig
from go1exp.gap.data.contact import contact_of
from go1exp.gap.data.cutting import cut
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.result import GapSettings, Phase
from go1exp.gap.robots.go1 import Go1
from go1exp.gap.robots.go1_logs import ONE_GROUP
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.robots.standing import StandingGo1
from go1exp.gap.robots.swinging import SwingingGo1
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import DECLARED, Tolerances
from go1exp.sim.env.plant import actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import build_model

LEGS = tuple(tuple(range(3 * leg, 3 * leg + 3)) for leg in range(robot.NUM_LEGS))


@dataclass(frozen=True)
class HungGo1(Go1):
    """A Go1 whose trunk is held, so that its legs do not feel each other.

    Attributes:
        config: of the robot.
        joints: names.
        groups: the legs.
        base_probe: none, as the trunk is held.
        on_ground: no.
        tolerances: of nominal parameters.
        contact: of its feet where a recording shows it on them; None takes the one that recordings name.
        free_trunk: no.
    """

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = LEGS
    base_probe: tuple[float, ...] = ()
    on_ground: bool = False
    tolerances: Tolerances = DECLARED
    contact: ContactConfig | None = None
    free_trunk: ClassVar[bool] = False

    @property
    def top_speed(self) -> tuple[float, ...]:
        """Speed without load (J,), rad/s."""
        return tuple(float(v) for v in robot.per_joint(self.config.velocity_limit))

    @property
    def angle_range(self) -> np.ndarray:
        """Lowest and highest angle (J, 2), rad."""
        return robot.JOINT_POS_LIMITS.copy()

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[Any, ActuatorSetup]:
        """Return a backend with ``num`` held robots, and their drives."""
        w, x, y, z = base_quat
        model, blocks = build_model(self.config, None, physics_dt, held=(w, x, y, z), mounted=mounted)
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, actuator_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> Robot:
        """Return the Go1 on its feet, or its legs in the air, if its trunk is free in a recording, else this one.

        Raises:
            ConfigError: for one on its feet, if recordings name different contacts and none was chosen.
        """
        if not any(r.meta.base == "floating" for r in recordings):
            return self
        if phase == "swing":
            return SwingingGo1(self.config, tolerances=self.tolerances)
        contact = contact_of(recordings, self.contact)
        held, known = replace(self, groups=ONE_GROUP), self.tolerances.on(contact)
        return StandingGo1(self.config, held, tolerances=known, contact=contact)

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are."""
        return Ready(tuple(recordings), settings)

    def windows(self, ready: Ready) -> Windows:
        """Cut recordings into windows."""
        return cut(ready.recordings, ready.settings)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows of a held trunk."""
        return Replayer(self, windows, quats, max_rows, threads)


def hung(config: RobotConfig, tolerances: Tolerances = DECLARED, contact: ContactConfig | None = None) -> Robot:
    """Return a Go1 whose trunk is held; on its feet it has ``contact``, or the one that recordings name."""
    return HungGo1(config, tolerances=tolerances, contact=contact)
