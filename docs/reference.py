"""Write the reference pages of the documentation from the registry, the command line's help and docstrings.

``docs/conf.py`` calls :func:`write` at the beginning of a build. The pages are never committed.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import io
import os
import re
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent

GROUPS = {
    "reward": "Rewards",
    "observation": "Observations",
    "command": "Commands",
    "rand": "Randomisations",
    "event": "Events",
    "termination": "Terminations",
    "curriculum": "Curricula",
    "effect": "Effects",
    "actuator": "Actuators",
    "excitation": "Excitations",
    "importer": "Importers",
    "measure": "Measures",
    "protocol": "Protocols",
}
"""Group of the registry -> title of its page."""

API = {
    "go1exp.sim.env.batch": ["make"],
    "go1exp.sim.env.core": ["Go1Core"],
    "go1exp.sim.env.gym_env": ["Go1Env"],
    "go1exp.mdp.types": ["Snapshot", "StepResult", "TermSetup"],
    "go1exp.logs.recording": ["Recording", "Meta", "read", "read_folder", "write"],
    "go1exp.gap": ["explain", "check", "compare", "robot_of", "Comparison", "GapResult", "GapSettings"],
    "go1exp.deploy.runtime.bundle": ["load", "Bundle"],
    "go1exp.deploy.estimation": ["go1", "make_filter", "sample", "Status", "FilterConfig"],
    "go1exp.extend": [],
    "go1exp.extend.testing": ["check_plugin"],
}
"""Module -> names documented; no names: all of ``__all__``."""


def write(folder: Path) -> None:
    """Write all reference pages into ``folder``; files that do not change keep their time."""
    pages = {"index.md": _index(), "choices.md": _choices(), "python.md": _python(), "statuses.md": _statuses()}
    pages |= {f"{group}.md": _group(group, title) for group, title in GROUPS.items()}
    pages |= {f"verb-{verb}.md": text for verb, text in _verbs().items()}
    folder.mkdir(exist_ok=True)
    for old in set(folder.glob("*.md")) - {folder / name for name in pages}:
        old.unlink()
    for name, text in pages.items():
        file = folder / name
        if not file.exists() or file.read_text() != text:
            file.write_text(text)


def _index() -> str:
    from go1exp.cli import VERBS

    verbs = "\n".join(f"verb-{verb}" for verb in VERBS)
    return "\n".join(
        [
            "# Reference",
            "",
            "These pages are generated from the installed package: the registry of terms, the help of the command line",
            "and the docstrings. `go1exp list` and `go1exp VERB --help` print the same in a terminal.",
            "",
            *_toctree("Verbs", verbs.splitlines()),
            *_toctree("Terms", list(GROUPS)),
            *_toctree("Files and Python", ["choices", "statuses", "python"]),
        ]
    )


def _toctree(caption: str, pages: Sequence[str]) -> list[str]:
    return ["```{toctree}", ":maxdepth: 1", f":caption: {caption}", "", *pages, "```", ""]


# ---------------------------------------------------------------------- terms


def _group(group: str, title: str) -> str:
    import go1exp.evaluate.protocol.kinds
    import go1exp.extend  # noqa: F401  (both register members)
    from go1exp.config.schema import registry

    lines = [f"# {title}", ""]
    members = registry.members(group)
    lines += [f"Group `{group}` of the registry, {len(members)} terms. Files of this group: [choices](choices.md).", ""]
    for entry in members.values():
        lines += [f"## {entry.name}", "", *_text(entry.target)]
        lines += _effect(entry.target) if group == "effect" else _parameters(entry)
        lines += [*_traits(entry), f"Defined in `{_place(entry.target)}`.", ""]
    return "\n".join(lines)


def _parameters(entry: Any) -> list[str]:
    if not entry.parameters:
        return ["No parameters.", ""]
    rows = []
    for name, p in entry.parameters.items():
        default = "required" if p.default is p.empty else f"`{p.default!r}`"
        rows.append((f"`{name}`", f"`{_type(p.annotation)}`", default))
    return _table(("parameter", "type", "default"), rows)


def _effect(target: Any) -> list[str]:
    rows = [
        (f"`{p.name}`", p.unit, _number(p.low), _number(p.high), _number(p.null), _number(p.tolerance), p.per, p.doc)
        for p in target.params
    ]
    return _table(("parameter", "unit", "lowest", "highest", "null", "tolerance", "per", "meaning"), rows)


def _traits(entry: Any) -> list[str]:
    words = [
        f"{key}: {value}" for key, value in entry.traits.items() if key in ("size", "unit", "per", "kind", "fields")
    ]
    return [f"Registered with {', '.join(words)}.", ""] if words else []


def _number(value: float) -> str:
    return "–" if value in (float("inf"), float("-inf")) else f"{value:g}"


def _type(annotation: Any) -> str:
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    return re.sub(r"Annotated\[(\w+), Field\(([^)]*)\)\]", r"\1, \2", text).replace("|", "or")


def _place(target: Any) -> str:
    return str(Path(inspect.getsourcefile(target) or "").resolve().relative_to(ROOT))


# ---------------------------------------------------------------------- verbs and files


def _verbs() -> dict[str, str]:
    from go1exp.cli import SUBVERBS, VERBS

    pages = {}
    for verb, about in VERBS.items():
        lines = [f"# go1exp {verb}", "", f"{about[0].upper()}{about[1:]}.", "", *_help(verb)]
        for word in SUBVERBS.get(verb, ()):
            lines += [f"## go1exp {verb} {word}", "", *_help(verb, word)]
        pages[verb] = "\n".join(lines)
    return pages


def _help(*words: str) -> list[str]:
    text = _printed(*words, "--help")
    lines = _sections(text)
    groups = re.search(r"^Groups \(.*\):\n((?:  .*\n)+)", text, re.MULTILINE)
    for group, _ in _rows(groups[1].splitlines()) if groups and words == ("train",) else []:
        name = group.strip("`")
        lines += [f"## Group {name}", "", *_sections(_printed("train", "--help", name))[2:]]
    return lines


def _sections(help_text: str) -> list[str]:
    """Return a help page as Markdown: groups, settings and choices as tables, usage and examples as code."""
    lines: list[str] = []
    for block in help_text.split("\n\n"):
        first, *rest = block.splitlines()
        if match := re.match(r"(Groups|Settings|Choices|Keys) \((.*)\):$", first):
            lines += [f"**{match[1]}** ({match[2]})", "", *_table(("", ""), _rows(rest))]
        elif first.startswith(("Usage", "Examples", " ")):
            lines += [
                "```text",
                textwrap.dedent("\n".join(rest if first == "Examples:" else [first, *rest])),
                "```",
                "",
            ]
        else:
            lines += [" ".join(line.strip() for line in [first, *rest]), ""]
    return lines


def _rows(lines: Iterable[str]) -> list[list[str]]:
    rows: list[list[str]] = []
    for line in lines:
        if match := re.match(r" {2,8}(\S.*?)(?: {2,}(.*))?$", line):
            rows.append([f"`{match[1]}`", match[2] or ""])
        else:
            rows[-1][1] += f" {line.strip()}"
    return rows


def _printed(*words: str) -> str:
    """Return what the command line prints for ``go1exp WORDS``, 110 columns wide."""
    from unittest import mock

    from go1exp.cli import main

    out = io.StringIO()
    with (
        mock.patch.dict(os.environ, COLUMNS="110"),
        mock.patch.object(sys, "argv", ["go1exp", *words]),
        contextlib.redirect_stdout(out),
    ):
        main()
    return out.getvalue().rstrip()


def _choices() -> str:
    lines = [
        "# Configuration files",
        "",
        "Every group of `conf/` with its choices: `group=choice` on the command line.",
        "",
    ]
    for block in _printed("list", "what=groups").split("\n\n"):
        group, *rest = block.splitlines()
        if rest:
            lines += [f"## {group}", "", *_table(("choice", "what it is"), _rows(rest))]
    return "\n".join(lines)


def _statuses() -> str:
    from go1exp.base.errors import STATUSES

    rows = [(str(status), verb, f"{meaning[0].upper()}{meaning[1:]}") for status, (verb, meaning) in STATUSES.items()]
    return "\n".join(
        [
            "# Exit statuses",
            "",
            "Every verb ends an error with one line on standard error, or one for each problem of its settings.",
            "A fault of go1exp itself is one line, too, which names the file with the traceback.",
            "`HYDRA_FULL_ERROR=1` prints the traceback instead.",
            "",
            *_table(("status", "verb", "meaning"), rows),
        ]
    )


# ---------------------------------------------------------------------- Python


def _python() -> str:
    lines = ["# Python", "", "The public names of the package. Everything else may change between versions.", ""]
    for module_name, names in API.items():
        module = importlib.import_module(module_name)
        lines += [f"## {module_name}", "", *_text(module)]
        for name in names or module.__all__:
            lines += _object(module_name, name, getattr(module, name))
    return "\n".join(lines)


def _object(module: str, name: str, value: Any) -> list[str]:
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        return []  # an alias of a type
    lines = [f"### {name}", "", "```python", f"from {module} import {name}", "", _signature(name, value), "```", ""]
    lines += _text(value)
    if inspect.isclass(value) and value.__module__.startswith("go1exp"):
        lines += ["**Methods and properties**", ""]
        for method, target in vars(value).items():
            function = target.fget if isinstance(target, property) else getattr(target, "__func__", target)
            if not method.startswith("_") and inspect.isfunction(function):
                first = (inspect.getdoc(function) or "").split("\n\n")[0]
                shown = f"`{method}`" if isinstance(target, property) else f"`{_signature(method, function)}`"
                lines += [f"- {shown}: {' '.join(first.split())}"]
        lines += [""]
    return lines


def _signature(name: str, value: Any) -> str:
    try:
        text = str(inspect.signature(value))
    except (TypeError, ValueError):
        return name
    text = name + re.sub(r"(\w+\.)+(?=\w)", "", text.replace("'", "").replace("(self, ", "(").replace("(self)", "()"))
    return text if len(text) < 80 or not name[0].isupper() else re.sub(r", (?=\*|\w+:)", ",\n    ", text)


# ---------------------------------------------------------------------- text


def _text(target: Any) -> list[str]:
    """Return a docstring in Google style as Markdown."""
    lines = [*(inspect.getdoc(target) or "").splitlines(), ""]
    out: list[str] = []
    for line in lines:
        if re.fullmatch(r"(Args|Attributes|Returns|Raises|Yields|Note|Example):", line):
            out += ["", f"**{line[:-1]}**", ""]
        elif match := re.match(r"    (\*{0,2}\w+)(?: \([^)]*\))?: (.*)", line):
            out += [f"- `{match[1]}`: {match[2]}"]
        elif line.endswith("::"):
            out += [line[:-1], ""]
        else:
            out += [line[2:] if line.startswith("        ") and out and out[-1].startswith(("- ", "  ")) else line]
    text = re.sub(r":\w+:`~?([^`]*)`", r"`\1`", "\n".join(out))
    return [*re.sub(r"(?<!`)<(?=\w)", "&lt;", text).splitlines(), ""]


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    cells = [list(header)]
    cells += [
        ["---"] * len(cells[0]),
        *([str(cell).replace("|", "\\|").replace("\n", " ") for cell in row] for row in rows),
    ]
    return [*(f"| {' | '.join(row)} |" for row in cells), ""]
