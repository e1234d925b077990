"""Names of run folders, states of jobs, shares of cores: what sweeps stand on, without a training."""

from __future__ import annotations

import contextlib
import re
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from go1exp.base.paths import data_root
from go1exp.cli import hydra_main, sweep
from go1exp.cli.train import APP as TRAIN
from go1exp.cli.tune import _ranges
from go1exp.config.schema.registry import ConfigError
from go1exp.train import run_state
from go1exp.train.early_stop import logged
from go1exp.train.sweep import index
from go1exp.train.sweep.command import Command, Running, Task, run
from go1exp.train.sweep.launchers import LAUNCHERS, chosen, shares
from go1exp.train.sweep.slurm import Slurm
from go1exp.train.sweep.tune import Range

CONF = data_root() / "conf"


def test_what_jobs_need_is_checked_once_without_comparing_each_with_all_others(tmp_path: Path) -> None:
    """Their number is up to 10,000; a seed alone changes nothing that they need."""
    checked, compared = list[str](), list[object]()

    class Setting(str):
        def __eq__(self, other: object) -> bool:
            compared.append(other)
            return super().__eq__(other)

        __hash__ = str.__hash__

    def resolve(container: dict[str, Any], overrides: list[str], run: Path) -> Any:
        return SimpleNamespace(container={"gamma": Setting(container["ppo"]["gamma"]), "seed": container["seed"]})

    def check(job: Any) -> None:
        checked.append(str(job.container["gamma"]))
        raise ConfigError(["out of memory"])

    def never(*_: Any) -> Any:
        raise AssertionError

    gammas = [f"0.9{k}" for k in range(1, 7)]
    jobs = [[f"ppo.gamma={gamma}", f"seed={seed}"] for seed in (0, 1) for gamma in gammas]
    asked = hydra_main.Sweep(tmp_path / "sweep", jobs, {"name": "basic"})
    with pytest.raises(ConfigError, match="out of memory"):
        sweep.begin(sweep.Rules(resolve, check, never, never, never), TRAIN, [], asked)
    assert checked == gammas
    assert not compared


def test_folders_are_named_by_overrides() -> None:
    assert index.folder_names(
        ["seed=0", "+experiment/ablation=no_gait seed=1", "ppo.hidden=[16,8]", "~reward.gait", "", "seed=0"]
    ) == ["seed-0", "ablation-no_gait_seed-1", "ppo.hidden-16-8", "no-reward.gait", "run", "seed-0-2"]


@given(st.lists(st.text(max_size=200), max_size=20))
def test_no_two_jobs_share_a_folder_and_no_name_needs_quotes(names: list[str]) -> None:
    folders = index.folder_names(names)
    assert len({*folders}) == len(names)
    assert all(f and len(f) <= index.LONGEST + 3 and not set(f) - PLAIN and not f.startswith(".") for f in folders)


PLAIN = {*"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-"}


def test_a_job_is_what_its_run_folder_says(tmp_path: Path) -> None:
    jobs = tuple(index.Job(n, f"seed={n}", (f"seed={n}",), f"seed-{n}") for n in range(6))
    index.write(tmp_path, index.Index(jobs, {"name": "basic"}, str(tmp_path)))
    for n, state in enumerate(("done", "stopped", "failed", "running")):
        (tmp_path / f"seed-{n}").mkdir()
        run_state.write(tmp_path / f"seed-{n}", state, "full disk" if state == "failed" else "")  # type: ignore[arg-type]
    with run_state.locked(tmp_path / "seed-3"):
        known = index.read(tmp_path)
    assert [(j.state, j.cause) for j in known.jobs] == [
        ("done", ""),
        ("waiting", "stopped; goes on from its checkpoint"),
        ("failed", "full disk"),
        ("running", ""),
        ("waiting", ""),
        ("waiting", ""),
    ]
    assert index.read(tmp_path).jobs[3].cause == run_state.KILLED
    heard = index.looked_at(known, tmp_path, {"seed-3": "killed by SIGKILL", "seed-4": "No space left on device"})
    assert [(j.state, j.cause) for j in heard.jobs[3:5]] == [
        ("failed", "killed by SIGKILL"),
        ("failed", "No space left on device"),
    ]


@pytest.mark.parametrize(
    ("at_once", "threads", "expected"),
    [
        (1, 0, [(0, 1, 2, 3)]),
        (2, 0, [(0, 1), (2, 3)]),
        (4, 0, [(0,), (1,), (2,), (3,)]),
        (6, 0, [(0,), (1,), (2,), (3,), (0,), (1,)]),
        (2, 3, [(0, 1, 2), (0, 1, 3)]),
    ],
)
def test_cores_are_shared_out(at_once: int, threads: int, expected: list[tuple[int, ...]]) -> None:
    assert shares([0, 1, 2, 3], at_once, threads) == expected


def test_a_job_may_not_have_more_cores_than_there_are() -> None:
    with pytest.raises(ConfigError, match=r"hydra\.launcher\.threads = 5: this process may use 4 cores"):
        shares([0, 1, 2, 3], 1, 5)


def test_a_command_logs_what_it_prints_and_says_how_it_ended(tmp_path: Path) -> None:
    def command(code: str, log: str = "log") -> Command:
        return Command((sys.executable, "-c", code), str(tmp_path), str(tmp_path / log), {"WORD": "there"})

    how = run(command("import os; print('one'); print(os.environ['WORD']); raise SystemExit(3)"))
    assert (how.status, how.last_line, how.cause) == (3, "there", "there")
    assert (tmp_path / "log").read_text() == "one\nthere\n"
    assert run(command("pass")).cause == ""
    assert run(command("import os; os.kill(os.getpid(), 9)")).cause == "killed by SIGKILL"
    assert run(command("print('full disk'); raise SystemExit(1)", log="nowhere/log")).cause == "full disk"


def test_a_command_that_is_stopped_says_its_last_words(tmp_path: Path) -> None:
    code = (
        "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: (print('\\nsaved'), sys.exit(130))); "
        "print('ready', flush=True); time.sleep(60)"
    )
    running = Running(Command((sys.executable, "-c", code), str(tmp_path), str(tmp_path / "log")))
    ended = []
    waiting = threading.Thread(target=lambda: ended.append(running.wait()))
    waiting.start()
    while not (tmp_path / "log").exists() or "ready" not in (tmp_path / "log").read_text():
        time.sleep(0.02)
    running.stop(signal.SIGTERM)
    waiting.join(20.0)
    assert (ended[0].status, ended[0].last_line) == (130, "saved")


def test_every_launcher_has_a_file() -> None:
    assert chosen({"_target_": f"{BasicLauncher.__module__}.{BasicLauncher.__name__}"}).name == "basic"
    files = {file.stem: _with_defaults(file) for file in (CONF / "launcher").glob("*.yaml")}
    assert {*LAUNCHERS} == {*files} - {"slurm_gpu"}
    assert {name: chosen(content).name for name, content in files.items()} == {
        name: "slurm" if name == "slurm_gpu" else name for name in files
    }
    assert (chosen(files["slurm_gpu"]).partition, chosen(files["slurm_gpu"]).gpus) == ("gpu", 1)


def _with_defaults(file: Path) -> dict[str, Any]:
    """Return the content of a file over that of the files that its ``defaults`` name."""
    content: Any = OmegaConf.to_container(OmegaConf.load(file))
    below = [_with_defaults(file.with_name(f"{name}.yaml")) for name in content.pop("defaults", [])]
    return {key: value for each in (*below, content) for key, value in each.items()}


def test_a_gpu_and_its_partition_reach_sbatch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slurm = pytest.importorskip("submitit.slurm.slurm")
    asked: dict[str, Any] = {}

    class Executor:
        def __init__(self, **given: Any) -> None:
            self.batch = contextlib.nullcontext

        def update_parameters(self, **given: Any) -> None:
            asked.update(given)

        def submit(self, job: Any) -> Any:
            return SimpleNamespace(job_id="7_0")

    monkeypatch.setattr("submitit.SlurmExecutor", Executor)
    settings = chosen({**_with_defaults(CONF / "launcher/slurm_gpu.yaml"), "options": {"constraint": "a100"}})
    task = Task("seed=0", "seed-0", Command(("true",), str(tmp_path), "log"), lambda: None)
    assert Slurm(settings)._submitted(tmp_path, "study", [task]) == {"seed-0": "7_0"}
    script = slurm._make_sbatch_string(command="true", folder=tmp_path, **asked)
    options = dict(re.findall(r"^#SBATCH --([\w-]+)=(.*)$", script, re.MULTILINE))
    assert {name: options[name] for name in ("partition", "gpus-per-node", "cpus-per-task", "mem", "time")} == {
        "partition": "gpu",
        "gpus-per-node": "1",
        "cpus-per-task": "8",
        "mem": "32768M",
        "time": "720",
    }
    assert (options["signal"], options["constraint"]) == ("USR2@120", "a100")


def test_ranges_are_read_in_the_grammar_of_sweeps() -> None:
    assert _ranges(["a=interval(0.5,2)", "b=tag(log,interval(1e-4,1e-2))", "c=range(2,8)", "d=choice(x,8)"]) == {
        "a": Range(low=0.5, high=2),
        "b": Range(low=1e-4, high=1e-2, log=True),
        "c": Range(low=2, high=7, step=1),
        "d": Range(choices=("x", "8")),
    }


def test_a_row_that_is_half_written_has_no_value_yet(tmp_path: Path) -> None:
    file = tmp_path / "metrics.csv"
    assert list(logged(tmp_path, "a")) == []
    file.write_text("iteration,steps,a\n1,16,0.5\n2,32,\n3,48,nan\n4,64,2.0\n5,80,3")
    assert list(logged(tmp_path, "a")) == [(1, 0.5), (4, 2.0)]
    assert list(logged(tmp_path, "b")) == []
