"""The page of a comparison."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

from go1exp.protocol.comparing import Difference, Word
from go1exp.protocol.report.html import Table, condition_text, falls, interval_text, rendered
from go1exp.protocol.result import Result

ORDER: tuple[Word, ...] = ("better", "worse", "not told apart")

NOTES = (
    "The same protocol, seed and, robot by robot, the same draws for all. Differences are other less first, of robots"
    " that have a value with both: figures of walking leave out robots that fell with either.",
    "Intervals of 95 %: bootstrap over robots; shares by Agresti and Min. Of figures that are equal, one in twenty is"
    " told apart by chance.",
    "Pairs needed: robots that would tell a difference like the one seen in four of five tries.",
)


def page(plays: Mapping[str, Sequence[Result]], differences: Mapping[str, Sequence[Difference]], about: Any) -> str:
    """Return the page.

    Args:
        plays: results of all subjects, by protocol.
        differences: of the others to the first, by protocol.
        about: plain data on how it was made.
    """
    tables, drawings = [_counts(differences)], []
    for key, results in plays.items():
        tables.append(_table(key, differences[key], results[0].label))
        protocol, first = results[0].chosen.protocol, results[0]
        played, summaries = {r.label: r.played for r in results}, {r.label: r.summary for r in results}
        drawn = protocol.compared(played, summaries)
        drawings += [
            dataclasses.replace(d, name=f"{key}-{d.name}", title=f"{first.chosen.key}: {d.title}") for d in drawn
        ]
    labels = [r.label for r in next(iter(plays.values()))]
    lines = [f"{r.chosen.key}, {r.label}: {falls(r)}" for results in plays.values() for r in results]
    return rendered(
        title=" against ".join(labels),
        kind="go1exp compare",
        heading=" · ".join(labels),
        about=f"Everything against {labels[0]}, robot by robot.",
        facts=lines,
        tables=tables,
        drawings=drawings,
        notes=NOTES,
        settings=json.dumps(about, indent=1, default=str),
    )


def _counts(differences: Mapping[str, Sequence[Difference]]) -> Table:
    """Return how many figures are better and worse."""
    rows = []
    for key, those in differences.items():
        for subject in dict.fromkeys(d.subject for d in those):
            words = [d.word for d in those if d.subject == subject]
            rows.append([key, subject, *(words.count(w) for w in ORDER)])
    return {"title": "Verdicts", "note": "", "header": ["protocol", "subject", *ORDER], "rows": rows}


def _table(key: str, differences: Sequence[Difference], first: str) -> Table:
    rows = [
        [
            f"{d.quantity} ({d.unit})" if d.unit else d.quantity,
            {"word": d.word},
            d.subject,
            condition_text(d.condition),
            f"{d.first:.3g}",
            f"{d.other:.3g}",
            interval_text(d.difference.estimate, d.difference.low, d.difference.high),
            d.difference.n,
            d.needed or "",
        ]
        for d in sorted(differences, key=lambda d: ORDER.index(d.word))
    ]
    header = ["figure", "verdict", "subject", "where", first, "subject's", "difference [95 %]", "pairs", "needed"]
    return {"title": key, "note": "", "header": header, "rows": rows}
