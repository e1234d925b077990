"""Baseline of the gap benchmark: fit everything at once with ``mujoco.sysid``, then name what left its tolerance.

``python benchmarks/gap_sysid.py cases=DIR [out=DIR] [jobs=2]``

Does what a careful user of MuJoCo's own toolbox would: every parameter below free at once, Gauss-Newton on whole
episodes, the toolbox's intervals. An effect is named where its estimate lies beyond the declared tolerance and the
95 % interval excludes its null value. No effect is ever compared with another, and what is no parameter of a MuJoCo
model (delay, lag, strength, backlash) cannot be named. Writes ``OUT/<case>/verdict.json`` (``OUT`` is ``DIR/../sysid``
unless given) for ``benchmarks.gap.score`` and skips a case that has one. Needs ``mujoco[sysid]``.

To take about a minute a case: RK4 at the period of the log, and one perturbed replay for all four legs, which a held
trunk keeps apart. Two things are not identifiable on a suspended robot: roll of the trunk is left to the hips' encoders
(the hips turn about that axis), and the hip links share one scale of mass.
"""

from __future__ import annotations

import copy
import functools
import importlib
import io
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.gap import known
from go1exp import robot
from go1exp.gap.data.cutting import noise_of
from go1exp.logs.recording import Recording, RecordingError, read_folder
from go1exp.sim.physics.scene import load_robot

sysid: Any = importlib.import_module("mujoco.sysid")  # empty without the extra, and mypy knows nothing of it

FITTED: dict[str, tuple[str, float, float, float]] = {
    "armature": ("added", -0.004, 0.05, 0.0),
    "viscous": ("damping", 0.0, 1.0, 0.01),
    "coulomb": ("bound", 0.0, 2.0, 0.02),
    "kp_scale": ("scale", 0.3, 3.0, 1.0),
    "kd_scale": ("scale", 0.1, 5.0, 1.0),
    "link_mass": ("scale", 0.5, 2.0, 1.0),
    "encoder_offset": ("offset", -0.15, 0.15, 0.0),
    "base_tilt": ("pitch", -0.2, 0.2, 0.0),
}
"""Effect -> its parameter, bounds and start, in the units of ``known.TOLERANCES``; bounds chosen wide."""

SLOTS = dict.fromkeys(FITTED, np.arange(robot.NUM_JOINTS))
SLOTS |= {"link_mass": np.array([0, 1, 2, 0, 3, 4, 0, 5, 6, 0, 7, 8]), "base_tilt": np.zeros(1, dtype=int)}
"""Effect -> (12,) which of its numbers holds at each joint; the trunk has one."""

FIT_SHARE, ITERATIONS, STEP, BURN_ROWS, SHORTEST_ROWS = 0.625, 8, 0.02, 25, 150
"""Share of episodes to fit; most steps; finite difference in tolerances; rows not compared; rows of shortest replay."""

GOOD, WORST = 1.5, 1e3
"""In units of the noise: held-out RMS below which nothing is left to explain; what a reading that diverged counts."""


def scene(recording: Recording) -> mujoco.MjSpec:
    """Return the held nominal robot with the recording's attitude and gains: joints, links and position drives."""
    meta, spec = recording.meta, load_robot(known.NOMINAL["inertia"])
    for thing in (spec.joint("root"), *spec.keys, *spec.geoms):
        spec.delete(thing)
    spec.body("trunk").quat = list(meta.base_quat or (1.0, 0.0, 0.0, 0.0))
    spec.option.timestep, spec.option.integrator = 1.0 / meta.rate_hz, mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    effort = robot.per_joint(known.NOMINAL["effort_limit"])
    for j, name in enumerate(robot.JOINTS):
        joint, drive = spec.joint(name), spec.actuator(name)
        joint.solref_friction, joint.solimp_friction = [2.0 / meta.rate_hz, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]
        drive.set_to_position(kp=(meta.kp or ())[j], kv=(meta.kd or ())[j])
        drive.forcelimited, drive.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-effort[j], effort[j]]
    for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for name in robot.JOINTS:
            spec.add_sensor(name=f"{name}_{kind.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name)
    return spec


def parameters() -> Any:
    """Return everything that is free, as deviations from null in tolerances."""
    free = sysid.ParameterDict()
    for effect, (name, low, high, start) in FITTED.items():
        scaled = (np.array([start, low, high]) - known.null(effect, name)) / known.TOLERANCES[effect][name]
        free.add(sysid.Parameter(effect, *(np.full(SLOTS[effect].max() + 1, v) for v in scaled)))
    return free


def with_values(nominal: dict[int, mujoco.MjModel], params: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return a copy of the nominal model of a specification (by its ``id``) with these parameters."""
    value = {e: known.null(e, n) + known.TOLERANCES[e][n] * params[e].value[SLOTS[e]] for e, (n, *_) in FITTED.items()}
    model = copy.copy(nominal[id(spec)])
    link, trunk = model.jnt_bodyid, model.body("trunk").id
    model.dof_armature += value["armature"]
    model.dof_damping[:], model.dof_frictionloss[:] = value["viscous"], value["coulomb"]
    model.actuator_gainprm[:, 0] *= value["kp_scale"]
    model.actuator_biasprm[:, 1] *= value["kp_scale"]
    model.actuator_biasprm[:, 2] *= value["kd_scale"]
    model.body_mass[link] *= value["link_mass"]
    model.body_inertia[link] *= value["link_mass"][:, None]
    model.qpos0 += value["encoder_offset"]  # the zeros move, so that coordinates are what the encoders read
    model.jnt_range += value["encoder_offset"][:, None]
    turn = Rotation.from_quat(model.body_quat[trunk], scalar_first=True).as_euler("xyz")
    turn[1] += value["base_tilt"].item()
    model.body_quat[trunk] = Rotation.from_euler("xyz", turn).as_quat(scalar_first=True)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def sequences(recording: Recording, spec: mujoco.MjSpec) -> Any:
    """Return the spans with drives on, rows on the grid of the rate (stamps jitter, samples do not), lost ones NaN."""
    rate, t = recording.meta.rate_hz, recording.t
    row, first = np.unique(np.round((t - t[0]) * rate).astype(int), return_index=True)
    grid = np.arange(row[-1] + 1)
    reading = np.full((len(grid), 2 * robot.NUM_JOINTS), np.nan)
    reading[row] = np.concatenate([recording.joint("q"), recording.joint("qd")], axis=1)[first]
    target = np.stack([np.interp(grid, row, x) for x in recording.joint("q_target")[first].T], axis=1)
    powered = np.asarray(recording.channels.get("torque_enable", np.ones(len(t))), dtype=float)[first]
    on = (np.interp(grid, row, powered) == 1.0).astype(int)
    model, starts, controls, measured = spec.compile(), [], [], []
    for begin, end in np.flatnonzero(np.diff([0, *on, 0])).reshape(-1, 2):
        begin += int(np.argmax(np.isfinite(reading[begin:end, 0])))
        if end - begin >= SHORTEST_ROWS:
            seconds = grid[: end - begin] / rate
            starts.append(sysid.create_initial_state(model, *np.split(reading[begin], 2)))
            controls.append(sysid.TimeSeries(seconds, target[begin:end]))
            measured.append(sysid.TimeSeries.from_names(seconds, reading[begin:end], model))
    return sysid.ModelSequences(recording.meta.episode, spec, [""] * len(starts), starts, controls, measured)


class Fit:
    """The residual of some recordings of one robot, as the toolbox wants it, and its Jacobian."""

    def __init__(self, recordings: Sequence[Recording], sd: np.ndarray) -> None:
        self.data, self.sd = [sequences(r, scene(r)) for r in recordings], sd
        self.build = functools.partial(with_values, {id(s.spec): s.gt_model for s in self.data})
        if not any(s.measured_rollout for s in self.data):
            raise RecordingError("no span with drives on is long enough")

    def differ(self, params: Any, predicted: Any, measured: Any, model: Any, full: bool, *, state: np.ndarray) -> Any:
        """Return what the replay misses by (T, 24) in units of the noise; nothing at lost rows and at the beginning."""
        miss = np.nan_to_num((measured.data[1:] - state[:, 1:25]) / self.sd, nan=WORST).clip(-WORST, WORST)
        miss[np.isnan(measured.data[1:]) | (np.arange(len(miss)) < BURN_ROWS)[:, None]] = 0.0
        return miss, predicted, sysid.TimeSeries(predicted.times, measured.data[1:], predicted.signal_mapping)

    def residual(self, x: np.ndarray, params: Any) -> Any:
        """Call the toolbox's residual function."""
        return sysid.residual(x, params, self.data, self.build, self.differ, n_threads=1, resample_true=False)

    def jacobian(self, x: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Return the Jacobian by finite differences; what moves one leg only is moved in all four legs at once."""
        column = [(e, np.flatnonzero(SLOTS[e] == n)) for e in FITTED for n in range(SLOTS[e].max() + 1)]
        leg = np.array([j[0] // 3 if len(j) == 1 and e != "base_tilt" else -1 for e, j in column])
        _, group = np.unique([f"{e} {j[0] % 3}" for e, j in column], return_inverse=True)
        step = np.where(x.ravel() > 0.0, -STEP, STEP)
        moved = x.reshape(-1, 1) + step[:, None] * (group[:, None] == np.unique(group))
        high = np.concatenate(self.residual(moved, parameters())[0])
        slope = (high - r.reshape(-1, 1))[:, group] / step
        return np.where((leg < 0) | (np.arange(len(r))[:, None] % robot.NUM_JOINTS // 3 == leg), slope, 0.0)

    def rms(self, x: np.ndarray) -> float:
        """Return the root mean square of what was compared, in units of the noise."""
        miss = np.concatenate(self.residual(x, parameters())[0])
        return float(np.sqrt(np.mean(miss[miss != 0.0] ** 2)))


def identify(recordings: Sequence[Recording]) -> dict[str, Any]:
    """Fit the first recordings, test on the rest, and return what ``verdict.json`` holds."""
    if not all(r.meta.kp and r.meta.kd and r.meta.base == "fixed" for r in recordings):
        raise RecordingError("kp, kd and base=fixed are needed")
    sd = np.concatenate([noise_of([r.joint(name) for r in recordings]) for name in ("q", "qd")])
    cut = int(np.ceil(FIT_SHARE * len(recordings)))
    fit, kept = Fit(recordings[:cut], sd), Fit(recordings[cut:], sd)
    options = {"max_iters": ITERATIONS, "xtol": 0.01, "x_scale": "jac", "output": io.StringIO()}
    best, optimum = sysid.optimize(parameters(), fit.residual, verbose=False, jacobian=fit.jacobian, **options)
    half = sysid.calculate_intervals(fit.residual(optimum.x, best)[0], optimum.jac)[1]
    before, after = kept.rms(np.zeros_like(optimum.x)), kept.rms(optimum.x)
    rows = candidates(optimum.x, half)
    named = [r for r in rows if any(r["params"].values())]
    return {
        "verdict": (("no gap", "unexplained"), ("explained", "partly explained"))[bool(named)][after >= GOOD],
        "sentence": f"held-out residual {before:.2f} -> {after:.2f} noise",
        "named": named,
        "candidates": rows,
        "closed": 1.0 - max(after**2 - 1.0, 0.0) / (before**2 - 1.0) if before > 1.0 else None,
    }


def candidates(x: np.ndarray, half: np.ndarray) -> list[dict[str, Any]]:
    """Return a row per effect, best first, from estimates and half widths in the order of :func:`parameters`."""
    rows, begin = [], 0
    for effect, (name, *_) in FITTED.items():
        at = begin + SLOTS[effect]
        begin = int(at.max()) + 1
        beyond = (np.abs(x[at]) > 1.0) & (np.abs(x[at]) > half[at])
        places = robot.JOINTS if len(at) > 1 else ("robot",)
        ends = np.stack([x[at], x[at] - half[at], x[at] + half[at]], axis=1) * known.TOLERANCES[effect][name]
        ends += known.null(effect, name)
        band = {p: v for p, v, out in zip(places, ends.tolist(), beyond, strict=True) if out}
        row: dict[str, Any] = {"effect": effect, "joints": [p for p in band if p != "robot"], "alias_set": [effect]}
        row |= {"params": {name: {p: v[0] for p, v in band.items()}}, "status": "certified"}
        row |= {"interval": {name: {p: v[1:] for p, v in band.items()}}}
        rows.append(row | {"size_over_tolerance": float(np.abs(x[at][beyond | ~beyond.any()]).max())})
    return sorted(rows, key=lambda r: (not any(r["params"].values()), -r["size_over_tolerance"]))


def solve(case: Path, out: Path) -> str:
    """Solve one case, write its verdict, and return a line about it."""
    start = time.perf_counter()
    try:
        result = identify(read_folder(case))
    except RecordingError as error:
        result = {"verdict": "bad log", "sentence": str(error), "named": [], "candidates": []}
    result["seconds"] = time.perf_counter() - start
    (out / case.name).mkdir(parents=True, exist_ok=True)
    (out / case.name / "verdict.json").write_text(json.dumps(result, indent=1) + "\n")
    names = ", ".join(f"{n['effect']} x{n['size_over_tolerance']:.1f} ({len(n['joints'])})" for n in result["named"])
    return f"{case.name}: {result['verdict']}, {result['seconds']:.0f} s. {result['sentence']}. {names}"


def require() -> None:
    """Raise SystemExit without the extra."""
    if not hasattr(sysid, "optimize"):
        raise SystemExit('mujoco.sysid needs its dependencies: pip install "mujoco[sysid]"')


def main(arguments: Sequence[str]) -> None:
    """Solve all cases that have no verdict yet."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if "cases" not in given or len(given) != len(arguments) or set(given) - {"cases", "out", "jobs"}:
        raise SystemExit("usage: python benchmarks/gap_sysid.py cases=DIR [out=DIR] [jobs=2]")
    require()
    cases, jobs = Path(given["cases"]), int(given.get("jobs", 2))
    out = Path(given.get("out", cases.parent / "sysid"))
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    todo = sorted(
        {p.parent for p in cases.glob("*/*.parquet")} - {cases / p.parent.name for p in out.glob("*/verdict.json")}
    )
    begun = time.monotonic()
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for done, line in enumerate(pool.map(functools.partial(solve, out=out), todo), start=1):
            left = (time.monotonic() - begun) / done * (len(todo) - done)
            print(f"[{done}/{len(todo)}, {left / 60:.0f} min left] {line}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
