"""Robots that the gap workflow can replay: the hung Go1, and any chain of hinges on a fixed base from a config."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import go1exp.actuator
import go1exp.effects  # noqa: F401  (registers every effect)
from go1exp import robot
from go1exp.drive import DriveSetup
from go1exp.effects.tolerances import DECLARED, Tolerances
from go1exp.env.plant import drive_setup
from go1exp.gap.replay.machine import Machine
from go1exp.physics.mujoco_cpu import MujocoCpu
from go1exp.physics.scene import build_model
from go1exp.robot import RobotConfig
from go1exp.tensors.randomness import EnvRandom
from go1exp.terrain import TerrainConfig, build_terrain

NEEDLESS = 1 << 4 | 1 << 13
"""MuJoCo's flags (mjDSBL_CONTACT, mjDSBL_SENSOR) for what a robot in the air does not need; half of the step's time."""


@dataclass(frozen=True)
class HungGo1:
    """A Go1 whose trunk is held, so that its legs do not feel each other."""

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = tuple(tuple(range(3 * leg, 3 * leg + 3)) for leg in range(robot.NUM_LEGS))
    base_probe: tuple[float, ...] = ()
    tolerances: Tolerances = DECLARED

    def build(self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int) -> tuple[Any, DriveSetup]:
        """Return a backend with ``num`` held robots, and their drives."""
        w, x, y, z = base_quat
        ground = build_terrain(TerrainConfig(kind="flat"))
        model, blocks = build_model(self.config, ground, physics_dt, held=(w, x, y, z))
        model.opt.disableflags |= NEEDLESS
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, drive_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))


def hung(config: RobotConfig, tolerances: Tolerances = DECLARED) -> Machine:
    """Return a Go1 whose trunk is held."""
    return HungGo1(config, tolerances=tolerances)
