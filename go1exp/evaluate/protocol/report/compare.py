"""The page of a comparison."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from go1exp.evaluate.protocol.comparing import Difference, Word
from go1exp.evaluate.protocol.playing import Result
from go1exp.evaluate.protocol.report.html import rendered, settings_text
from go1exp.evaluate.protocol.report.tables import Meanings, Table, meanings, spread
from go1exp.evaluate.protocol.report.words import condition_text, falls, number

ORDER: tuple[Word, ...] = ("better", "worse", "no significant difference")

WORDS = (
    "better, worse: the whole 95 % interval of the difference, in brackets, is on that side of zero; not told apart: it"
    " holds zero. n: pairs, robots with a value with both. Pairs needed: as many would tell a difference like the one"
    " seen in four of five tries."
)

NOTES = (
    "The same protocol, seed and, robot by robot, the same draws for all. Differences are other less first, of robots"
    " that have a value with both: figures of walking leave out robots that fell with either.",
    "Intervals of 95 %: bootstrap over robots; shares by Agresti and Min. Of figures that are equal, one in twenty is"
    " told apart by chance.",
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
        tables.append(_table(key, differences[key], results[0].label, meanings(results[0])))
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
        verdicts=_verdicts(differences),
        facts=lines,
        tables=tables,
        drawings=drawings,
        notes=NOTES,
        settings=settings_text(about),
    )


def _verdicts(differences: Mapping[str, Sequence[Difference]]) -> list[tuple[str, str]]:
    """Return each word with the figures that have it, for the page's head."""
    lines = []
    for word in ORDER:
        of_word = [(key, d) for key, those in differences.items() for d in those if d.word == word]
        names = dict.fromkeys(f"{key}, {d.subject}: {d.quantity}" for key, d in of_word)
        times = [sum(f"{key}, {d.subject}: {d.quantity}" == name for key, d in of_word) for name in names]
        text = "; ".join(f"{name} (in {n} conditions)" if n > 1 else name for name, n in zip(names, times, strict=True))
        if of_word:
            lines.append((f"{word}: {len(of_word)}", text if word != ORDER[-1] else "figures, listed below"))
    return lines


def _counts(differences: Mapping[str, Sequence[Difference]]) -> Table:
    """Return how many figures are better and worse."""
    rows = []
    for key, those in differences.items():
        for subject in dict.fromkeys(d.subject for d in those):
            words = [d.word for d in those if d.subject == subject]
            rows.append([key, subject, *(words.count(w) for w in ORDER)])
    return {"title": "Verdicts", "note": WORDS, "header": ["protocol", "subject", *ORDER], "rows": rows}


def _table(key: str, differences: Sequence[Difference], first: str, means: Meanings) -> Table:
    """Return what is told apart, then what is not; figures that are 0 with all are named above."""
    nothing = _nothing(differences)
    subjects = list(dict.fromkeys(d.subject for d in differences))
    rows, above = [], ""
    figures = list(dict.fromkeys(d.quantity for d in differences))
    for d in sorted(differences, key=lambda d: (ORDER.index(d.word), figures.index(d.quantity))):
        if d.quantity in nothing:
            continue
        name = f"{d.quantity} ({d.unit})" if d.unit else d.quantity
        meaning = means.get(d.quantity, ("", ""))[1]
        head = {"name": name, "note": "" if d.quantity == above else meaning}
        above = d.quantity
        between = spread(d.difference.estimate, d.difference.low, d.difference.high, f"n {d.difference.n}")
        who = [d.subject] if len(subjects) > 1 else []
        where = condition_text(d.condition)
        rows.append([head, {"word": d.word}, *who, where, number(d.first), number(d.other), between, d.needed or ""])
    subject = ["subject"] if len(subjects) > 1 else []
    other = subjects[0] if len(subjects) == 1 else "subject's"
    header = ["figure", "verdict", *subject, "where", first, other, "difference [95 %] n", "pairs needed"]
    note = f"0 with all, and left out: {', '.join(nothing)}." if nothing else ""
    return {"title": key, "note": note, "header": header, "rows": rows}


def _nothing(differences: Sequence[Difference]) -> list[str]:
    """Return the figures that are 0 with all subjects in all conditions."""
    names = dict.fromkeys(d.quantity for d in differences)
    not_zero = {d.quantity for d in differences if d.first != 0.0 or d.other != 0.0}
    return [name for name in names if name not in not_zero]
