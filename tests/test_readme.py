"""README's commands, run one after the other with small budgets; links, sizes and versions of all pages."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import go1exp
from go1exp.base.paths import data_root
from go1exp.cli import VERBS
from go1exp.config.schema import registry
from tests.command import run
from tests.small_run import small

ROOT = data_root()
README = (ROOT / "README.md").read_text()
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
PAGES = [page for page in PAGES if "reference" not in page.parts]

TRAINING = small(iterations=1)
BUDGETS: dict[str, tuple[str, ...]] = {
    "train": TRAINING,
    "eval": ("grid.x=[0.5]", "grid.y=[]", "grid.yaw=[]", "episodes=1", "seconds=0.4", "settle_s=0.1"),
    "export": ("seconds=0.1",),
    "deploy": ("seconds=1.0", "stand_up=0.5", "brake=0.2", "stale=5"),
    # A robot with friction that the model does not have, so that there is something to identify.
    "record": (
        *("excitation=[chirp]", "seeds=[0,1,2,3]", "seconds=0.7", "physics_dt=0.002", "backend.threads=1"),
        *("effect=coulomb", "effect.coulomb.bound=0.5"),
    ),
    "gap": (
        *("search.window_s=0.1", "search.burn_s=0.02", "search.stride_s=0.15", "search.physics_dt=0.002"),
        *("search.max_terms=1", "search.shortlist=1", "search.iterations=1", "search.bootstraps=0"),
        *("search.overlays=1", "search.threads=1", "+search.effects=[coulomb,viscous]"),
    ),
}
"""Verb -> overrides that are added to its commands."""

LEFT_OUT = {"play": "goes on until Ctrl-C: tests/test_viewer_browser.py"}
"""Verbs that are not run, and why."""


@dataclass(frozen=True)
class Command:
    """A line of README, without ``go1exp``."""

    words: tuple[str, ...]

    @property
    def verb(self) -> str:
        return self.words[0]


def commands() -> list[Command]:
    """The commands in README's blocks without a language, from top to bottom."""
    blocks = re.findall(r"^```\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("go1exp ")]
    return [
        Command(tuple(shlex.split(line, comments=True)[1:])) for line in lines if not line.startswith("go1exp train: ")
    ]


def test_every_command_of_the_readme_is_run_or_left_out_for_a_reason() -> None:
    assert len(commands()) >= 8
    assert {command.verb for command in commands()} == {*BUDGETS, *LEFT_OUT}


def test_the_complaint_of_the_readme_is_what_is_printed(tmp_path: Path) -> None:
    ((line, message),) = re.findall(r"^\$ go1exp (.*)\n(.*?) \.\.\.$", README, re.MULTILINE)
    done = run(tmp_path, *shlex.split(line))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(message)


@pytest.mark.slow("README.md", "conf/", "go1exp/")
def test_the_commands_of_the_readme_work_one_after_the_other(tmp_path: Path) -> None:
    name = tmp_path / "runs/NAME"
    for command in (command for command in commands() if command.verb not in LEFT_OUT):
        done = run(tmp_path, *command.words, *BUDGETS[command.verb], timeout=600.0)
        assert done.returncode in ((10, 15) if command.verb == "gap" else (0,)), (
            f"{command}\n{done.stdout}{done.stderr}"
        )
        assert "Traceback" not in done.stderr, command
        if command.verb == "train" and not name.exists():
            (first,) = (folder for folder in (tmp_path / "runs").iterdir() if (folder / "config.yaml").is_file())
            name.symlink_to(first.name)
    for made in ("recordings", "gap/effect.yaml", "runs/NAME/bundle.zip"):
        assert (tmp_path / made).exists(), made


# ---------------------------------------------------------------------- shell


def shell_lines(text: str) -> list[str]:
    """The lines of a text that run go1exp or make, without their comments."""
    lines = re.findall(r"^\s*(?:\$ )?((?:go1exp|make) .*)$", text, re.MULTILINE)
    return [re.split(r"\s#", line)[0] for line in lines if not re.match(r"go1exp [\w -]+: |go1exp trains ", line)]


def unquoted(line: str) -> str:
    return re.sub(r"'[^']*'|\"[^\"]*\"", "", line)


def test_shell_lines_quote_what_bash_or_zsh_would_interpret() -> None:
    texts = {page: "\n".join(re.findall(r"^```.*?^```$", page.read_text(), re.M | re.S)) for page in PAGES}
    texts |= {
        file: yaml.safe_load(file.read_text())["hydra"]["help"]["footer"] for file in (ROOT / "conf").glob("*.yaml")
    }
    lines = [(page, line) for page, text in texts.items() for line in shell_lines(text)]
    assert len(lines) > 200
    assert [(str(page), line) for page, line in lines if re.search(r"[][{}~*?()]", unquoted(line))] == []


# ---------------------------------------------------------------------- pages


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#{1,4} (.*)$", without_code(page.read_text()), re.MULTILINE)
    plain = [re.sub(r"[`*]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_pages_and_headings_that_exist(page: Path) -> None:
    dead = []
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        path, _, anchor = target.partition("#")
        if re.match(r"https?:", target) or path.startswith("reference/"):  # `make docs` checks the reference
            continue
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            dead.append(target)
    assert dead == []


def test_pages_that_code_and_files_name_exist() -> None:
    files = [
        file for folder in ("go1exp", "conf", "benchmarks", "assets/policies") for file in (ROOT / folder).rglob("*")
    ]
    texts = [file.read_text() for file in files if file.suffix in (".py", ".yaml", ".md", ".hpp")]
    pages = {page for text in texts for page in re.findall(r"docs/[\w/]+\.md", text)}
    assert len(pages) > 10
    assert sorted(page for page in pages if not (ROOT / page).exists()) == []


def test_guides_stay_short() -> None:
    guides = (ROOT / "docs").glob("*.md")
    assert sum(len(guide.read_text().split()) for guide in guides) <= 35_000
    assert len(README.splitlines()) <= 130


RESULTS = ROOT / "docs/results"
GAP = (ROOT / "docs/gap.md").read_text()


@pytest.mark.parametrize(
    ("name", "key", "digits", "n"),
    [
        ("gap.json", "nulls_no_gap", 0, True),
        ("gap.json", "param_error", 1, True),
        ("gap.json", "coverage", 0, True),
        ("closed_loop_full.json", "closed_loop_won_back_plain", 0, False),
        ("closed_loop_full.json", "closed_loop_won_back_net", 0, False),
    ],
)
def test_figures_of_the_gap_guide_are_those_of_the_results(name: str, key: str, digits: int, n: bool) -> None:
    results = json.loads((RESULTS / name).read_text())
    value, low, high = (f"{100 * results[key + end]:.{digits}f}" for end in ("", "_low", "_high"))
    assert f"{value} % [{low}, {high}]" + (f" | {results[f'{key}_n']} |" if n else "") in GAP


def test_ablations_of_the_gap_guide_are_those_of_the_results() -> None:
    with open(RESULTS / "gap_ablations.csv") as file:
        rows = {row["method"]: row for row in reversed(list(csv.DictReader(file)))}  # the newest search comes first
    false = {name: round(float(row["false_name_rate"]) * float(row["false_name_rate_n"])) for name, row in rows.items()}
    assert (false["whole"], false["no_box"], false["sysid"]) == (0, 9, 21)
    text = " ".join(GAP.split())
    assert f"Without it {false['no_box']} of 24" in text
    assert f"a false name in {false['sysid']} of 24" in text
    for name in ("sysid", "whole"):
        assert f"truth first in {100 * float(rows[name]['first']):.0f} %" in text


def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs/reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_has_every_term_and_every_verb(tmp_path: Path) -> None:
    reference().write(tmp_path)
    for verb in VERBS:
        assert f"go1exp {verb}" in (tmp_path / f"verb-{verb}.md").read_text()
    for group in registry.groups():
        text = (tmp_path / f"{group}.md").read_text()
        assert [name for name in registry.members(group) if f"## {name}\n" not in text] == []


def test_versions_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"]
    assert {project, citation} == {go1exp.__version__}
    assert f"\n## {project}\n" in (ROOT / "CHANGELOG.md").read_text()
