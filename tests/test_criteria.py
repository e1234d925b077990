"""Acceptance criteria on reports made by hand."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from go1exp.evaluate.criteria import CRITERIA, evaluated, missed
from go1exp.evaluate.table import acceptance


def row(*command: float, mean: tuple[float, ...] | None = None, **changes: Any) -> dict[str, Any]:
    """A command that a good robot follows: a trot of 2.5 Hz with equal loads."""
    feet = {"load_share": [0.25] * 4, "clearance": [0.05] * 4}
    whole = {"trot_error": 0.02, "stride_rate": 2.5, "touchdown_speed_p95": 0.7, "peak_force_p95": 2.0}
    figures = {**feet, **whole, "slip_share_all": 0.03, **changes}
    reached = command if mean is None else mean
    return {
        "command": list(command),
        "mean": dict(zip(("x", "y", "yaw"), reached, strict=True)),
        "rmse": {"x": 0.05, "y": 0.05, "yaw": 0.05},
        "distinct_falls": {"count": 0, "n": 20},
        "measures": {name: {"mean": value, "n": 20} for name, value in figures.items()},
    }


GOOD = [row(0, 0, 0), row(1, 0, 0), row(2, 0, 0), row(3, 0, 0), row(0, 0.5, 0), row(0, 0, 1.8), row(0.2, 0, 0)]


def test_a_good_robot_meets_every_criterion() -> None:
    report = {"commands": GOOD, "delay_margin": {"ms": 30}}
    assert missed(report) == set()
    assert [verdict.name for verdict in evaluated(report)] == [*(criterion.name for criterion in CRITERIA), "delay"]


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("trot error", row(1, 0, 0, trot_error=0.38)),
        ("trot error", row(1, 0, 0, trot_error=None)),  # no strides at all
        ("load share", row(0, 0.5, 0, load_share=[0.4, 0.3, 0.1, 0.2])),
        ("clearance", row(1, 0, 0, clearance=[0.05, 0.05, 0.002, 0.05])),
        ("stride rate", row(1, 0, 0, stride_rate=4.5)),
        ("stride rate", row(1, 0, 0, stride_rate=1.5)),
        ("touchdown speed", row(1, 0, 0, touchdown_speed_p95=1.5)),
        ("peak force", row(1, 0, 0, peak_force_p95=2.6)),
        ("slip", row(0, 0, 1.0, slip_share_all=0.2)),
        ("RMSE xy", {**row(1, 0, 0), "rmse": {"x": 0.02, "y": 0.09, "yaw": 0.0}}),
        ("RMSE yaw", {**row(2, 0, 0), "rmse": {"x": 0.2, "y": 0.2, "yaw": 0.11}}),
        ("commanded 2.0 m/s", row(2, 0, 0, mean=(1.89, 0.0, 0.0))),
        ("commanded 1.8 rad/s", row(0, 0, -1.8, mean=(0.0, 0.0, -1.6))),
        ("commanded 3.0 m/s", row(3, 0, 0, mean=(2.6, 0.0, 0.0))),
        ("commanded 0.1 to 0.3", row(0, -0.2, 0, mean=(0.0, -0.1, 0.0))),
        ("falls", {**row(0, 0, 0), "distinct_falls": {"count": 1, "n": 20}}),
    ],
)
def test_a_fault_fails_its_criterion_alone(name: str, bad: dict[str, Any]) -> None:
    assert missed({"commands": [*copy.deepcopy(GOOD), bad]}) == {name}
    (verdict,) = [v for v in evaluated({"commands": [*GOOD, bad]}) if v.name == name]
    assert list(verdict.command) == bad["command"]


def test_a_fall_at_30_ms_of_delay_fails_and_without_a_command_there_is_no_verdict() -> None:
    assert missed({"commands": GOOD, "delay_margin": {"ms": 20}}) == {"delay"}
    assert missed({"commands": GOOD, "delay_margin": {"ms": None}}) == {"delay"}
    assert evaluated({"commands": []}) == []
    unmeasured = [{k: v for k, v in r.items() if k != "measures"} for r in GOOD]
    names = [v.name for v in evaluated({"commands": unmeasured})]
    assert names == [c.name for c in CRITERIA[7:]]
    assert names[0] == "RMSE xy"


def test_the_report_lists_missed_criteria_by_how_much_and_where() -> None:
    assert acceptance({"commands": GOOD}) == ["acceptance criteria (go1exp/evaluate/criteria.py): 14 of 14 met"]
    slow = row(2, 0, 0, mean=(1.5, 0.0, 0.0), stride_rate=4.5)
    assert acceptance({"commands": [*GOOD, slow], "delay_margin": {"ms": None}}) == [
        "acceptance criteria (go1exp/evaluate/criteria.py): 12 of 15 met; missed, worst command's mean:",
        "  stride rate: 4.5 at +2, +0, +0",
        "  commanded 2.0 m/s: 0.75 at +2, +0, +0",
        "  delay: -",
    ]
    assert acceptance({"commands": []}) == []
