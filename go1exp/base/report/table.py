"""Tables of all reports as text and cells of a page, and the numbers in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

NOTHING = "–"
"""Stands for an undefined number."""


@dataclass(frozen=True)
class Cell:
    """One cell of a table on a page.

    Attributes:
        text: content.
        detail: small text below it: an interval, or a meaning.
        look: ``verdict`` (a coloured word), ``value`` (with its interval), ``name``, ``number``, or empty.
        title: shown when pointed at.
        fill: background colour, and ``ink`` that of the text, of a heat map.
        ink: colour of the text.
        marked: whether the cell is framed.
    """

    text: str
    detail: str = ""
    look: str = ""
    title: str = ""
    fill: str = ""
    ink: str = ""
    marked: bool = False


Row = Sequence[object] | str
"""Cells (``Cell``, or a value that is shown as text), or the heading of the rows below it."""


@dataclass(frozen=True)
class Table:
    """One table of a page.

    Attributes:
        title: heading above the table.
        header: names of the columns; empty for a table without a header.
        rows: cells, or headings of rows.
        note: explanation.
        look: class of the table on the page: empty, ``heat`` or ``hash``.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Row] = field(default_factory=list)
    note: str = ""
    look: str = ""


def verdict(word: str) -> Cell:
    """Return a cell with a coloured verdict."""
    return Cell(word, look="verdict")


def spread(estimate: float | None, low: float | None, high: float | None, count: str) -> Cell:
    """Return an estimate with its interval, and the number of samples, below it."""
    value, _, between = interval_text(estimate, low, high).partition(" ")
    return Cell(value, " ".join(filter(None, (between, count))), "value")


# ---------------------------------------------------------------------- numbers


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits and whole integers; 0 below 1e-9, a rounding error."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) < 1e-9:
        return "0"
    if 10.0**digits <= abs(value) < 1e6:
        return f"{value:.0f}"
    rounded = float(f"{value:.{digits - 1}e}")
    if 1e-4 <= abs(rounded) < 1e6:
        return f"{rounded:.12f}".rstrip("0").rstrip(".")
    digit, _, power = f"{rounded:.{digits - 1}e}".partition("e")
    return f"{digit.rstrip('0').rstrip('.') if '.' in digit else digit}e{int(power)}"


def share(value: float) -> str:
    """Return a share as a percentage, its distance from 100 % kept visible."""
    return NOTHING if math.isnan(value) else f"{number(100.0 * value, 4 if value > 0.99 else 3)} %"


def interval_text(estimate: float | None, low: float | None, high: float | None) -> str:
    """Return an estimate with its interval in brackets; the estimate alone if the interval is undefined."""
    if estimate is None or low is None or high is None or math.isnan(low):
        return number(estimate)
    return f"{number(estimate)} [{number(low)}, {number(high)}]"


# ---------------------------------------------------------------------- text


def aligned(rows: Sequence[Sequence[str]], left: int, indent: str = "") -> list[str]:
    """Return lines with columns as wide as their widest cell, the first ``left`` ones aligned to the left."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        padded = [cell.ljust(w) for cell, w in zip(row[:left], widths, strict=False)]
        padded += [cell.rjust(w) for cell, w in zip(row[left:], widths[left:], strict=True)]
        lines.append(indent + "  ".join(padded).rstrip())
    return lines
