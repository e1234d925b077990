"""Actuator net on the AK80-6 double pendulum: commanded torque and velocity history -> torque that the drive reports.

    python benchmarks/actuator_net_ak80.py [FOLDER] [--all]

FOLDER holds ``ak80_double_pendulum`` (default: ``../shared/data`` beside the repository). Every number is of held-out
episodes:

1. design A, each of its nine episodes held out in turn; one other decides when to stop, seven train;
2. design A again, together with each episode all others that play the same elbow command are held out;
3. a net trained on design A, on all of design C;
4. with ``--all``: design C, each of its nine episodes held out in turn.

One net serves shoulder and elbow (the drives are alike). Taps and learning rate were chosen by looking at the elbow of
A 00 and A 02; the number of epochs by time. ``--all`` also adds the paper's form, which has no linear map beside the
layers, to part 1, and takes twice as long.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from go1exp.base.paths import data_root
from go1exp.gap.actuator_net.dataset import windows
from go1exp.gap.actuator_net.fitting import FitResult, fit
from go1exp.gap.actuator_net.report import rmse
from go1exp.gap.actuator_net.settings import FitSettings
from go1exp.logs.importers import import_recordings
from go1exp.logs.recording import Recording

SETTINGS = FitSettings(inputs=("tau_cmd", "velocity"), history=20, period=0.002, epochs=20, patience=20)

FOLLOWED = {"A": ("11",), "C": ("12", "13")}
"""Episodes in which a controller followed a target; the others are torques played open loop."""

SAME_ELBOW = (("00", "12"), ("01",), ("02", "13"), ("03",), ("04", "05"), ("11",))
"""Episodes of design A whose elbow commands are alike."""

MODELS = ("net", "half_net", "linear", "command")


def name(recording: Recording) -> str:
    return recording.meta.episode[-2:]


def stopper(recordings: list[Recording], held_out: Iterable[str], followed: Iterable[str]) -> str:
    """The episode that decides when to stop: the next open-loop one after the last held out, in cyclic order."""
    names = [name(r) for r in recordings]
    last = names.index(max(held_out))
    ring = names[last + 1 :] + names[: last + 1]
    return next(n for n in ring if n not in (*held_out, *followed))


def fold(recordings: list[Recording], held_out: tuple[str, ...], settings: FitSettings, design: str) -> FitResult:
    full = {name(r): r.meta.episode for r in recordings}
    stop = stopper(recordings, held_out, FOLLOWED[design])
    holdout = tuple(full[n] for n in held_out)
    return fit(recordings, replace(settings, holdout=holdout, validation=(full[stop],)))


def table(title: str, results: list[FitResult], models: Iterable[str], extra: list[FitResult] | None = None) -> None:
    """Print one line per joint and episode, and their means: over all, and over those played open loop."""
    models = list(models)
    print(f"\n{title}")
    print("joint     episode " + "".join(f"{m:>10}" for m in (*models, *(["paper"] if extra else []))))
    joints = results[0].net.info.joints
    for joint in joints:
        lines: dict[str, list[float]] = {}
        for k, result in enumerate(results):
            for cell in (c for c in result.report.episodes if c.joint == joint):
                values = [cell.rmse[m] for m in models]
                if extra:
                    values += [c.rmse["net"] for c in extra[k].report.episodes if c.joint == joint]
                lines[cell.episode[-2:]] = values
        design = results[0].net.info.robot[-1].upper()
        open_loop = [v for n, v in lines.items() if n not in FOLLOWED[design]]
        for n in sorted(lines):
            mark = " *" if n in FOLLOWED[design] else "  "
            print(f"{joint:<9} {n}{mark}    " + "".join(f"{v:10.4f}" for v in lines[n]))
        print(f"{joint:<9} mean    " + "".join(f"{v:10.4f}" for v in np.mean(list(lines.values()), axis=0)))
        print(f"{joint:<9} no *    " + "".join(f"{v:10.4f}" for v in np.mean(open_loop, axis=0)))


def regimes(results: list[FitResult]) -> None:
    """Print the errors by regime, pooled over the folds."""
    print("\nDesign A, rows of all nine held-out episodes together, by regime")
    print("joint     regime            rows" + "".join(f"{m:>10}" for m in MODELS))
    for joint in results[0].net.info.joints:
        for regime in ("all", "still", "slow", "fast", "reversal", "high torque"):
            cells = [c for r in results for c in r.report.cells if (c.joint, c.regime) == (joint, regime)]
            rows = sum(c.rows for c in cells)
            pooled = [np.sqrt(sum(c.rows * c.rmse[m] ** 2 for c in cells) / rows) for m in MODELS]
            print(f"{joint:<9} {regime:<12} {rows:9d}" + "".join(f"{v:10.4f}" for v in pooled))
    for limit in results[0].report.thresholds:
        print(
            f"{limit.joint}: still below {limit.still_below:.2f}, fast from {limit.fast_above:.2f} rad/s; "
            f"reversal within {limit.reversal_within:g} s of a change of sign; "
            f"high torque above {limit.high_torque_above:.2f} N m"
        )


def transfer(result: FitResult, recordings: list[Recording]) -> None:
    """Print the errors of a net of design A on design C."""
    print(f"\n3. A -> C: net of design A (held out: {result.report.split.held_out[0][-2:]}) on all of design C")
    print("joint     episode        net   command")
    info = result.net.info
    for recording in recordings:
        rows = windows([recording], info.inputs, info.history, info.period)
        torque = result.net.torque(rows.x)
        for j, joint in enumerate(info.joints):
            joint_rows = rows.joint == j
            errors = (
                rmse(torque[joint_rows] - rows.y[joint_rows]),
                rmse(rows.command[joint_rows] - rows.y[joint_rows]),
            )
            mark = " *" if name(recording) in FOLLOWED["C"] else "  "
            print(f"{joint:<9} {name(recording)}{mark}    " + "".join(f"{v:10.4f}" for v in errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=data_root().parent / "shared/data")
    parser.add_argument("--all", action="store_true", help="part 4, and the paper's form in part 1")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    start = time.perf_counter()
    designs = {
        d: import_recordings("ak80_double_pendulum", arguments.folder / f"ak80_double_pendulum/design_{d}_0", {})
        for d in "AC"
    }
    a, c = designs["A"], designs["C"]
    print("RMSE in N m of the reported torque; * a controller followed a target, the other commands are open loop")
    alone = [fold(a, (name(r),), SETTINGS, "A") for r in a]
    paper = replace(SETTINGS, skip=False, half_net=False)
    extra = [fold(a, (name(r),), paper, "A") for r in a] if arguments.all else None
    table("1. Design A, one episode held out", alone, MODELS, extra)
    regimes(alone)
    lean = replace(SETTINGS, half_net=False)
    models = [m for m in MODELS if m != "half_net"]
    done = {name(r): result for r, result in zip(a, alone, strict=True)}
    groups = [done[g[0]] if len(g) == 1 else fold(a, g, lean, "A") for g in SAME_ELBOW]
    table("2. Design A, all episodes with the same elbow command held out", groups, models)
    transfer(alone[0], c)
    if arguments.all:
        table("4. Design C, one episode held out", [fold(c, (name(r),), lean, "C") for r in c], models)
    print(f"\n{time.perf_counter() - start:.0f} s, {torch.get_num_threads()} thread")


if __name__ == "__main__":
    main()
