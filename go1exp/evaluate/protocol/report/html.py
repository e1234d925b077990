"""The page of a protocol and that of a comparison: words, tables and drawings in one file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from go1exp.base.svg import draw
from go1exp.evaluate.protocol.base import Drawing, Protocol
from go1exp.evaluate.protocol.claims import ORDER
from go1exp.evaluate.protocol.playing import Result
from go1exp.evaluate.protocol.report.tables import claims_table, figure_tables, meanings
from go1exp.evaluate.protocol.report.words import falls

INTERVALS = (
    "Figures: mean over robots with Student's 95 % interval; shares with Wilson's; falls per moving robot-minute with"
    " Garwood's; thresholds by the bootstrap over robots. If all was played again and again with other robots, nineteen"
    " of twenty such intervals would hold the true value. n: robots with a value; with few, intervals are wide, and may"
    " even go beyond what is possible."
)


def page(result: Result) -> str:
    """Return the page of one protocol, one HTML document."""
    protocol, means = result.chosen.protocol, meanings(result)
    count = len(result.played.rows)
    return rendered(
        title=f"{result.chosen.key}: {result.label}",
        kind=f"go1exp eval · protocol={result.chosen.key}",
        heading=result.label,
        about=_sentence(protocol),
        verdicts=_verdicts(result),
        facts=[falls(result), *result.played.notes],
        tables=[claims_table(result, means), *figure_tables(result.summary, means)],
        drawings=protocol.drawings(result.played, result.summary),
        notes=[
            f"{count} rows, one for each robot in each condition"
            + (f"; {result.repeats} repeated another one bit for bit and do not count" if result.repeats else "")
            + f"; {result.seconds:.0f} s.",
            INTERVALS,
        ],
        settings=settings_text({"settings": dataclasses.asdict(protocol), **result.about}),
    )


def rendered(drawings: Sequence[Drawing], **context: Any) -> str:
    """Return the page with these words, tables and drawings."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    painted = [(d, draw(d.name, f"{d.title}. {d.caption}", d.paint)) for d in drawings]
    return environment.get_template("template.html.j2").render(drawings=painted, **context)


def settings_text(settings: Mapping[str, Any]) -> str:
    """Write plain data as YAML, short lists on a line of their own."""
    plain = json.loads(json.dumps(settings, default=str))
    return yaml.safe_dump(plain, default_flow_style=None, sort_keys=False, width=100, allow_unicode=True).strip()


def _sentence(protocol: Protocol) -> str:
    return (type(protocol).__doc__ or "").strip().split("\n")[0]


def _verdicts(result: Result) -> list[tuple[str, str]]:
    """Return each word with the claims that have it, the best first, for the page's head."""
    by_word = {word: [v.name.replace("_", " ") for v in result.verdicts if v.word == word] for word in reversed(ORDER)}
    return [(f"{word}: {len(names)}", ", ".join(names)) for word, names in by_word.items() if names]
