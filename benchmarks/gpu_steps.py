"""What options of the physics are worth on a GPU, and which errors they make: ``python -m benchmarks.gpu_steps``.

Rows change options of ``experiment=clock backend=warp`` (robots on flat ground, a PD law, random targets):

- ``steps/s``: policy steps of bare MuJoCo Warp, one CUDA graph each; ``over plain``: over the unchanged model's of the
  same round, median over rounds.
- ``angle_mrad``, ``height_mm``: what joint angles and the trunk's height are off after 0.1 s, root mean square over
  joints, median over robots that start from the same states under the same targets; ``p90``: their 90th percentile.
  The reference is MuJoCo in double precision with steps of 0.25 ms and no option changed.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.evaluate.bench.env import Measured, rates, ratio, speeds
from go1exp.evaluate.bench.gpu import bare_subject, gpu
from go1exp.sim.env.engine import make_backend
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, parse_train
from go1exp.sim.terrain import build_terrain

USAGE = "usage: python -m benchmarks.gpu_steps [num_envs=8192] [rounds=3] [seconds=3] [robots=256]"

Change = Callable[[mujoco.MjModel], object]
FINE = 0.00025  # s, physics step of the reference
POLICY_STEPS = 5  # over which errors grow, 0.1 s


def option(**values: object) -> Change:
    """Return what sets options of a model."""

    def change(model: mujoco.MjModel) -> None:
        for name, value in values.items():
            setattr(model.opt, name, value)

    return change


ROWS: Mapping[str, tuple[Change, tuple[str, ...]]] = {
    "plain": (option(), ()),
    "solver iterations 10": (option(iterations=10), ()),
    "solver iterations 4": (option(iterations=4), ()),
    "solver iterations 2": (option(iterations=2), ()),
    "line search 10": (option(ls_iterations=10), ()),
    "line search 4": (option(ls_iterations=4), ()),
    "tolerance 1e-5": (option(tolerance=1e-5), ()),
    "conjugate gradients": (option(solver=int(mujoco.mjtSolver.mjSOL_CG)), ()),
    "elliptic cone": (option(cone=int(mujoco.mjtCone.mjCONE_ELLIPTIC)), ()),
    "sparse Jacobian": (option(jacobian=int(mujoco.mjtJacobian.mjJAC_SPARSE)), ()),
    "dense Jacobian": (option(jacobian=int(mujoco.mjtJacobian.mjJAC_DENSE)), ()),
    "implicitfast": (option(integrator=int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)), ()),
    "32 contacts, 96 rows": (option(), ("backend.nconmax=32", "backend.njmax=96")),
    "steps of 4 ms": (option(), ("sim.physics_dt=0.004",)),
    "steps of 5 ms": (option(), ("sim.physics_dt=0.005",)),
    "4 ms, iterations 4, line search 10": (option(iterations=4, ls_iterations=10), ("sim.physics_dt=0.004",)),
}


def task_of(overrides: Sequence[str]) -> TaskConfig:
    """Return the task of a row."""
    return parse_train(compose("train", ["experiment=clock", "backend=warp", *overrides])).task


def moved(task: TaskConfig, robots: int, change: Change) -> NDArray[np.float64]:
    """Return the coordinates (N, 19) that robots reach from the same states under the same targets, m, 1 and rad."""
    model, sensors = build_model(task.robot, build_terrain(task.terrain), task.sim.physics_dt, contact=task.contact)
    change(model)
    backend = make_backend(task.backend, model, sensors, robots)
    rng = np.random.default_rng(0)
    stance = robot.NOMINAL_STANCE
    qpos = np.zeros((robots, 19))
    qpos[:, 2], qpos[:, 3] = robot.NOMINAL_HEIGHT, 1.0
    qpos[:, 7:] = stance + rng.uniform(-0.1, 0.1, (robots, robot.NUM_JOINTS))
    targets = stance + 0.25 * rng.normal(size=(POLICY_STEPS, robots, robot.NUM_JOINTS))
    limit = robot.per_joint(task.robot.effort_limit)

    def like(values: NDArray[np.float64]) -> torch.Tensor:
        return torch.as_tensor(values, dtype=backend.qpos.dtype, device=backend.qpos.device)

    everyone = torch.ones(robots, dtype=torch.bool, device=backend.qpos.device)
    backend.reset(everyone, like(qpos), torch.zeros_like(backend.qvel))
    bound = like(np.asarray(limit))
    for target in map(like, targets):
        for _ in range(task.sim.decimation):
            torque = 20.0 * (target - backend.qpos[:, 7:]) - 0.5 * backend.qvel[:, 6:]
            backend.step(torch.clamp(torque, -bound, bound))
    return backend.qpos.double().cpu().numpy()


def errors(off: NDArray[np.float64]) -> dict[str, float]:
    """Return how far coordinates (N, 19) are off, given their differences."""
    angles = 1e3 * np.sqrt(np.mean(off[:, 7:] ** 2, axis=1))
    height = 1e3 * np.abs(off[:, 2])
    return {
        "angle_mrad": float(np.median(angles)),
        "angle_mrad_p90": float(np.quantile(angles, 0.9)),
        "height_mm": float(np.median(height)),
    }


def main(arguments: Sequence[str]) -> None:
    """Measure and print the table."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if len(given) < len(arguments) or not {"num_envs", "rounds", "seconds", "robots"} >= set(given):
        raise SystemExit(USAGE)
    num_envs, robots = int(given.get("num_envs", 8192)), int(given.get("robots", 256))
    tasks = {name: task_of(overrides) for name, (_, overrides) in ROWS.items()}
    plain = tasks["plain"]
    sim = dataclasses.replace(plain.sim, physics_dt=FINE)
    reference = moved(dataclasses.replace(plain, sim=sim, backend=plain.backend.as_reference()), robots, option())
    found = {name: errors(moved(tasks[name], robots, change) - reference) for name, (change, _) in ROWS.items()}
    seconds = float(given.get("seconds", 3.0))
    much = Measured(num_envs, int(given.get("rounds", 3)), seconds, lambda done, total: print(f"round {done}/{total}"))
    subjects = {name: bare_subject(tasks[name], num_envs, change) for name, (change, _) in ROWS.items()}
    print("errors found, graphs captured", flush=True)
    measured = rates(subjects, much)
    print(f"{gpu()}; {num_envs} robots")
    speed = speeds(measured)
    names = "".join(f"{name:>16s}" for name in found["plain"])
    print(f"{'':36s}{'steps/s':>10s}{'over plain':>12s}{names}")
    for name, off in found.items():
        figures = f"{speed[f'{name}_steps_per_s']:10,.0f}{ratio(measured, name, 'plain'):12.2f}"
        print(f"{name:36s}{figures}" + "".join(f"{value:16.2f}" for value in off.values()))


if __name__ == "__main__":
    main(sys.argv[1:])
