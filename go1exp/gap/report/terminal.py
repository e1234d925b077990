"""Summary of a comparison for the terminal."""

from __future__ import annotations

import math
import textwrap
from itertools import zip_longest

import go1exp.gap.report.words as words
from go1exp.base.report.table import NOTHING, aligned, number, share
from go1exp.gap.report.tables import short
from go1exp.gap.result import GapResult, Localisation

WIDTH = 100

MOST_EPISODES = 6
"""Listed episodes, those with the largest residual; the page has all."""


def text(result: GapResult, status: int | None = None) -> str:
    """Return the summary for a terminal: plain text without markup, lines of up to 100 characters but for commands.

    Args:
        result: of the comparison.
        status: exit status of the command, if it differs from the result's.
    """
    code = result.exit_code if status is None else status
    lines = [f"{result.verdict.upper()} (exit code {code})", *_wrapped(result.sentence), ""]
    if result.named:
        head = ("effect", "where", "value", "95 % interval", "status", "bootstraps")
        lines += [*aligned([head, *_rows(result)], len(head), "  "), ""]
    if result.excess:
        lines += aligned([("held-out error", "normalised chi2 (1 = noise level)"), *words.errors(result)], 2, "  ")
        if not math.isnan(result.closed):
            lines.append(f"{share(result.closed)} of the excess chi2 is explained.")
        lines.append("")
    if result.errors is not None:
        title = ("angle error, mrad", "nominal", "fitted")
        rows = words.angle_rows(result.errors, MOST_EPISODES)
        lines += [*_wrapped(words.angles(result.errors)), "", *aligned([title, *rows], 3, "  "), ""]
    for todo in words.next_recordings(result):
        lines += [*_wrapped(f"Next: {todo.why}"), f"  {todo.command}"]
    lines += [line for warning in result.warnings for line in _wrapped(f"Warning: {warning}")]
    return "\n".join(lines).strip() + "\n"


def localisation_text(where: Localisation) -> str:
    """Return a table of normalised chi2 - 1 by joint and regime for a terminal, ``*`` if significant.

    Regimes without a sample are omitted.
    """
    shown = [r for r in range(len(where.regimes)) if where.samples[:, r].any()]
    titles = [textwrap.wrap(where.regimes[r], 9, break_long_words=False) for r in shown]
    deep = max((len(title) for title in titles), default=0)
    head = zip_longest(*([""] * (deep - len(title)) + title for title in titles), fillvalue="")
    rows = [("", *line) for line in head]
    for j, joint in enumerate(where.joints):
        cells = (short(float(where.excess[j, r])) + ("*" if where.flagged[j, r] else " ") for r in shown)
        rows.append((joint, *cells))
    title = "Mean of normalised chi2 - 1 by joint and regime; 0 = noise level, * significant."
    return "\n".join([title, *aligned(rows, len(rows[0]), "  ")]) + "\n"


def _rows(result: GapResult) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for named in result.named:
        at = words.place(named.effect, named.joints, words.everyone(result))
        stable = share(result.bootstrap_share.get(named.effect, math.nan))
        name = " or ".join((named.effect, *words.rivals(named)))
        every = words.sizes(named)
        if not every:
            rows.append((name, at, NOTHING, NOTHING, named.status, stable))
        for k, (parameter, mean, _) in enumerate(every):
            pairs = named.interval.get(parameter, {}).values()
            interval = NOTHING
            if pairs:
                low, high = min(a for a, _ in pairs), max(b for _, b in pairs)
                interval = f"{number(low)} to {number(high)}"
            first = (name, at) if k == 0 else ("", "")
            last = (named.status, stable) if k == 0 else ("", "")
            rows.append((*first, f"{parameter} {mean}", interval, *last))
    return rows


def _wrapped(sentence: str) -> list[str]:
    return textwrap.wrap(" ".join(sentence.split()), WIDTH, break_long_words=False, break_on_hyphens=False)
