"""A sweep is checked before it starts, outlives its failures, stops when it is told to, and goes on with one line."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from go1exp.train import run_state
from tests.command import run as cli
from tests.small_run import SMALL

BAD_DAY = """
import errno, os, signal, sys
from go1exp.cli import main
from go1exp.train import trainer
from go1exp.train.metrics import CsvWriter
train, write = trainer.train, CsvWriter.write
def train_or_fail(config, *rest):
    if config.process.seed == 2:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "some/file")
    if config.process.seed == 3:
        def interrupted(self, *row):
            write(self, *row)
            os.kill(os.getpid(), signal.SIGINT)
        CsvWriter.write = interrupted
    return train(config, *rest)
trainer.train = train_or_fail
sys.exit(main())
"""


def table(text: str) -> dict[int, str]:
    """Number of a job -> its state."""
    return {int(n): state.strip() for n, state in re.findall(r"^ +(\d+)  (.{11})  seed=", text, re.MULTILINE)}


@pytest.mark.slow("go1exp/cli/", "go1exp/train/", "go1exp/signals.py")
def test_a_sweep_outlives_a_failure_stops_at_ctrl_c_and_goes_on_with_the_line_that_it_prints(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "-m", "seed=1,2,3,4", *SMALL, code=BAD_DAY)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert table(done.stdout) == {0: "done", 1: "failed", 2: "stopped", 3: "not started"}
    assert "No space left on device: some/file" in done.stderr
    assert "seed=2  (No space left on device: some/file)" in done.stdout
    assert done.stderr.endswith("go1exp train: stopped\n")
    (line,) = re.findall(r"^go on with: go1exp (.*)$", done.stdout, re.MULTILINE)

    (sweep,) = (tmp_path / "runs").iterdir()
    first = (sweep / "0/metrics.csv").read_bytes()
    again = cli(tmp_path, *shlex.split(line))
    assert again.returncode == 0, again.stderr
    assert table(again.stdout) == {0: "done", 1: "done", 2: "done", 3: "done"}
    assert "go on with" not in again.stdout
    assert f"{sweep / '0'} has its 2 iterations already" in again.stdout
    assert f"continuing from {sweep / '2/checkpoints/000001.pt'}" in again.stdout
    assert (sweep / "0/metrics.csv").read_bytes() == first
    assert [run_state.read(sweep / str(n)).state for n in range(4)] == ["done"] * 4


def test_every_job_is_checked_before_the_first_one_starts(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "-m", "seed=1,-2", "ppo.gamma=0.9,1.5,2.5", "reward=paper,papper", *SMALL)
    assert done.returncode == 2, done.stdout
    first, *problems = done.stderr.splitlines()
    assert first == "go1exp train: 4 problems"
    assert sorted(line.split(":")[0].strip() for line in problems) == [
        "ppo.gamma = 1.5",
        "ppo.gamma = 2.5",
        "reward=papper",
        "seed = -2",
    ]
    assert any("(job 1: seed=1 ppo.gamma=0.9 reward=papper; and 5 more)" in line for line in problems), done.stderr
    assert list(tmp_path.iterdir()) == []
