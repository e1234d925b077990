"""``hydra/launcher=slurm`` on a real Slurm: jobs are killed and start again, and learn what they learn without it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch

from tests import slurm_cluster
from tests.command import environment, run_alone
from tests.small_run import SMALL

pytestmark = pytest.mark.slow("go1exp/train/sweep/", "go1exp/cli/", "conf/launcher/", "tests/slurm_cluster.py")

LONGER = (*SMALL, "ppo.iterations=150", "checkpoint.every=5")
JOBS = ("seed=1,2", "reward=paper,paper_literal")
SLURM = (
    *("hydra/launcher=slurm", "hydra.launcher.cpus=1", "hydra.launcher.mem_gb=1.5", "hydra.launcher.poll_s=0.5"),
    *("hydra.launcher.time_min=10", "hydra.launcher.partition=cpu"),
)


@pytest.fixture(scope="module")
def variables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with slurm_cluster.of_a_test(tmp_path_factory.mktemp("slurm")) as needed:
        yield needed


@pytest.fixture
def start(tmp_path: Path, variables: dict[str, str]) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts ``go1exp train``, which writes to ``output.txt``; ends it where the test did not."""
    started = []

    def begin(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "go1exp", "train", *arguments]
        with (tmp_path / "output.txt").open("w") as output:
            where: dict[str, Any] = {"cwd": tmp_path, "env": environment(**variables)}
            started.append(subprocess.Popen(command, text=True, stdout=output, stderr=subprocess.STDOUT, **where))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
            process.wait()


def until(holds: Callable[[], bool], seconds: float = 240.0) -> None:
    limit = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.1)


def warn(sweep: Path, run: str, variables: dict[str, str]) -> None:
    """Send what Slurm sends before a time limit."""
    everything = {**os.environ, **variables}
    job = json.loads((sweep / "slurm/jobs.json").read_text())[run]
    queue = subprocess.run(["squeue", "-h", "-r", "-o", "%i %A"], capture_output=True, text=True, env=everything)
    number = dict(line.split() for line in queue.stdout.splitlines())[job]
    with suppress(subprocess.TimeoutExpired):  # it tries again while the job, which heard it, is on its way back
        subprocess.run(["scancel", "--signal=USR2", number], env=everything, check=True, timeout=2.0)


def weights(run: Path) -> dict[str, torch.Tensor]:
    state = torch.load(run / "checkpoints/000150.pt", weights_only=False)
    policy: dict[str, torch.Tensor] = state["policy"]
    return policy


def has_checkpoint(run: Path) -> bool:
    return (run / ".holder.json").is_file() and any((run / "checkpoints").glob("*.pt"))


def test_jobs_that_are_killed_and_requeued_learn_bit_for_bit_what_they_learn_on_one_machine(
    tmp_path: Path, variables: dict[str, str], start: Callable[..., subprocess.Popen[str]]
) -> None:
    sweep = tmp_path / "sweep"
    process = start("-m", *JOBS, *LONGER, *SLURM, "hydra.sweep.dir=sweep")
    warned, killed = sweep / "seed-1_reward-paper", sweep / "seed-2_reward-paper"
    until(lambda: has_checkpoint(warned))
    warn(sweep, warned.name, variables)
    until(lambda: has_checkpoint(killed))
    os.kill(json.loads((killed / ".holder.json").read_text())["pid"], signal.SIGKILL)
    assert process.wait(timeout=500) == 1, (tmp_path / "output.txt").read_text()

    text = (tmp_path / "output.txt").read_text()
    assert "Traceback" not in text
    states = {
        job["run_folder"]: (job["state"], job["cause"])
        for job in json.loads((sweep / "sweep.json").read_text())["jobs"]
    }
    assert states.pop(killed.name) == ("failed", "killed by SIGKILL")
    assert {*states.values()} == {("done", "")}
    log = (warned / "job.log").read_text()
    assert "stopping after this iteration, with a checkpoint" in log
    assert re.search(r"continuing from .*\.pt", log)
    finished = (warned / "metrics.csv").stat().st_mtime_ns

    (line,) = re.findall(r"^go on with: go1exp train (.*)$", text, re.MULTILINE)
    again = start(line)
    assert again.wait(timeout=300) == 0, (tmp_path / "output.txt").read_text()
    assert "1 of 4 jobs to run" in (tmp_path / "output.txt").read_text()
    assert (warned / "metrics.csv").stat().st_mtime_ns == finished

    alone = run_alone(tmp_path, "train", "-m", *JOBS, *LONGER, "hydra.sweep.dir=alone")
    assert alone.returncode == 0, alone.stderr
    for run in sorted(sweep.glob("seed-*")):
        other = tmp_path / "alone" / run.name
        assert (run / "metrics.csv").read_bytes() == (other / "metrics.csv").read_bytes(), run.name
        here, there = weights(run), weights(other)
        assert all(torch.equal(here[name], there[name]) for name in there), run.name


def test_a_sweep_leaves_its_jobs_in_the_queue_and_finds_them_again(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    """Ctrl-C without a terminal: nobody can say whether to cancel, so nothing is cancelled."""
    process = start("-m", "seed=1,2,3", *LONGER, *SLURM, "hydra.sweep.dir=sweep")
    until(lambda: has_checkpoint(tmp_path / "sweep/seed-1"))
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert "jobs stay in the queue" in (tmp_path / "output.txt").read_text()
    again = start("sweep=sweep")
    assert again.wait(timeout=500) == 0, (tmp_path / "output.txt").read_text()
    assert "3 jobs are in the queue already" in (tmp_path / "output.txt").read_text()
    logs = [(tmp_path / f"sweep/seed-{seed}/job.log").read_text() for seed in (1, 2, 3)]
    assert [log.count("run folder") for log in logs] == [1, 1, 1]


def test_what_slurm_refuses_is_one_line(tmp_path: Path, variables: dict[str, str]) -> None:
    wrong = run_alone(
        tmp_path, "train", "-m", "seed=1,2", *SLURM, "hydra.launcher.partition=gpu", SLURM_CONF=variables["SLURM_CONF"]
    )
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1), wrong.stderr
    assert "hydra.launcher.partition = 'gpu': no such partition; there are cpu" in wrong.stderr
    gone = str(tmp_path / "slurm.conf")
    nobody = run_alone(tmp_path, "train", "-m", "seed=1,2", *SLURM, SLURM_CONF=gone)
    assert (nobody.returncode, nobody.stderr.count("\n")) == (1, 1), nobody.stderr
    assert "slurm: the controller does not answer" in nobody.stderr
    assert list(tmp_path.iterdir()) == []
