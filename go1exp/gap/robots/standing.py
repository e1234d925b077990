"""A Go1 on its feet, its trunk free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.gap.data.contact import contact_warnings
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.standing import StandingWindows, cut_standing, for_feet
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.machine import Machine
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.standing import StandingReplayer
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
from go1exp.sim.physics.scene import build_model
from go1exp.sim.terrain import TerrainConfig, build_terrain

NO_SENSORS = 1 << 13
"""MuJoCo's mjDSBL_SENSOR: the IMU's readings follow from the motion of the base, and those of contacts cost time."""

BASE_PROBE = (5.0e-4, 1.0e-3, 1.0e-3, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""Changes of a base's initial height, roll, pitch, velocity and rate by which their influence is measured."""


ON_MUJOCO = DECLARED.on(MUJOCO_CONTACT)


@dataclass(frozen=True)
class StandingGo1(Go1):
    """A Go1 that stands or moves on flat ground, its trunk free.

    Attributes:
        config: of the robot.
        held: the same robot with its trunk held, for recordings of it that were made so.
        joints: names.
        groups: all joints in one.
        base_probe: as for :class:`~go1exp.gap.replay.machine.Machine`.
        on_ground: yes.
        tolerances: of nominal parameters, about the values of this contact.
        contact: of the feet.
        free_trunk: yes.
    """

    config: RobotConfig
    held: Machine
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = ONE_GROUP
    base_probe: tuple[float, ...] = BASE_PROBE
    on_ground: bool = True
    tolerances: Tolerances = ON_MUJOCO
    contact: ContactConfig = MUJOCO_CONTACT
    free_trunk: ClassVar[bool] = True

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[Any, ActuatorSetup]:
        """Return a backend with ``num`` free robots, and their drives; ``base_quat`` is not used."""
        ground = build_terrain(TerrainConfig(kind="flat"))
        model, blocks = build_model(self.config, ground, physics_dt, contact=self.contact)
        model.opt.disableflags |= NO_SENSORS
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, actuator_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> StandingGo1:
        """Return itself: it can be compared with recordings of a held trunk too."""
        return self

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are, with windows that suit contact."""
        warnings = tuple(contact_warnings(recordings, self.contact))
        return Ready(tuple(recordings), for_feet(settings, recordings), warnings=warnings)

    def windows(self, ready: Ready) -> StandingWindows:
        """Cut recordings into windows that begin where at least two feet carry weight."""
        return cut_standing(ready.recordings, ready.settings, self.config)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows on the feet, and those of a held trunk among them."""
        standing = cast(StandingWindows, windows)  # that this robot cut
        return StandingReplayer(self, standing, quats, max_rows, threads, held=self.held)
