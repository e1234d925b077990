"""Whether the engine of an evaluation moves the robot of the model: checked before anything is judged on it."""

from __future__ import annotations

from go1exp.config.schema.backends import CpuBackend
from go1exp.sim.env.engine import make_backend
from go1exp.sim.physics.agreement import Check, require, robots_needed
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import TerrainConfig, build_terrain


def require_agreement(task: TaskConfig) -> list[Check]:
    """Compare the engine of a task with MuJoCo, in the air, and return the checks; none for MuJoCo itself.

    Takes a quarter of a second on one core for PhysX.

    Raises:
        go1exp.config.schema.registry.Expected: if it differs by more than the tolerances, or is not installed.
    """
    if isinstance(task.backend, CpuBackend):
        return []
    ground = build_terrain(TerrainConfig(kind="flat"))
    model, sensors = build_model(task.robot, ground, task.sim.physics_dt, contact=task.contact)
    mujoco, engine = (make_backend(b, model, sensors, robots_needed()) for b in (CpuBackend("cpu", 1), task.backend))
    return require(mujoco, engine, task.backend.name)
