"""How deep balls are in a height field, by MuJoCo Warp and by MuJoCo: ``python -m benchmarks.height_field law=engine``.

Balls of a foot's size at random places of ``terrain=rough``, up to ``depth`` m deep. ``law=engine`` is MuJoCo Warp as
it comes, ``law=mujoco`` with ``sim/physics/warp_kernels.py``, as ``backend=warp`` runs it. On a CPU or a GPU.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from go1exp.config.compose import compose
from go1exp.evaluate.statistics.intervals import share_interval
from go1exp.sim.task import parse_train
from go1exp.sim.terrain import build_terrain

USAGE = "usage: python -m benchmarks.height_field law=engine|mujoco [depth=0.005] [places=3000] [seed=0]"

RADIUS = 0.02
"""Of a foot of the Go1, m."""

OFF = 1e-4
"""Difference in depth that counts, m: ten times what single precision makes of it."""

Array = NDArray[np.float64]


def scene(heights: Array, size: tuple[float, float]) -> mujoco.MjModel:
    """Return one ball above a height field of ``size`` (half widths, m) whose lowest sample is at z = 0."""
    spec, span = mujoco.MjSpec(), float(np.ptp(heights))
    data = ((heights - heights.min()) / span).astype(np.float32).ravel()
    rows, columns = heights.shape
    spec.add_hfield(name="field", nrow=rows, ncol=columns, size=[*size, span, 0.1], userdata=data)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="field")
    ball = spec.worldbody.add_body()
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.5)
    return spec.compile()


def deepest_of_mujoco(model: mujoco.MjModel, places: Array) -> Array:
    """Return the least distance of any contact at each place (n, 3), m; NaN without contact."""
    data, least = mujoco.MjData(model), []
    for place in places:
        data.qpos[:3] = place
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        least.append(min(data.contact.dist, default=np.nan))
    return np.array(least)


def deepest_of_warp(model: mujoco.MjModel, places: Array) -> Array:
    """Return the same by MuJoCo Warp, each place a world of its own."""
    import mujoco_warp as mjw
    import warp as wp

    there, count = mjw.put_model(model), len(places)
    data = mjw.make_data(model, nworld=count, nconmax=8, njmax=40)
    qpos = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], dtype=np.float32), (count, 1))
    qpos[:, :3] = places
    data.qpos = wp.array(qpos, dtype=float)
    mjw.kinematics(there, data)
    mjw.collision(there, data)
    contacts, least = int(data.nacon.numpy()[0]), np.full(count, np.inf)
    np.minimum.at(least, data.contact.worldid.numpy()[:contacts], data.contact.dist.numpy()[:contacts])
    return np.where(np.isinf(least), np.nan, least)


def on_rough_ground(count: int, depth: float, seed: int) -> tuple[mujoco.MjModel, Array]:
    """Return ``terrain=rough`` with a ball, and places of it up to ``depth`` below the surface (count, 3), m."""
    terrain = build_terrain(parse_train(compose("train", ["terrain=rough"])).task.terrain)
    x_min, x_max, y_min, y_max = terrain.extent
    half = np.array([0.5 * (x_max - x_min), 0.5 * (y_max - y_min)])
    model, rng = scene(terrain.heights, (float(half[0]), float(half[1]))), np.random.default_rng(seed)
    at = rng.uniform(-1.0, 1.0, (count, 2)) * (half - 6.0)
    z = _surface(model, at) + RADIUS - rng.uniform(0.0, depth, count)
    return model, np.column_stack([at, z]).astype(np.float32).astype(np.float64)  # what both engines can hold


def _surface(model: mujoco.MjModel, at: Array) -> Array:
    """Return the height of the field under each point (n, 2), m."""
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    data.qpos[2] = 50.0
    mujoco.mj_forward(model, data)
    down = np.array([0.0, 0.0, -1.0])
    above = [mujoco.mj_ray(model, data, np.array([*xy, 5.0]), down, None, 1, -1, geom, np.zeros(3)) for xy in at]
    return 5.0 - np.array(above)


def main(arguments: Sequence[str]) -> None:
    """Compare and print one line."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"law"} <= set(given) <= {"law", "depth", "places", "seed"} or given["law"] not in ("engine", "mujoco"):
        raise SystemExit(USAGE)
    if given["law"] == "mujoco":
        from go1exp.sim.physics.warp_kernels import use_mujocos_law

        use_mujocos_law()
    count, depth = int(given.get("places", 3000)), float(given.get("depth", 0.005))
    model, places = on_rough_ground(count, depth, int(given.get("seed", 0)))
    off = np.abs(deepest_of_warp(model, places) - deepest_of_mujoco(model, places))
    off = off[np.isfinite(off)]
    share = share_interval(int((off > OFF).sum()), len(off))
    print(
        f"law={given['law']}, to {1000 * depth:g} mm deep: {100 * share.estimate:.2f} % of {len(off)} off by more than "
        f"{1000 * OFF:g} mm (95 %: {100 * share.low:.2f} to {100 * share.high:.2f}); largest {1000 * off.max():.3g} mm"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
