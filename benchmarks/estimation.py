"""The Kalman filter in numbers: python benchmarks/estimation.py [speed] [scaler] [sim] [--run RUN] [--data FOLDER] ...

1. ``speed``: updates per second on one core, from C++ and one by one from Python.
2. ``scaler``: the walks of a real robot under motion capture, compared with plain leg odometry; FOLDER holds such
   runs as ``.npz`` (default: ``scaler_walk_mocap`` in ``../shared/data`` beside the repository, or in GO1EXP_DATA).
   With ``--leave-one-out`` the setting that matters most for distance, ``foot_drift``, is chosen on the other runs.
3. ``sim``: a simulated Go1 under the policy of ``--run`` with random commands up to 1.5 m/s (and straight on
   at 1.5 m/s), sensors at 500 Hz with the standard deviations of the paper's Table II, on flat ground and on the
   paper's terrain; without a run it squats. ``--every 5`` feeds the filter at 100 Hz, ``--lost 0.2`` without a fifth.

The error of a velocity is the root mean square over time of its components (x, y, z of the trunk) and of all three
together (the length of the error); the first half second is left out.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.mocap import Evaluation, evaluate
from benchmarks.replay import samples
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.deploy.estimation import Status, go1, make_filter, readings, scaler
from go1exp.logs.importers.source import files
from go1exp.logs.record.sensors import Channel, SensorConfig
from go1exp.logs.record.simulate import Rig, Walk, play, play_policy
from go1exp.logs.recording import VECTORS, Recording, RecordingError
from go1exp.sim.task import parse_task

COMMANDS: dict[str, object] = {
    "lin_vel_x": [-0.5, 1.5],
    "lin_vel_y": [-0.5, 0.5],
    "ang_vel_z": [-1.0, 1.0],
    "hold_time": [3.0, 10.0],
    "standing_fraction": 0.1,
}

FAST: dict[str, object] = {"lin_vel_x": 1.5, "lin_vel_y": 0.0, "ang_vel_z": 0.0}

STD = 1 / np.sqrt(3)
"""Standard deviation of a uniform distribution of half-width 1."""

SENSORS = SensorConfig(
    rate_hz=500.0,
    jitter=1e-4,
    dropped=0.0,
    q=Channel(0.05 * STD, 0.0),
    qd=Channel(0.1 * STD, 0.0),
    tau_est=Channel(0.1, 0.006),
    gyro=Channel(0.01 * STD, 0.0),
    acc=Channel(0.1, 0.005),
    attitude=Channel(0.05 * STD, 0.0),
    foot_force=Channel(2.0, 1.0),
    truth=True,
)

DRIFTS = (0.012, 0.016, 0.018, 0.02, 0.022, 0.024, 0.027, 0.03, 0.035)


def speed() -> None:
    """Print updates per second."""
    row = np.zeros(readings.WIDTH)
    row[readings.QUAT], row[readings.ACC] = [1, 0, 0, 0], [0, 0, 9.81]
    row[readings.Q], row[readings.FOOT_FORCE] = np.tile([0.0, 0.8, -1.5], 4), 30.0
    rows = np.tile(row, (50_000, 1))
    rows[:, readings.T] = 0.002 * np.arange(len(rows))
    best = []
    for one_by_one in (False, True):
        times = []
        for _ in range(5):
            fast = make_filter(go1())
            start = time.perf_counter()
            if one_by_one:
                for one in rows:
                    fast.update(one)
            else:
                fast.run(rows)
            times.append(time.perf_counter() - start)
        best.append(len(rows) / min(times))
    print(f"| updates/s, four feet on the ground, one core | {best[0]:,.0f} in C++ | {best[1]:,.0f} from Python |")


def real(folder: Path, leave_one_out: bool) -> None:
    """Print the table of SCALER's walks; a run that cannot be evaluated has its reason there."""
    evaluations: dict[Path, Evaluation] = {}
    print("| run | distance, m | odometry: v RMSE | distance | filter: v RMSE | distance | clock |")
    print("|---|---|---|---|---|---|---|")
    for file in files(folder, "*.npz"):
        try:
            j = evaluate(file, scaler())
        except RecordingError as error:
            print(f"| {file.stem} | left out: {error} |")
            continue
        evaluations[file] = j
        odometry = f"{j.odometry_rmse:.3f} | {100 * j.odometry_distance:+.1f} %"
        filtered = f"{j.filter_rmse:.3f} | {100 * j.filter_distance:+.1f} %"
        clock = f"{j.clock_shift:+.2f} s" if j.clock_shift else ""
        print(f"| {j.run} | {j.truth_distance:.2f} | {odometry} | {filtered} | {clock} |")
    if not evaluations:
        return
    runs = list(evaluations.values())
    columns = [
        (np.mean([j.odometry_rmse for j in runs]), np.mean([abs(j.odometry_distance) for j in runs])),
        (np.mean([j.filter_rmse for j in runs]), np.mean([abs(j.filter_distance) for j in runs])),
    ]
    print("| mean (distance: of sizes) | | " + " | ".join(f"{v:.3f} | {100 * d:.1f} %" for v, d in columns) + " | |")
    if leave_one_out and len(evaluations) > 1:
        errors = np.array([[evaluate(f, scaler(foot_drift=d)).filter_distance for d in DRIFTS] for f in evaluations])
        held = []
        for k in range(len(evaluations)):
            others = np.delete(errors, k, axis=0)
            held.append(errors[k, np.argmin((others**2).mean(axis=0))])
        print(
            "foot_drift by the other runs: "
            + ", ".join(f"{100 * h:+.1f}" for h in held)
            + f" %; mean of sizes {100 * np.mean(np.abs(held)):.1f} %"
        )


def kept(count: int, every: int, lost: float) -> np.ndarray:
    """Return the indices of the samples that the filter gets: one of ``every``, without a random share ``lost``."""
    rows = np.arange(count)[every - 1 :: every]
    return rows[np.random.default_rng(0).random(len(rows)) >= lost]


def score(recordings: Sequence[Recording], ground: str, every: int, lost: float) -> None:
    """Print the error of each simulated robot's estimated velocity, for a filter that gets a part of the samples."""
    config = go1()
    for r in recordings:
        fed = kept(len(r.t), every, lost)
        t = r.t[fed]
        states = make_filter(config).run(samples(r)[fed])
        attitude = Rotation.from_quat(r.block(*VECTORS["base_quat"]), scalar_first=True)
        velocity = attitude.inv().apply(r.block(*VECTORS["base_lin_vel"]))[fed]
        later = t > t[0] + 0.5
        error = (states[:, 3:6] - velocity)[later]
        axes = " ".join(f"{x:.3f}" for x in np.sqrt((error**2).mean(axis=0)))
        whole = np.sqrt((error**2).sum(axis=1).mean())
        tail = np.sqrt((error[t[later] > t[-1] - 30] ** 2).sum(axis=1).mean())
        horizontal = np.linalg.norm(velocity[later, :2], axis=1)
        odd = int((states[1:, -1] != Status.OK).sum())
        print(
            f"| {ground} | {r.meta.episode} | {t[-1]:.0f} | {horizontal.mean():.2f} ({horizontal.max():.2f}) "
            f"| {axes} | {whole:.3f} | {tail:.3f} | {np.abs(error).max():.2f} | {odd} |",
            flush=True,
        )


def simulated(run: Path | None, seconds: float, robots: int, every: int, lost: float) -> None:
    """Print the tables of the simulated Go1."""
    print("| ground | episode | s | speed mean (max), m/s | RMSE x y z | all | last 30 s | worst | left out |")
    print("|---|---|---|---|---|---|---|---|---|")
    for ground in ("flat", "rough"):
        task = parse_task(compose("train", [f"terrain={ground}", "backend.threads=1"]))
        rig = Rig(task.robot, task.actuator, (), task.terrain, task.backend, 0.002)
        if run is None:
            from go1exp.logs.record.plan import Episode, make_motion

            squat, _ = bind("excitation", "squat", {}, "squat")
            assert squat is not None
            motion = make_motion(squat, seconds, SENSORS.rate_hz, 0)
            episode = Episode(f"squat_{ground}", "squat", motion, 35.0, 1.2, None, None, 0)
            score(play(rig, [episode], SENSORS, 0, lambda *_: None), ground, every, lost)
            continue
        from go1exp.train.policy import load_run

        trained, policy, _ = load_run(run)
        count, length = (1, seconds) if ground == "flat" else (robots, seconds / robots)
        walks = [("uniform_velocity", COMMANDS, [f"{ground}_{k}" for k in range(count)], length)]
        if ground == "flat":
            walks.append(("fixed_velocity", FAST, ["flat_fast"], min(length, 60.0)))
        for name, parameters, names, length in walks:
            command, problems = bind("command", name, parameters, "command")
            assert command is not None, problems
            walk = Walk(replace(trained.task, command=command), policy, names, length, None)
            score(play_policy(rig, walk, SENSORS, 0, lambda *_: None), ground, every, lost)


def main() -> None:
    """Run the parts that the command line selects."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "parts", nargs="*", default=["speed", "scaler", "sim"], help="speed, scaler, sim (default: all)"
    )
    parser.add_argument("--data", type=Path, help="a run of SCALER's (.npz), or a folder of them")
    parser.add_argument("--leave-one-out", action="store_true")
    parser.add_argument("--run", type=Path, help="run folder of the policy that walks")
    parser.add_argument("--seconds", type=float, default=600.0, help="simulated time on each ground")
    parser.add_argument("--robots", type=int, default=10, help="among which the time on rough ground is shared")
    parser.add_argument("--every", type=int, default=1, help="in sim, the filter gets every so many of the samples")
    parser.add_argument("--lost", type=float, default=0.0, help="in sim, share of the samples that are lost")
    wanted = parser.parse_args()
    if "speed" in wanted.parts:
        speed()
    if "scaler" in wanted.parts:
        shared = Path(os.environ.get("GO1EXP_DATA", data_root().parent / "shared/data"))
        real(wanted.data or shared / "scaler_walk_mocap", wanted.leave_one_out)
    if "sim" in wanted.parts:
        simulated(wanted.run, wanted.seconds, wanted.robots, wanted.every, wanted.lost)


if __name__ == "__main__":
    main()
