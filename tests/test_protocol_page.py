"""Pages of protocols and of comparisons: what stands in their tables, and that a phone shows all of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from go1exp.base.report.table import Cell
from go1exp.evaluate.protocol import comparing
from go1exp.evaluate.protocol.base import Played
from go1exp.evaluate.protocol.claims import evaluated
from go1exp.evaluate.protocol.pages import (
    ACROSS,
    claims_table,
    comparison,
    condition_text,
    figure_tables,
    meanings,
    page,
)
from go1exp.evaluate.protocol.playing import Result, summarised
from go1exp.evaluate.statistics.intervals import Estimate, SummaryEntry
from tests.phone import PHONE, needs_chromium, on_a_phone
from tests.test_protocols import selected


def made(name: str, label: str, rows: Callable[[Any], list[dict[str, Any]]], *overrides: str) -> Result:
    """Return a result with these rows, of nobody who walked."""
    one = selected(name, *overrides)
    those = rows(one.protocol)
    figures = summarised(one, those)
    verdicts = evaluated(one.protocol.claims, figures)
    return Result(one, label, {"seed": 1}, Played(those), 0, figures, verdicts, 1.0)


def hardware(protocol: Any) -> list[dict[str, Any]]:
    """Three robots of each command and delay, with every figure where targets are in time."""
    rows = []
    for delay in (0.0, *protocol.delays_ms):
        for x, y, yaw in protocol.commands:
            for n in range(3):
                row = {"x": x, "y": y, "yaw": yaw, "delay_ms": delay, "robot": n, "fell": delay > 20.0 and n == 0}
                row |= {"left_map": False, "moving_s": 8.0, "fingerprint": float(n)}
                names = [c.name for c in protocol.columns() if c.name not in row] if delay == 0.0 else []
                rows.append({**row, **{name: 0.3 + 0.01 * n for name in names}})
    return rows


def rate(error: float) -> Callable[[Any], list[dict[str, Any]]]:
    """Return rows of four robots of each rate and delay with about this error."""

    def rows(protocol: Any) -> list[dict[str, Any]]:
        return [
            {"velocity": velocity, "rate_hz": hz, "delay_ms": delay, "robot": n, "fell": False, "left_map": False}
            | {
                "moving_s": 5.0,
                "fingerprint": float(n),
                "rmse_xy": error * (1.0 + 0.02 * n) + 0.01 * n,
                "rmse_yaw": 0.1 - 0.01 * n,
            }
            | {"target_rate": 5.0 + n, "torque_rms": 4.0 + n}
            for velocity in protocol.velocities
            for hz in protocol.rates_hz
            for delay in protocol.delays_ms
            for n in range(4)
        ]

    return rows


def compared_page() -> str:
    few = ("rates_hz=[50.0,100.0]", "delays_ms=[0.0]")
    first, other = (made("rate", label, rate(e), *few) for label, e in (("a first one", 0.1), ("another one", 0.3)))
    return comparison({"rate": [first, other]}, {"rate": comparing.compared(first, other)}, {"seed": 1})


def test_conditions_in_words() -> None:
    assert condition_text({"x": 0.5, "y": 0.0, "yaw": 0.0, "delay_ms": 10.0}) == "x 0.5 m/s, delay 10 ms"
    assert condition_text({"y": 0.0, "yaw": 0.0}) == "y 0 m/s, yaw 0 rad/s"
    assert condition_text({"ground": "slope_up", "difficulty": 5.0}) == "ground slope up, difficulty 5 deg"
    assert condition_text({"ground": "gravel", "difficulty": 0.02}) == "ground gravel, difficulty 0.02 m"
    assert condition_text({"rate_hz": 100.0 / 3.0}) == "rate 33.33 Hz"
    assert condition_text({}) == "all"


def test_tables_have_no_row_without_a_figure_and_one_row_for_a_condition() -> None:
    one = made("hardware", "clock", hardware)
    tables = figure_tables(one.summary, meanings(one))
    conditions = len({(r["x"], r["y"], r["yaw"], r["delay_ms"]) for r in one.played.rows})
    assert len(tables[0].rows) == conditions
    assert list(tables[0].header[1:3]) == ["fell", "falls_per_minute (1/min)"]
    for table in tables:
        assert all(any(row[1:]) for row in table.rows)
        assert len({str(row[0]) for row in table.rows}) == len(table.rows)
        assert all(len(row) == len(table.header) for row in table.rows)
    widths = [len(table.header) - 1 for table in tables if table.header[0] == "condition"]
    assert max(widths) <= ACROSS
    assert max(widths) - min(widths) <= len(widths)  # no table for the last quantity alone
    assert not any("left_map" in table.header for table in tables)  # nobody did


def test_the_head_says_the_verdicts() -> None:
    one = made("hardware", "clock", hardware)
    head = page(one).split("</header>")[0]
    for v in one.verdicts:
        assert v.name.replace("_", " ") in head
    for word in {v.word for v in one.verdicts}:
        assert f"{word}: {sum(v.word == word for v in one.verdicts)}<" in head
    assert re.search(
        r"worse: 4<.*rate, another one: rmse_xy \(in 4 conditions\)", compared_page().split("</header>")[0]
    )


def test_units_are_those_of_the_ground() -> None:
    """Where half pass is an angle on slopes and a height on gravel."""
    one = selected("terrain")
    half: dict[str, Estimate] = {
        "slope_up": {"estimate": 20.0, "low": 18.0, "high": 22.0, "n": 4, "unit": "deg"},
        "gravel": {"estimate": 0.05, "low": 0.04, "high": 0.06, "n": 4, "unit": "m"},
    }
    summary: list[SummaryEntry] = [
        {"condition": {"ground": g, "speed": 1.0}, "n": 4, "figures": {"at_half": f}} for g, f in half.items()
    ]
    verdicts = evaluated(one.protocol.claims, summary)
    result = Result(one, "clock", {}, Played([]), 0, summary, verdicts, 1.0)
    claims = {row[0]: row for row in claims_table(result, meanings(result)).rows}
    assert claims["incline"][3] == "at least 15 deg"
    (table,) = figure_tables(summary, meanings(result))
    assert list(table.header) == ["quantity", "ground slope up, speed 1 m/s", "ground gravel, speed 1 m/s"]
    (row,) = table.rows
    assert [cell.text for cell in row if isinstance(cell, Cell)] == ["at_half", "20 deg", "0.05 m"]


def test_meanings_are_words() -> None:
    result = made("hardware", "clock", hardware)
    assert all(column.unit != "-" for column in result.chosen.protocol.columns())
    for meaning in meanings(result).values():
        assert meaning
        assert "`" not in meaning
        assert "(N" not in meaning


@needs_chromium
@pytest.mark.parametrize("which", ["hardware", "compare"])
def test_no_element_is_wider_than_a_phone(which: str, tmp_path: Path) -> None:
    seen = on_a_phone(page(made("hardware", "clock", hardware)) if which == "hardware" else compared_page(), tmp_path)
    assert seen["page"] <= seen["width"] == PHONE
    assert seen["all"] > 100
    assert seen["wide"] == []
