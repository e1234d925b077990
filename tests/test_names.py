"""Names say what a value is, and the glossary names files that exist.

The words below are verbs, adverbs and pronouns: a reader learns nothing from them about the value. They are refused as
whole names of functions, arguments, variables and attributes that the package itself assigns. Names of other libraries
are not concerned, since only definitions and assignments are looked at.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from go1exp.base.paths import data_root

PACKAGE = data_root() / "go1exp"

VAGUE = frozenset(("found", "said", "own", "told", "do", "go", "of", "there", "here", "mine", "seen", "more", "some"))


def names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield every name that is defined or assigned, with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name, node.lineno
            case ast.arg():
                yield node.arg, node.lineno
            case ast.Name(ctx=ast.Store()):
                yield node.id, node.lineno
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr, node.lineno
            case ast.alias() if node.asname:
                yield node.asname, node.lineno


def vague(file: Path) -> list[str]:
    """List the vague names of a file, each with its line."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return sorted({f"{file.name}:{line}: {name}" for name, line in names(tree) if name.strip("_") in VAGUE})


def test_names_say_what_a_value_is() -> None:
    problems = [line for file in sorted(PACKAGE.rglob("*.py")) for line in vague(file)]
    assert problems == [], "a name is a noun that says what the value is; docs/glossary.md has the terms"


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("found = 1", "found"),
        ("def f(own): ...", "own"),
        ("def go(): ...", "go"),
        ("class A:\n    def of(cls): ...", "of"),
        ("for mine in range(3): ...", "mine"),
        ("[seen for seen in x]", "seen"),
        ("with f() as there: ...", "there"),
        ("def f(x):\n    x._found = 1", "_found"),
        ("import numpy as here", "here"),
        ("(said := 1)", "said"),
    ],
)
def test_the_check_sees_every_kind_of_name(tmp_path: Path, source: str, name: str) -> None:
    file = tmp_path / "module.py"
    file.write_text(source)
    assert [line.split(": ")[1] for line in vague(file)] == [name]


def test_uses_of_foreign_names_are_not_concerned(tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    file.write_text("layout.of(1)\nf(go=2)\nx = parser.found\nrepeat_of = 1\nprint(do)\n")
    assert vague(file) == []


def test_the_glossary_says_each_term_once() -> None:
    text = (data_root() / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")]
    terms = [term for row in rows for term in row.split(", ") if row != "term"]
    assert len(terms) > 80
    assert sorted({term for term in terms if terms.count(term) > 1}) == []
