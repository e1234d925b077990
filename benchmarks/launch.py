"""What a launcher costs: time from one job to the first iteration of the next, and steps per second of two at once.

    python benchmarks/launch.py joblib ray slurm

prints a table. Slurm needs a cluster: python tests/slurm_cluster.py FOLDER prints the variable to set.
"""

from __future__ import annotations

import csv
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.small_run import SMALL

JOBS = 4
ONE = (*SMALL, "ppo.iterations=1")
ONE_AT_A_TIME = {
    "joblib": ("hydra.launcher.n_jobs=1",),
    "ray": (f"hydra.launcher.cpus={os.cpu_count()}",),
    "slurm": (
        "hydra.launcher.at_once=1",
        "hydra.launcher.cpus=1",
        "hydra.launcher.mem_gb=2",
        "hydra.launcher.poll_s=1",
    ),
}
TASK = ("experiment=minute", "ppo.iterations=6", "logger.tensorboard=false", "torch_threads=0")


def train(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "go1exp", "train", *arguments], check=True, stdout=subprocess.DEVNULL)


def plain(folder: Path) -> float:
    """Return the seconds from a command to its first iteration."""
    began = time.time()
    train(*ONE, "seed=1", f"hydra.run.dir={folder}")
    return (folder / "metrics.csv").stat().st_mtime - began


def between_jobs(folder: Path, launcher: str) -> list[float]:
    """Return the seconds from the end of each job to the first iteration of the next one."""
    seeds = ",".join(map(str, range(JOBS)))
    train(
        "-m", *ONE, f"seed={seeds}", f"hydra/launcher={launcher}", *ONE_AT_A_TIME[launcher], f"hydra.sweep.dir={folder}"
    )
    rows = sorted((r / "metrics.csv").stat().st_mtime for r in folder.glob("seed-*"))
    ends = sorted((r / "state.json").stat().st_mtime for r in folder.glob("seed-*"))
    return [row - end for row, end in zip(rows[1:], ends, strict=False)]


def steps_per_s(run: Path) -> float:
    """Return the median speed of a run, but for its first iteration."""
    with (run / "timing.csv").open() as file:
        return statistics.median([float(row["time/steps_per_s"]) for row in csv.DictReader(file)][1:])


def main(launchers: list[str]) -> None:
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as place:
        folder = Path(place)
        for launcher in launchers:
            alone, jobs = [], between_jobs(folder / launcher, launcher)
            for number in range(JOBS - 1):
                alone.append(plain(folder / f"{launcher}-plain-{number}"))
            cost = statistics.median(jobs) - statistics.median(alone)
            print(f"{launcher:8} {cost:6.2f} s a job over a plain run")
            print(f"  jobs {[round(s, 1) for s in jobs]}, plain {[round(s, 1) for s in alone]}", flush=True)
        train(*TASK, f"hydra.run.dir={folder / 'alone'}")
        train(
            "-m",
            *TASK,
            "seed=1,2",
            "hydra/launcher=joblib",
            "hydra.launcher.n_jobs=2",
            f"hydra.sweep.dir={folder / 'two'}",
        )
        one, two = steps_per_s(folder / "alone"), [steps_per_s(folder / f"two/seed-{seed}") for seed in (1, 2)]
        print(f"two at once {sum(two):,.0f} steps/s over one alone {one:,.0f}: {sum(two) / one:.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
