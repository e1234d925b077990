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
    "go1exp": ["make"],
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
    pages = {"index.md": _index(), "choices.md": _choices(), "python.md": _python()}
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
    from go1exp.cli.verbs import VERBS

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
            *_toctree("Files and Python", ["choices", "python"]),
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
    from go1exp.cli.verbs import SUBVERBS, VERBS

    pages = {}
    for verb, about in VERBS.items():
        lines = [f"# go1exp {verb}", "", f"{about[0].upper()}{about[1:]}.", "", *_help(verb)]
        for word in SUBVERBS.get(verb, ()):
            lines += [f"## go1exp {verb} {word}", "", *_help(f"{verb}_{word}")]
        pages[verb] = "\n".join(lines)
    return pages


def _help(verb: str) -> list[str]:
    from go1exp.cli.helptext import show
    from go1exp.config.choices import groups_of

    title = f"go1exp {verb.replace('_', ' ')}"
    lines = ["```text", _printed(show, verb, title, []), "```", ""]
    for group in groups_of(verb) if verb == "train" else ():
        lines += [f"## Group {group}", "", "```text", _printed(show, verb, title, [group]), "```", ""]
    return lines


def _printed(function: Any, *arguments: Any) -> str:
    out = io.StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "110"
    with contextlib.redirect_stdout(out):
        function(*arguments)
    os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    return out.getvalue().rstrip()


def _choices() -> str:
    from go1exp.config.choices import about, choice_files, groups_in
    from go1exp.config.source import shown_folders

    lines = [
        "# Configuration files",
        "",
        "Every group of `conf/` with its choices: `group=choice` on the command line.",
        "",
    ]
    folders = shown_folders()
    for group in dict.fromkeys(group for folder in folders for group in groups_in(folder)):
        rows = [(f"`{group}={name}`", about(file)) for name, file in choice_files(group, folders).items()]
        lines += [f"## {group}", "", *_table(("choice", "what it is"), rows)]
    return "\n".join(lines)


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
    return name + re.sub(r"(\w+\.)+(?=\w)", "", text.replace("'", "").replace("(self, ", "(").replace("(self)", "()"))


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
