"""The page and the file of numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

import go1exp.gap.report.figures as figures
import go1exp.gap.report.tables as tables
import go1exp.gap.report.words as words
from go1exp.base.files import write_text
from go1exp.gap.data.contact import tolerances_of
from go1exp.gap.result import GapResult
from go1exp.gap.search import clocks

MOST_WINDOWS = 6
"""Windows that are drawn, so that the page stays small; the file of numbers has all."""

MOST_FORESTS = 16
"""Parameters that are drawn; the table beside has all."""


def write_report(result: GapResult, folder: Path) -> list[Path]:
    """Write ``report.html`` and ``report.json`` into ``folder``, which is made if need be; return the two files.

    The page needs nothing beside it: no network, no script, its figures are inside. The other file holds
    ``GapResult.as_dict``, numbers that are not finite as null.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    plain = json.dumps(result.as_dict(), indent=1, allow_nan=False, default=str)
    written = []
    for name, content in (("report.html", page(result)), ("report.json", plain + "\n")):
        file = folder / name
        write_text(file, content)
        written.append(file)
    return written


def page(result: GapResult) -> str:
    """Return the page, one HTML document."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("template.html.j2").render(_context(result))


def _context(result: GapResult) -> dict[str, Any]:
    drawn = [w for w in result.overlays[:MOST_WINDOWS] if len(w.t) and figures.rows_of(w)]
    forests = [(n, name) for n in result.named for name, values in n.params.items() if values]
    return {
        "result": result,
        "words": words,
        "clock": clocks.sentence(result.clock) if result.clock else "",
        "cards": [
            {
                "named": n,
                "meaning": words.meaning(n.effect),
                "where": words.place(n.effect, n.joints, words.everyone(result)),
                "sizes": words.sizes(n),
                "rivals": words.rivals(n),
                "bootstrap_share": result.bootstrap_share.get(n.effect),
            }
            for n in result.named
        ],
        "adequate": words.limit(result, "adequate"),
        "errors": words.errors(result),
        "changes": words.would_change(result),
        "next": words.next_recordings(result),
        "heats": tables.heat_maps(result),
        "scale": tables.scale(result),
        "evidence": tables.evidence(result),
        "values": tables.values(result),
        "floors": tables.floors(result),
        "provenance": tables.provenance(result),
        "windows": [(window, figures.overlay(window, f"window{k}")) for k, window in enumerate(drawn)],
        "trunk": any(words.TRUNK_UNITS.keys() & figures.rows_of(window) for window in drawn),
        "waterfall": figures.waterfall(result) if any(v == v for _, v in result.waterfall) else None,
        "forests": [
            figures.forest(n, name, k, tolerances_of(result)) for k, (n, name) in enumerate(forests[:MOST_FORESTS])
        ],
        "box": figures.box(result),
        "bootstraps": figures.bootstraps(result),
    }
