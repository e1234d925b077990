"""Which slow tests run: all of them, none, or those whose files changed.

``@pytest.mark.slow("deploy/", "conf/gap.yaml")`` names what a slow test is about: files, and folders by a last slash.
Its own file and ``ALWAYS`` count too. ``pytest`` alone runs everything; ``--slow=none`` leaves the slow tests out, and
``--slow=COMMIT`` runs those of which a file has changed since that commit, in git or in the working tree.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

ALWAYS = (
    *("pyproject.toml", "requirements/", "Makefile", ".ci/"),
    *("tests/conftest.py", "tests/fixtures.py", "tests/selection.py"),
)
"""What every test depends on."""


def changed_since(commit: str, root: Path) -> frozenset[str] | None:
    """Return the files that differ from those of a commit, untracked ones too; None where git cannot tell."""
    exact = _git(root, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}")
    if exact is None:
        return None
    edited = _git(root, "diff", "--name-only", "-z", exact.strip(), "--")
    added = _git(root, "ls-files", "--others", "--exclude-standard", "-z")
    return None if edited is None or added is None else frozenset(filter(None, (edited + added).split("\0")))


def _git(root: Path, *words: str) -> str | None:
    """Return what git prints, or None where it fails or is not there."""
    try:
        answer = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout if answer.returncode == 0 else None


def touched(places: Iterable[str], changed: Iterable[str]) -> bool:
    """Return whether one of the changed files is one of ``places``, or in a folder of them."""
    places = tuple(places)
    folders = tuple(place for place in places if place.endswith("/"))
    return any(name in places or name.startswith(folders) for name in changed)


def chosen(slow: str, places: Iterable[str], changed: frozenset[str] | None) -> bool:
    """Return whether a slow test runs: ``slow`` is the option, ``places`` what the test is about."""
    if slow in ("all", "none"):
        return slow == "all"
    return changed is None or touched((*places, *ALWAYS), changed)
