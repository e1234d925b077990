"""The command line as users start it, in a new interpreter; and that a fork of a prepared one is no different."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from go1exp import __version__
from tests.command import LIGHT, WARM, WITH_MODULES, run, run_alone
from tests.test_cli import HEAVY

SMOKE = {
    "train ppo.iteratons=7": "did you mean 'ppo.iterations'",
    "gap logs=x stage=fit search.alpha=2": "search.alpha = 2",
}
MORE = {
    "train -m ppo.gamma=1.5,2.5": "ppo.gamma = 1.5",
    "record audit": "files: required",
    "deploy a.zip sim.los=0.1": "did you mean 'sim.loss'",
    "train +reward.foot_slp={weight:1}": "did you mean 'foot_slip'",
    "eval run=x episodes=0": "episodes = 0",
    "play run=x +grid.x=[1]": "grid: unknown key",
    "record excitation=[chrip]": "did you mean 'chirp'?",
    "record import go2_in_aire x": "did you mean 'go2_in_air'?",
    "fit-actuator recordings=x history=0 share=leg": "history = 0",
    "export run=nowhere seconds=0": "seconds = 0",
    "export check": "file: required",
    "list efects": "did you mean 'effect'",
    "bench suite=fast": "suite = 'fast'",
}
"""Forked from a process without torch; tests/test_cli.py has more refusals, in its own process."""


@pytest.mark.parametrize("words", [*SMOKE, *MORE])
def test_the_real_command_refuses_at_once_and_loads_nothing_heavy(words: str, tmp_path: Path) -> None:
    here, modules = tmp_path / "here", tmp_path / "modules.json"
    here.mkdir()
    start = run_alone if words in SMOKE else partial(run, preload=LIGHT)
    done = start(here, *words.split(), code=WITH_MODULES, MODULES=str(modules))
    assert (done.returncode, done.stdout) == (2, "")
    assert re.search(r"^go1exp( [\w-]+){1,2}: ", done.stderr, re.MULTILINE)
    assert (SMOKE | MORE)[words] in done.stderr
    assert "Traceback" not in done.stderr
    assert not HEAVY & set(json.loads(modules.read_text()))
    assert list(here.rglob("config.yaml")) == []


def test_the_command_line_is_a_module_too() -> None:
    done = subprocess.run([sys.executable, "-m", "go1exp", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"go1exp {__version__}\n"


@pytest.mark.parametrize("preload", [LIGHT, WARM], ids=["light", "warm"])
def test_a_fork_answers_as_a_new_interpreter_does(preload: str, tmp_path: Path) -> None:
    code = (
        "import os, sys\nprint(sys.argv[1:], os.getcwd(), os.environ['WORD'], sys.stdin.read())\n"
        "print('wrong', file=sys.stderr)\nos.system('echo child')\nsys.exit({})"
    )
    for leaving in ("0", "3", "None", "'words'"):
        given = (tmp_path, "a b", "ç")
        alone = run_alone(*given, code=code.format(leaving), WORD="ü")
        forked = run(*given, code=code.format(leaving), preload=preload, WORD="ü")
        assert forked.returncode == alone.returncode
        assert sorted(forked.stdout.splitlines()) == sorted(alone.stdout.splitlines())
        assert forked.stderr.splitlines()[0] == "wrong"


def test_an_error_in_a_fork_is_a_traceback_and_a_signal_its_status(tmp_path: Path) -> None:
    broken = run(tmp_path, code="print('before'); 1 / 0", preload=LIGHT)
    assert (broken.returncode, broken.stdout) == (1, "before\n")
    assert broken.stderr.splitlines()[-1] == "ZeroDivisionError: division by zero"
    for name in ("SIGINT", "SIGTERM", "SIGKILL"):
        code = f"import os, signal; os.kill(os.getpid(), signal.{name}); import time; time.sleep(9)"
        assert run(tmp_path, code=code, preload=LIGHT).returncode == -getattr(signal, name)


def test_a_fork_that_hangs_is_given_up(tmp_path: Path) -> None:
    begin = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        run(tmp_path, code="import time; time.sleep(30)", preload=LIGHT, timeout=0.5)
    assert time.monotonic() - begin < 20.0
    assert run(tmp_path, code="print('again')", preload=LIGHT).stdout == "again\n"
