"""A Go1 that hangs in a stand, its trunk held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from go1exp import robot
from go1exp.audit import AuditReport
from go1exp.drive import DriveSetup
from go1exp.effects.tolerances import DECLARED, Tolerances
from go1exp.env.plant import drive_setup
from go1exp.gap.data.cutting import cut
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.machine import NEEDLESS, pd
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.go1_logs import go1_flaws
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.robots.standing import ONE_GROUP, StandingGo1
from go1exp.physics.mujoco_cpu import MujocoCpu
from go1exp.physics.scene import build_model
from go1exp.recording import Recording
from go1exp.robot import RobotConfig
from go1exp.schema.registry import Term
from go1exp.tensors.randomness import EnvRandom
from go1exp.terrain import TerrainConfig, build_terrain

LEGS = tuple(tuple(range(3 * leg, 3 * leg + 3)) for leg in range(robot.NUM_LEGS))


@dataclass(frozen=True)
class HungGo1:
    """A Go1 whose trunk is held, so that its legs do not feel each other.

    Attributes:
        config: of the robot.
        joints: names.
        groups: the legs.
        base_probe: none, as the trunk is held.
        tolerances: of nominal parameters.
    """

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = LEGS
    base_probe: tuple[float, ...] = ()
    tolerances: Tolerances = DECLARED

    @property
    def effort(self) -> tuple[float, ...]:
        """Peak torque (J,), N m."""
        return tuple(float(v) for v in robot.per_joint(self.config.effort_limit))

    def build(self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int) -> tuple[Any, DriveSetup]:
        """Return a backend with ``num`` held robots, and their drives."""
        w, x, y, z = base_quat
        ground = build_terrain(TerrainConfig(kind="flat"))
        model, blocks = build_model(self.config, ground, physics_dt, held=(w, x, y, z))
        model.opt.disableflags |= NEEDLESS
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, drive_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))

    def drive(self) -> Term:
        """Return the ideal PD law."""
        return pd()

    def suited(self, recordings: Sequence[Recording]) -> Robot:
        """Return the Go1 on its feet if it is so in one of the recordings, else this one."""
        if not any(r.meta.base == "floating" for r in recordings):
            return self
        return StandingGo1(self.config, replace(self, groups=ONE_GROUP), tolerances=self.tolerances)

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared, a line each."""
        return go1_flaws(recording, report, self.joints, free=False)

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are."""
        return Ready(tuple(recordings), settings)

    def windows(self, ready: Ready) -> Windows:
        """Cut recordings into windows."""
        return cut(ready.recordings, ready.settings)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows of a held trunk."""
        return Replayer(self, windows, quats, max_rows, threads)


def hung(config: RobotConfig, tolerances: Tolerances = DECLARED) -> Robot:
    """Return a Go1 whose trunk is held."""
    return HungGo1(config, tolerances=tolerances)
