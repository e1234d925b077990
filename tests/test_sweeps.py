"""A sweep is checked before it starts, outlives its failures, stops when it is told to, and goes on with one line."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from go1exp.train import run_state
from tests.command import LIGHT
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
    return {int(n): state.strip() for n, state in re.findall(r"^ +(\d+)  (.{8})  seed=", text, re.MULTILINE)}


@pytest.mark.slow("go1exp/cli/", "go1exp/train/", "go1exp/base/signals.py")
def test_a_sweep_outlives_a_failure_stops_at_ctrl_c_and_goes_on_with_the_line_that_it_prints(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "-m", "seed=1,2,3,4", *SMALL, code=BAD_DAY)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert table(done.stdout) == {0: "done", 1: "failed", 2: "waiting", 3: "waiting"}
    assert "No space left on device: some/file" in done.stderr
    assert "seed=2  (No space left on device: some/file)" in done.stdout
    assert done.stderr.endswith("go1exp train: stopped\n")
    (line,) = re.findall(r"^go on with: go1exp (.*)$", done.stdout, re.MULTILINE)

    (sweep,) = (tmp_path / "runs").iterdir()
    first = (sweep / "seed-1/metrics.csv").read_bytes()
    again = cli(tmp_path, *shlex.split(line))
    assert again.returncode == 0, again.stderr
    assert table(again.stdout) == {0: "done", 1: "done", 2: "done", 3: "done"}
    assert "go on with" not in again.stdout
    assert "3 of 4 jobs to run" in again.stdout
    assert f"continuing from {sweep / 'seed-3/checkpoints/000001.pt'}" in again.stdout
    assert (sweep / "seed-1/metrics.csv").read_bytes() == first
    assert [run_state.read(sweep / f"seed-{n}").state for n in range(1, 5)] == ["done"] * 4


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


ONE_AND_TWO = ("train", "-m", "seed=1,2", *SMALL, "hydra.sweep.dir=sweep")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two jobs that the launcher joblib has run."""
    place = tmp_path_factory.mktemp("joblib")
    done = cli(place, *ONE_AND_TWO, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    assert done.returncode == 0, done.stderr
    return place / "sweep"


def test_jobs_at_once_learn_bit_for_bit_what_they_learn_alone(sweep: Path, tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "seed=2", *SMALL, "hydra.run.dir=alone")
    assert done.returncode == 0, done.stderr
    assert (sweep / "seed-2/metrics.csv").read_bytes() == (tmp_path / "alone/metrics.csv").read_bytes()
    assert "run folder" in (sweep / "seed-2/job.log").read_text()


def test_the_index_says_which_jobs_there_are_and_what_became_of_them(sweep: Path) -> None:
    content = json.loads((sweep / "sweep.json").read_text())
    assert [(j["number"], j["name"], j["run_folder"], j["state"], j["cause"]) for j in content["jobs"]] == [
        (0, "seed=1", "seed-1", "done", ""),
        (1, "seed=2", "seed-2", "done", ""),
    ]
    assert content["jobs"][0]["overrides"][:2] == ["seed=1", "ppo.num_envs=4"]
    assert content["launcher"] == {"name": "joblib", "n_jobs": 2, "threads": 0}


def test_jobs_that_are_done_are_never_repeated(sweep: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in sweep.glob("*/*.csv")}
    again = cli(sweep.parent, "train", "sweep=sweep", preload=LIGHT)
    assert again.returncode == 0, again.stderr
    assert "0 of 2 jobs to run" in again.stdout
    assert {p: p.stat().st_mtime_ns for p in sweep.glob("*/*.csv")} == before


def test_two_sweeps_never_share_a_folder(sweep: Path) -> None:
    other = cli(sweep.parent, "train", "-m", "seed=1,2,3", *SMALL, "hydra.sweep.dir=sweep")
    assert other.returncode == 2
    assert "holds another sweep (2 jobs, the first of them 'seed=1')" in other.stderr
    with run_state.locked(sweep):
        meanwhile = cli(sweep.parent, "train", "sweep=sweep", preload=LIGHT)
    assert meanwhile.returncode == 1
    assert "in use by process" in meanwhile.stderr
    assert other.stderr.count("\n") == meanwhile.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train sweep=nowhere", "nowhere: not a sweep folder (it has no sweep.json)"),
        (
            "train -m seed=1,2 hydra/launcher=joblip",
            "hydra/launcher=joblip: unknown choice of hydra/launcher 'joblip'; did you mean 'joblib'?",
        ),
        ("train -m seed=1,2 hydra/launcher=joblib hydra.launcher.n_jobs=0", "n_jobs = 0"),
        ("train -m seed=1,2 hydra/launcher=joblib hydra.launcher.n_jobs=x", "hydra.launcher.n_jobs = 'x'"),
        ("train -m seed=1,2 hydra/launcher=joblib hydra.launcher.threads=999", "hydra.launcher.threads = 999"),
        ("train -m seed=1,2 hydra/launcher=joblib hydra.launcher.cores=2", "hydra.launcher.cores"),
        ("train -m sweep=a,b", "go without -m"),
        ("tune space=[]", "space: is empty"),
        ("tune 'space=[\"ppo.gamma=0.9\"]'", "space: 'ppo.gamma=0.9' is none of"),
        ("tune", "space: required"),
    ],
)
def test_what_is_wrong_with_a_sweep_is_one_line(line: str, message: str, tmp_path: Path) -> None:
    done = cli(tmp_path, *shlex.split(line), preload=LIGHT)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert [p for p in tmp_path.rglob("*") if p.name != "runs"] == []  # Hydra's folder of runs


def test_a_damaged_index_and_a_job_that_may_not_change_are_named(sweep: Path, tmp_path: Path) -> None:
    changed = cli(sweep.parent, "train", "sweep=sweep", "ppo.gamma=0.5", preload=LIGHT)
    assert changed.returncode == 2
    assert "ppo.gamma=0.5: a resumed run keeps its configuration" in changed.stderr
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep/sweep.json").write_text('{"format": 1, "jobs": [{"num')
    damaged = cli(tmp_path, "train", "sweep=sweep", preload=LIGHT)
    assert damaged.returncode == 1
    assert "sweep.json: is damaged" in damaged.stderr


def test_a_study_without_m_is_refused_with_the_line_to_type(tmp_path: Path) -> None:
    line = ("study=ablations", "seed=3", "hydra/launcher=joblib")
    done = cli(tmp_path, "train", *line, preload=LIGHT)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert f"study=ablations: is a sweep and needs -m: go1exp train -m {' '.join(line)}\n" in done.stderr
    assert [p for p in tmp_path.rglob("*") if p.name != "runs"] == []
    shown = cli(tmp_path, "train", *line, "--cfg", "job", preload=LIGHT)
    assert shown.returncode == 0, shown.stderr
    assert "iterations:" in shown.stdout


def test_a_sweep_that_would_never_begin_is_refused_at_once(tmp_path: Path) -> None:
    done = cli(tmp_path, "train", "-m", "seed=range(0,1000000000)", "ppo.gamma=0.9,0.99", preload=LIGHT)
    assert done.returncode == 2
    assert done.stderr.strip() == "go1exp train: seed=range(0,1000000000): a sweep has at most 10,000 jobs"


def test_what_the_command_line_says_of_a_key_replaces_what_a_study_says(tmp_path: Path) -> None:
    line = ("-m", "study=ablations", "backend=cpu", "seed=-1,-2", "+experiment/ablation=no_gait,no_latency")
    done = cli(tmp_path, "train", *line, preload=LIGHT)
    assert done.returncode == 2
    assert "seed = -1" in done.stderr
    assert "and 1 more" in done.stderr
    assert "and 2 more" not in done.stderr
