"""The ablation study as a user runs it: one command, its launcher killed half-way, gone on with, and reported."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from go1exp.train.sweep import index
from tests import slurm_cluster
from tests.command import environment, run_alone

pytestmark = pytest.mark.slow(
    "go1exp/train/sweep/", "go1exp/evaluate/report/", "conf/study/", "conf/launcher/", "tests/slurm_cluster.py"
)

LAUNCHERS = {
    "joblib": ("hydra.launcher.n_jobs=2",),
    "slurm": ("hydra.launcher.cpus=1", "hydra.launcher.mem_gb=1.5", "hydra.launcher.poll_s=0.5"),
}
SMALLER = ("ppo.num_envs=32", "ppo.iterations=60", "checkpoint.every=2", "torch_threads=1")
"""What makes the study small; its recipe stays."""

BRIEF = ("x=[0.5]", "y=[]", "yaw=[]", "episodes=2", "seconds=1.0", "settle_s=0.5")


@pytest.fixture
def variables(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Environment of the command lines; for Slurm, of a cluster that ends with the test."""
    if request.param == "joblib":
        yield {}
        return
    with slurm_cluster.of_a_test(tmp_path_factory.mktemp("slurm")) as needed:
        yield needed


def killed_half_way(line: list[str], place: Path, variables: dict[str, str]) -> None:
    """Start a sweep and kill its launcher when the first job has a checkpoint and none is done."""
    with (place / "output.txt").open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "go1exp", *line],
            cwd=place,
            env=environment(**variables),
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        limit = time.monotonic() + 300.0
        while not any(place.glob("study/*/checkpoints/*.pt")):
            assert process.poll() is None, (place / "output.txt").read_text()
            assert time.monotonic() < limit, (place / "output.txt").read_text()
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(("launcher", "variables"), [(name, name) for name in LAUNCHERS], indirect=["variables"])
def test_the_study_is_killed_half_way_gone_on_with_and_reported(
    launcher: str, variables: dict[str, str], tmp_path: Path
) -> None:
    parts = ("seed=0,1", "+experiment/ablation=none,no_gait_shaping", *SMALLER)
    chosen = (f"hydra/launcher={launcher}", *LAUNCHERS[launcher], "hydra.sweep.dir=study")
    killed_half_way(["train", "-m", "study=ablations", "backend=cpu", *parts, *chosen], tmp_path, variables)
    states = [job.state for job in index.read(tmp_path / "study").jobs]
    assert len(states) == 4
    assert "done" not in states

    again = run_alone(tmp_path, "train", "sweep=study", timeout=580.0, **variables)
    assert again.returncode == 0, again.stdout + again.stderr
    jobs = index.read(tmp_path / "study").jobs
    assert [job.state for job in jobs] == ["done"] * 4
    for job in jobs:
        with (tmp_path / "study" / job.run_folder / "metrics.csv").open(newline="") as file:
            assert [int(row["iteration"]) for row in csv.DictReader(file)] == list(range(1, 61))

    if launcher == "joblib":  # Slurm's jobs outlive the launcher
        logs = [(tmp_path / "study" / job.run_folder / "job.log").read_text() for job in jobs]
        assert any("continuing from" in log for log in logs)

    brief = [f"evaluation.{words}" for words in BRIEF]
    line = ("report", "study", "eval=true", "baseline='ablation=none'", *brief)
    done = run_alone(tmp_path, *line)
    assert done.returncode == 0, done.stderr
    assert "4 runs in 2 groups; baseline: ablation=none" in done.stdout
    assert "ablation=no_gait_shaping" in (tmp_path / "study/report/report.html").read_text()
    with (tmp_path / "study/report/grid_runs.csv").open(newline="") as file:
        assert len([*csv.DictReader(file)]) == 4
