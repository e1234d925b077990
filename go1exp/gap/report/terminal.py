"""The answer in a few lines."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from itertools import zip_longest

import go1exp.gap.report.words as words
from go1exp.gap.report.tables import short
from go1exp.gap.result import GapResult, Localisation

WIDTH = 100

MOST_EPISODES = 6
"""Episodes that are listed, those with the largest error left; the page has all."""


def text(result: GapResult, status: int | None = None) -> str:
    """Return the summary for a terminal: plain text without markup, lines of up to 100 characters but for commands.

    Args:
        result: to tell.
        status: exit status of the command, if it is not the result's: what was applied may not hold.
    """
    code = result.exit_code if status is None else status
    lines = [f"{result.verdict.upper()} (exit code {code})", *_wrapped(result.sentence), ""]
    if result.named:
        head = ("effect", "where", "size", "95 % interval", "status", "bootstraps")
        lines += [*_table([head, *_rows(result)]), ""]
    if result.excess:
        lines += _table([("held-out error", "floor 1"), *words.errors(result)])
        if not math.isnan(result.closed):
            lines.append(f"{words.share(result.closed)} of the excess is gone.")
        lines.append("")
    if result.errors is not None:
        title = ("error of the angle, mrad", "before", "after")
        rows = words.angle_rows(result.errors, MOST_EPISODES)
        lines += [*_wrapped(words.angles(result.errors)), "", *_table([title, *rows]), ""]
    for todo in words.next_recordings(result):
        lines += [*_wrapped(f"Next: {todo.why}"), f"  {todo.command}"]
    lines += [line for warning in result.warnings for line in _wrapped(f"Warning: {warning}")]
    return "\n".join(lines).strip() + "\n"


def localisation_text(where: Localisation) -> str:
    """Return where a model is wrong as a table for a terminal: mean excess by joint and regime, ``*`` if significant.

    Regimes without a sample are left out.
    """
    shown = [r for r in range(len(where.regimes)) if where.samples[:, r].any()]
    titles = [textwrap.wrap(where.regimes[r], 9, break_long_words=False) for r in shown]
    deep = max((len(title) for title in titles), default=0)
    head = zip_longest(*([""] * (deep - len(title)) + title for title in titles), fillvalue="")
    rows = [("", *line) for line in head]
    for j, joint in enumerate(where.joints):
        cells = (short(float(where.excess[j, r])) + ("*" if where.flagged[j, r] else " ") for r in shown)
        rows.append((joint, *cells))
    title = "Mean excess over the noise floor by joint and regime; 0 is right, * significant."
    return "\n".join([title, *_table(rows)]) + "\n"


def _rows(result: GapResult) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for named in result.named:
        at = words.place(named.effect, named.joints, words.everyone(result))
        stable = words.share(result.bootstrap_share.get(named.effect, math.nan))
        name = " or ".join((named.effect, *words.rivals(named)))
        every = words.sizes(named)
        if not every:
            rows.append((name, at, words.NOTHING, words.NOTHING, named.status, stable))
        for k, size in enumerate(every):
            pairs = named.interval.get(size.name, {}).values()
            interval = words.NOTHING
            if pairs:
                low, high = min(a for a, _ in pairs), max(b for _, b in pairs)
                interval = f"{words.number(low)} to {words.number(high)}"
            first = (name, at) if k == 0 else ("", "")
            last = (named.status, stable) if k == 0 else ("", "")
            rows.append((*first, f"{size.name} {size.short}", interval, *last))
    return rows


def _wrapped(sentence: str) -> list[str]:
    return textwrap.wrap(" ".join(sentence.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return lines of columns as wide as their widest word."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
