"""Ctrl-C, SIGTERM and the end of a terminal: one line and status 130, whatever the process is doing."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command import COMMAND_LINE, run_alone

WHILE_LOADING = """
import os, signal, sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{name})
sys.meta_path.insert(0, Interrupt())
{program}
"""
WORKING = pytest.mark.slow("go1exp/cli/", "go1exp/base/signals.py", "go1exp/evaluate/", "go1exp/logs/record/")
RUNTIME = "from go1exp.deploy.__main__ import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize(
    ("arguments", "module", "name", "announced"),
    [
        ("gap logs=nowhere", "hydra", "SIGINT", ""),
        pytest.param("eval policy=paper", "torch", "SIGINT", "evaluating ...\n", marks=WORKING),
        pytest.param("play policy=paper", "mujoco", "SIGHUP", "recording a video ...\n", marks=WORKING),
        pytest.param("record", "mujoco", "SIGTERM", "recording ...\n", marks=WORKING),
        ("train", "stable_baselines3", "SIGINT", ""),
        ("deploy nowhere.zip", "numpy", "SIGINT", ""),
    ],
)
def test_a_signal_at_any_time_is_one_line_and_a_status(
    arguments: str, module: str, name: str, announced: str, tmp_path: Path
) -> None:
    code = WHILE_LOADING.format(module=module, name=name, program=COMMAND_LINE)
    done = run_alone(tmp_path, *arguments.split(), code=code)
    assert (done.returncode, done.stderr) == (130, f"{announced}go1exp {arguments.split()[0]}: stopped\n")
    assert not list(tmp_path.rglob(".hydra"))


def test_the_runtime_of_the_robot_ends_with_one_line_too(tmp_path: Path) -> None:
    code = WHILE_LOADING.format(module="numpy", name="SIGHUP", program=RUNTIME)
    done = run_alone(tmp_path, "nowhere.zip", code=code)
    assert (done.returncode, done.stderr) == (130, "go1exp.deploy: stopped\n")
