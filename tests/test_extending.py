"""docs/extending.md, followed literally: its files are written, its commands and programs run, with small budgets."""

from __future__ import annotations

import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from go1exp.base.paths import data_root
from go1exp.cli import main
from go1exp.config.schema import plugins
from go1exp.config.schema.registry import groups
from tests.small_run import SMALL

PAGE = data_root() / "docs/extending.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
BUDGET = {
    "train": [*SMALL, "ppo.iterations=1"],
    "record": ["seconds=0.5", "out=recordings"],
    "record import": [],
    "eval": ["episodes=1", "seconds=0.5", "settle_s=0.2", "grid.x=[0.5]", "grid.y=[]", "grid.yaw=[]"],
}


def files() -> dict[str, str]:
    """Name -> content; the blocks of one file stand one after the other."""
    texts: dict[str, str] = {}
    for kind, text in BLOCKS:
        if text.startswith("# @package"):
            texts["mine/experiment/calm.yaml"] = text
        first, _, rest = text.partition("\n")
        if kind in ("python", "yaml", "csv") and (match := re.fullmatch(r"# (\S+\.(?:py|yaml|csv))", first)):
            texts[match[1]] = texts.get(match[1], "") + (text if kind == "python" else rest)
    return texts


def commands() -> list[list[str]]:
    lines = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]
    return [shlex.split(line, comments=True) for line in lines]


def programs() -> list[str]:
    return [text for kind, text in BLOCKS if kind == "python" and not text.startswith("# ")]


@pytest.fixture(autouse=True)
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Stand in a folder with the page's files."""
    monkeypatch.chdir(tmp_path)
    for name, text in files().items():
        path = Path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    yield
    plugins.begin([])


def test_the_page_has_an_example_of_each_kind_of_term() -> None:
    (plugin,) = plugins.use(["my_terms.py"])
    # A protocol of a user is a file: docs/experiments.md.
    assert {entry.group for entry in plugin.entries} == set(groups()) - {"protocol"}
    text = " ".join(" ".join(words) for words in commands())
    assert [entry.name for entry in plugin.entries if entry.name not in text] == []


@pytest.mark.slow(
    "docs/extending.md",
    "go1exp/config/schema/",
    "go1exp/extend/__init__.py",
    "go1exp/extend/testing/",
    "go1exp/cli/app.py",
)
@pytest.mark.parametrize("words", [words for words in commands() if words[0] == "go1exp"], ids=" ".join)
def test_a_command_of_the_page_works(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    verb = " ".join(words[1:3]) if words[2] == "import" else words[1]
    monkeypatch.setattr(sys, "argv", [*words, *BUDGET.get(verb, [])])
    assert main() == 0, capsys.readouterr().err


@pytest.mark.slow(
    "docs/extending.md",
    "go1exp/config/schema/",
    "go1exp/extend/__init__.py",
    "go1exp/extend/testing/",
    "go1exp/cli/app.py",
)
def test_the_page_s_test_passes() -> None:
    (command,) = [words for words in commands() if words[0] == "pytest"]
    done = subprocess.run(
        [sys.executable, "-m", *command, "-q", "-p", "no:cacheprovider"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("program", programs(), ids=["gymnasium", "batched"])
def test_a_program_of_the_page_works(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("program.py").write_text(program)
    runpy.run_path("program.py")
    printed = capsys.readouterr().out
    assert "joint_power" in printed or re.match(r"-\d\S* (too_low|tilt|trunk_contact|time limit)", printed), printed
