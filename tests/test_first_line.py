"""What takes seconds to load comes after the line that says what begins, and torch only where it computes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.command import LIGHT
from tests.command import run as cli
from tests.test_bad_input import made

WALLED = """
import os, sys
from go1exp.cli import main
class Wall:
    def find_spec(self, name, path=None, target=None):
        if name in os.environ["WALLED"].split():
            raise ImportError(f"{name} is loaded")
sys.meta_path.insert(0, Wall())
sys.exit(main())
"""
"""The command line, where the modules of ``$WALLED`` cannot be loaded."""


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("record excitation=[drop]", "recording ..."),
        ("export policy=paper", "recording a trace ..."),
        ("sim address=127.0.0.1:0 seconds=0.1", "starting the simulated robot ..."),
        ("fit-actuator recordings=logs", "fitting ..."),
    ],
)
def test_a_verb_says_what_begins_before_it_loads_what_takes_seconds(words: str, line: str, tmp_path: Path) -> None:
    for k in range(4):
        made(tmp_path / "logs", f"a{k}", rows=60)
    done = cli(tmp_path, *words.split(), code=WALLED, preload=LIGHT, WALLED="torch._C mujoco scipy.stats")
    assert done.stderr.splitlines()[0] == line
    assert "is loaded" in done.stderr


def test_an_audit_loads_no_torch(tmp_path: Path) -> None:
    words = ("record", "audit", str(made(tmp_path / "logs", "a", rows=500)))
    done = cli(tmp_path, *words, code=WALLED, preload=LIGHT, WALLED="torch._C mujoco")
    assert (done.returncode, done.stderr) in ((0, ""), (3, ""), (4, "")), done.stderr
