"""A Go1 on its feet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from go1exp import robot
from go1exp.drive import DriveSetup
from go1exp.effects.tolerances import DECLARED, Tolerances
from go1exp.env.plant import drive_setup
from go1exp.gap.replay.machine import Machine
from go1exp.gap.robots.hung import HungGo1
from go1exp.physics.mujoco_cpu import MujocoCpu
from go1exp.physics.scene import build_model
from go1exp.recording import Recording
from go1exp.robot import RobotConfig
from go1exp.tensors.randomness import EnvRandom
from go1exp.terrain import TerrainConfig, build_terrain

NO_SENSORS = 1 << 13
"""MuJoCo's mjDSBL_SENSOR: the IMU's readings follow from the motion of the base, and those of contacts cost time."""

BASE_PROBE = (5.0e-4, 1.0e-3, 1.0e-3, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""Changes by which their influence is measured."""


@dataclass(frozen=True)
class StandingGo1:
    """A Go1 that stands or moves on flat ground, its trunk free."""

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = (tuple(range(robot.NUM_JOINTS)),)
    base_probe: tuple[float, ...] = BASE_PROBE
    tolerances: Tolerances = DECLARED

    def build(self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int) -> tuple[Any, DriveSetup]:
        """Return a backend with ``num`` free robots, and their drives; ``base_quat`` says nothing here."""
        model, blocks = build_model(self.config, build_terrain(TerrainConfig(kind="flat")), physics_dt)
        model.opt.disableflags |= NO_SENSORS
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, drive_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))


def on_feet(machine: Machine, recordings: Sequence[Recording]) -> Machine:
    """Return the Go1 on its feet in the place of the hung one if it is in one of the recordings."""
    standing = any(r.meta.base == "floating" for r in recordings)
    if not standing or not isinstance(machine, HungGo1):
        return machine
    return StandingGo1(machine.config, tolerances=machine.tolerances)
