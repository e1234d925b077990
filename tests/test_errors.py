"""The end of a command in one line and a status, whatever ends it; the table of statuses."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import go1exp
from go1exp.base import errors
from go1exp.base.errors import AUDIT, DOES_NOT_HOLD, EXIT_CODES, FAULTS, NOT_SEPARABLE, STATUSES, Expected
from go1exp.cli import app, helptext
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.runtime import walk
from go1exp.deploy.runtime.bundle import BundleError
from go1exp.deploy.runtime.launch import RefusedError
from go1exp.deploy.runtime.safety import RULES
from go1exp.logs.recording import RecordingError
from go1exp.train.checkpoint import DamagedCheckpoint
from tests.command import environment, refuse
from tests.small_run import small
from tests.test_readme import reference


def test_every_status_has_one_row_in_the_reference(tmp_path: Path) -> None:
    used = [*EXIT_CODES.values(), *AUDIT.values(), *walk.STATUS.values(), walk.UNKNOWN_FAULT]
    used += [errors.FAILED, errors.REFUSED, errors.STOPPED, errors.READER_LEFT, DOES_NOT_HOLD, NOT_SEPARABLE]
    assert {*used} == {*STATUSES}
    assert FAULTS[: len(RULES)] == tuple(RULES)
    rows = re.findall(r"^\| (\d+) \| ([\w ]+) \| (.+) \|$", reference()._statuses(), re.MULTILINE)
    assert [(int(status), verb) for status, verb, _ in rows] == [(s, verb) for s, (verb, _) in STATUSES.items()]


def test_the_table_of_the_method_is_that_of_the_verb() -> None:
    page = (Path(go1exp.__file__).parent.parent / "docs/gap.md").read_text()
    rows = {verdict: int(status) for status, verdict in re.findall(r"^\| (\d+) \| `([\w ]+)` \|", page, re.MULTILINE)}
    assert rows == EXIT_CODES


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (ConfigError(["a = 1: wrong"]), 2, "a = 1: wrong"),
        (ConfigError(["a", "b"]), 2, "2 problems\n  a\n  b"),
        (RefusedError(["a", "b"]), 2, "2 problems\n  a\n  b"),
        (RecordingError("x: damaged"), 2, "x: damaged"),
        (DamagedCheckpoint("x: damaged"), 2, "x: damaged"),
        (BundleError("x: damaged"), 2, "x: damaged"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "No space left on device"),
        (OSError(errno.EIO, "Input/output error", "a.zip"), 1, "Input/output error: a.zip"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", b"a.zip"), 2, "No such file or directory: a.zip"),
        (PermissionError(errno.EACCES, "Permission denied", Path("a")), 2, "Permission denied: a"),
        (FileNotFoundError("a: not a run folder"), 2, "a: not a run folder"),
        (OSError(errno.EROFS, "Read-only file system", "a\nb\x1b"), 2, r"Read-only file system: a\nb\x1b"),
        (ConfigError(["a\nb = 1: wrong"]), 2, r"a\nb = 1: wrong"),
        (RuntimeError("Symlink loop from 'a'"), 2, "Symlink loop from 'a'"),
        (ModuleNotFoundError(name="hydra"), 2, f"{sys.executable} has no package 'hydra'; activate the environment"),
        (MemoryError(), 1, "out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 1, "out of memory: DefaultCPUAllocator: can't"),
        (KeyboardInterrupt(), 130, "stopped"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 141, ""),
    ],
)
def test_an_error_ends_every_verb_with_its_status_and_line(
    error: BaseException, status: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(container: dict[str, Any]) -> None:
        raise error

    monkeypatch.setattr(helptext, "APP", app.App("list", fail, helptext.ListSettings))
    done = refuse(tmp_path, "list")
    assert done.returncode == status
    assert done.stderr.startswith(f"go1exp list: {said}" if said else "")
    assert done.stderr.count("\n") == said.count("\n") + bool(said)
    assert done.stdout == ""


def test_a_fault_is_one_line_that_names_the_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(container: dict[str, Any]) -> None:
        raise KeyError("knee")

    monkeypatch.setattr(helptext, "APP", app.App("list", fail, helptext.ListSettings))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    done = refuse(tmp_path, "list")
    line = re.fullmatch(
        r"go1exp list: fault in go1exp: KeyError: 'knee' in test_errors.py:\d+ \(traceback: (.+)\)\n", done.stderr
    )
    assert line, done.stderr
    assert done.returncode == 1
    assert "Traceback" in Path(line[1]).read_text()


PLUGIN = """
from go1exp.extend import Snapshot, TermSetup, observation, reward
@{term}
{body}
"""
REWARD = "def mine(s):\n    '''Mine.'''\n    "
OBSERVATION = "class Mine:\n    '''Mine.'''\n    def __init__(self, setup):\n        "


@pytest.mark.parametrize(
    ("body", "status", "said"),
    [
        ("def mine(s, *, a, b=3):\n    '''Mine.'''", 2, "parameter 'a' needs a type"),
        ("def mine(s, *, a: 'Lngth'):\n    '''Mine.'''", 2, "has no usable type (name 'Lng"),
        (f"{REWARD}return 3", 2, "reward.mine: gives int, must"),
        (f"{REWARD}raise RuntimeError('boom')", 1, "reward.mine (mine.py:6): RuntimeError: boom"),
        (f"{OBSERVATION}1 / 0", 1, "observation.mine (mine.py:7): ZeroDivisionError: division by zero"),
    ],
)
def test_a_wrong_term_of_a_user_is_named(body: str, status: int, said: str, tmp_path: Path) -> None:
    kind, more, value = ("reward", "", ".weight=1") if body.startswith("def") else ("observation", ", size=1", "={}")
    (tmp_path / "mine.py").write_text(PLUGIN.format(term=f"{kind}('mine'{more})", body=body))
    words = ["train", "plugins=[mine.py]", f"+{kind}.mine{value}", *small("ppo=paper"), "hydra.run.dir=run"]
    done = refuse(tmp_path, *words)
    assert said in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.returncode == status


def test_choices_of_ones_own_that_are_no_yaml_or_lead_back_are_refused_by_file(tmp_path: Path) -> None:
    folder = tmp_path / "own/reward"
    folder.mkdir(parents=True)
    contents = {"broken": b"gait: [1", "latin": b"a: \xe9", "number": b"5", "alias": b"a: &a [*a]"}
    contents |= {"itself": b"defaults: [itself]", "one": b"defaults: [other]", "other": b"defaults: [one]"}
    said = {
        "broken": "no YAML (line ",
        "latin": "not UTF-8",
        "number": "must be a mapping",
        "alias": "an alias leads back",
    }
    for name, content in contents.items():
        (folder / f"{name}.yaml").write_bytes(content)
    for name in contents:
        done = refuse(tmp_path, "train", "--config-dir", "own", f"reward={name}")
        assert done.returncode == 2
        assert done.stderr.startswith(f"go1exp train: {folder}/")
        assert said.get(name, "its defaults lead back to itself") in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("script", "status", "said"),
    [
        ("$GO1EXP list >&-", 1, "go1exp list: standard output is closed; use >/dev/null for none\n"),
        ("$GO1EXP --help >/dev/full", 1, "go1exp --help: No space left on device\n"),
        ("$GO1EXP trian 2>&-", 2, ""),
        ("$GO1EXP --version >/dev/null <&- 2>&-", 0, ""),
    ],
)
def test_closed_and_full_streams_are_one_line(script: str, status: int, said: str, tmp_path: Path) -> None:
    variables = environment(GO1EXP=f"{sys.executable} -m go1exp")
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=variables, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (status, said)


def test_a_gl_library_that_mujoco_cannot_load_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(RuntimeError) as raised:
        exec(compile("raise RuntimeError('x')", "mujoco/gl_context.py", "exec"))
    answer = app.explained(raised.value)
    assert answer
    assert answer[0] == 2
    assert answer[1].startswith("MUJOCO_GL=nonsense: MuJoCo cannot load this GL library")


def test_ctrl_c_within_text_that_is_executed_has_the_same_status(tmp_path: Path) -> None:
    (tmp_path / "ours.py").write_text(
        "import sys\nfrom unittest import mock\nfrom go1exp import cli\n"
        "with mock.patch.object(cli, '_run', lambda *_: exec('raise KeyboardInterrupt')):\n    sys.exit(cli.main())\n"
    )
    done = subprocess.run([sys.executable, "-m", "ours"], cwd=tmp_path, env=environment(), capture_output=True)
    assert done.returncode == 130, done.stderr


def test_ctrl_c_at_any_time_is_one_line(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "go1exp", "bench", "suite=env", "num_envs=4", "seconds=60"]
    with subprocess.Popen(
        words, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as bench:
        assert bench.stderr is not None
        assert bench.stderr.readline() == "measuring env ...\n"
        time.sleep(1.0)
        os.killpg(bench.pid, signal.SIGINT)
        assert bench.stderr.read() == "go1exp bench: stopped\n"
        assert bench.wait(30.0) == 130


def test_what_ends_is_explained_where_hydra_is_not_loaded() -> None:
    assert errors.explained(Expected("x")) == (1, "x")
    assert errors.explained(KeyError("x")) is None
