"""``go1exp.base.report``: numbers, tables and pages that all reports share."""

from __future__ import annotations

import math

import pytest

from go1exp.base.report.page import Block, Card, Page, Section, render
from go1exp.base.report.plots import Drawing, listing
from go1exp.base.report.table import Cell, Table, aligned, interval_text, number, share, verdict


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((0.42, "0.42"), (41.23, "41.2"), (0.0, "0"), (-0.0, "0"), (5.55e-17, "0"), (2362.4, "2362")),
        *((123456.0, "123456"), (999.7, "1000"), (2.14e-5, "2.14e-5"), (2.5e-4, "0.00025"), (3e9, "3e9")),
        *((1.5e7, "1.5e7"), (math.nan, "–"), (None, "–"), (-math.inf, "-∞")),
    ],
)
def test_numbers_are_easy_to_read(value: float | None, text: str) -> None:
    assert number(value) == text


def test_intervals_and_shares() -> None:
    assert interval_text(0.5, 0.25, 1.0) == "0.5 [0.25, 1]"
    assert interval_text(0.5, None, None) == interval_text(0.5, math.nan, math.nan) == "0.5"
    assert interval_text(None, None, None) == "–"
    assert [share(v) for v in (0.5, 0.99219, 1.0, math.nan)] == ["50 %", "99.22 %", "100 %", "–"]


def test_text_tables_have_columns() -> None:
    rows = [("a", "bb", "1"), ("ccc", "d", "22")]
    assert aligned(rows, left=2, indent=" ") == [" a    bb   1", " ccc  d   22"]


def test_a_page_has_every_part_and_escapes_names() -> None:
    evil = "<script>alert(1)</script>"
    cells = [evil, 7, verdict("not met"), Cell("0.5", "[0, 1]", "value"), Cell("9", fill="#123456", ink="#ffffff")]
    table = Table("a table", ["name", "n", "word", "value", "heat"], ["heading of rows", cells], "a note")
    drawing = Drawing("dots", f"{evil} $x$", "caption", lambda: listing([evil, "b"], label="x $y$")[0])
    section = Section("results", [table, drawing, Block("text"), Block("go1exp gap", fixed=True)], name="here")
    card = Card("card", "soft", "certified", "note", [("0.4 N m", "spread")], table, [evil], ["end"])
    text = render(Page(evil, "kind", evil, evil, [section], [("met: 1", evil)], [evil], [evil], [card], "is-no-gap"))
    assert "<script" not in text
    assert text.count('<span class="word not-met">not met</span>') == 2
    for part in (
        'id="here"',
        "heading of rows",
        "a note",
        "background:#123456;color:#ffffff",
        "0.4 N m",
        "<pre>go1exp",
    ):
        assert part in text
    assert 'aria-label="&lt;script&gt;' in text
    assert "$y$" in text
