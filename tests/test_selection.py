"""Which slow tests run."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from go1exp.base.paths import data_root
from tests.selection import changed_since, chosen, touched


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository of one commit and some changes after it."""

    def git(*words: str) -> None:
        about = ["-c", "user.name=n", "-c", "user.email=e@x", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", "-C", str(tmp_path), *about, *words], check=True, capture_output=True, timeout=60)

    git("init", "-q")
    for name in ("kept", "edited", "committed", "ignored"):
        (tmp_path / name).write_text("1")
    (tmp_path / ".gitignore").write_text("ignored\n")
    git("add", ".")
    git("commit", "-qm", "first")
    git("tag", "first")
    (tmp_path / "committed").write_text("2")
    git("commit", "-qam", "second")
    (tmp_path / "edited").write_text("2")
    (tmp_path / "ä new").write_text("2")
    return tmp_path


def test_what_changed_is_what_was_committed_edited_and_added(repository: Path) -> None:
    assert changed_since("first", repository) == {"committed", "edited", "ä new"}


def test_where_git_cannot_tell_nobody_knows(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert changed_since("nowhere", repository) is None
    assert changed_since("HEAD", tmp_path_factory.mktemp("plain")) is None
    assert changed_since("--output=x", repository) is None


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (["deploy/"], True),
        (["conf/gap.yaml"], True),
        (["conf/"], True),
        (["conf"], False),
        (["deploy"], False),
        (["go1exp/deploy/"], False),
        ([], False),
    ],
)
def test_a_folder_stands_for_all_in_it(places: list[str], expected: bool) -> None:
    assert touched(places, ["deploy/check.sh", "conf/gap.yaml", "deploy.md"]) == expected


def test_all_none_and_those_of_what_changed() -> None:
    changed = frozenset(["deploy/check.sh"])
    assert chosen("all", [], frozenset())
    assert not chosen("none", ["deploy/"], changed)
    assert chosen("first", ["deploy/"], changed)
    assert not chosen("first", ["conf/"], changed)
    assert chosen("first", ["conf/"], None)  # to be safe
    assert chosen("first", ["conf/"], frozenset(["pyproject.toml"]))


def test_the_places_of_every_slow_test_exist(request: pytest.FixtureRequest) -> None:
    marks = [mark for item in request.session.items for mark in item.iter_markers("slow")]
    assert [place for mark in marks for place in mark.args if not (data_root() / place).exists()] == []


def test_the_files_of_make_quick_exist() -> None:
    command = subprocess.run(
        ["make", "-n", "quick"], cwd=data_root(), capture_output=True, text=True, check=True
    ).stdout
    files = re.findall(r"tests/\S+\.py", command)
    assert len(files) > 9
    assert [file for file in files if not (data_root() / file).exists()] == []
