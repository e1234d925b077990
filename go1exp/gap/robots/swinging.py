"""A walking Go1 of which the legs in swing are compared: its trunk moves as the IMU says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.swings import SwingWindows, cut_swings, for_swings
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.swinging import HEAVY, SwingReplayer
from go1exp.gap.result import GapSettings, Phase
from go1exp.gap.robots.go1 import Go1
from go1exp.gap.robots.go1_logs import ONE_GROUP
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import DECLARED, Tolerances
from go1exp.sim.env.plant import actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import build_model, weigh_down

IMU_PROBE = (0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.0005)
"""Errors of accelerometer, m/s2, gyro, rad/s, and delay, s, by which the influence of the IMU is measured."""


@dataclass(frozen=True)
class SwingingGo1(Go1):
    """A Go1 that walks, of which the legs in the air are compared.

    Attributes:
        config: of the robot.
        joints: names.
        groups: all joints in one, since which legs swing changes from window to window.
        base_probe: errors of the IMU.
        on_ground: no: what acts on the trunk or on feet is not felt.
        tolerances: of nominal parameters.
        free_trunk: yes.
    """

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = ONE_GROUP
    base_probe: tuple[float, ...] = IMU_PROBE
    on_ground: bool = False
    tolerances: Tolerances = DECLARED
    free_trunk: ClassVar[bool] = True

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[Any, ActuatorSetup]:
        """Return a backend with ``num`` robots in the air on heavy trunks, and their drives."""
        model, blocks = build_model(self.config, None, physics_dt)
        weigh_down(model, HEAVY)
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, actuator_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))

    def suited(self, recordings: Sequence[Recording], phase: Phase = "swing") -> SwingingGo1:
        """Return itself."""
        return self

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are, with windows that suit swings."""
        return Ready(tuple(recordings), for_swings(settings))

    def windows(self, ready: Ready) -> SwingWindows:
        """Cut recordings into windows of legs in the air."""
        return cut_swings(ready.recordings, ready.settings, self.config)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows of legs in the air."""
        return SwingReplayer(self, cast(SwingWindows, windows), quats, max_rows, threads)
