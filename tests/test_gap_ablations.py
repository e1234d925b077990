"""``benchmarks/gap_ablations.py``: one set of cases for all methods, its table by hand, and going on."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import gap_ablations
from benchmarks.gap import generate

ANSWERS: dict[str, dict[str, Any]] = {
    "case_a": {"kind": "null", "effects": [], "background_beyond": None},
    "case_b": {"kind": "null", "effects": [], "background_beyond": None},
    "case_c": {
        "kind": "single",
        "background_beyond": None,
        "effects": [{"effect": "lag", "size": 3.0, "joints": ["FR_calf"], "params": {}, "sizes": []}],
    },
    "case_d": {"kind": "outside", "effects": [], "background_beyond": None, "outside": {"effect": "stick"}},
}
LAG = {"effect": "lag", "joints": ["FR_calf"], "alias_set": ["lag"], "params": {}, "interval": {}}
MASS = {**LAG, "effect": "link_mass", "alias_set": ["link_mass"]}
RESULTS: dict[str, dict[str, Any]] = {
    "whole": {
        "case_a": {"verdict": "no gap", "named": []},
        "case_b": {"verdict": "no gap", "named": []},
        "case_c": {"verdict": "explained", "named": [LAG]},
        "case_d": {"verdict": "unexplained", "named": []},
    },
    "bic": {
        "case_a": {"verdict": "explained", "named": [MASS]},
        "case_c": {"verdict": "explained", "named": [MASS]},
        "case_d": {"verdict": "explained", "named": [LAG]},
    },
}


def drawn(out: Path, *_: Any) -> None:
    (out / "answers.json").parent.mkdir(parents=True, exist_ok=True)
    (out / "answers.json").write_text(json.dumps(ANSWERS))


def solved(method: str, out: Path, jobs: str) -> None:
    for case, result in RESULTS[method].items():
        (out / method / case).mkdir(parents=True, exist_ok=True)
        (out / method / case / "verdict.json").write_text(json.dumps({**result, "seconds": 1.0}))


def test_the_table_is_that_of_each_methods_cases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gap_ablations, "draw", drawn)
    monkeypatch.setattr(gap_ablations, "solve", solved)
    gap_ablations.main([f"out={tmp_path}", "seed=1", "methods=whole"])
    gap_ablations.main([f"out={tmp_path}", "seed=1", "methods=bic"])  # and the first one stays in the table
    table = capsys.readouterr().out
    assert "0% (0% to 66%) of 2" in table
    with open(tmp_path / "ablations.csv") as file:
        whole, bic = csv.DictReader(file)
    assert [row["cases"] for row in (whole, bic)] == ["4", "3"]
    assert [float(row["false_name_rate"]) for row in (whole, bic)] == [0.0, 1.0]
    assert [float(row["in_set"]) for row in (whole, bic)] == [1.0, 0.0]
    assert [float(row["singles_wrong"]) for row in (whole, bic)] == [0.0, 1.0]
    assert [float(row["wrong_explained"]) for row in (whole, bic)] == [0.0, 1.0]
    assert float(bic["first_n"]) == 1
    figures = json.loads((tmp_path / "ablations.json").read_text())
    assert figures["ablation_bic_in_set"] == 0.0
    assert "python -m benchmarks.gap_ablations seed=1" in figures["made_by"]


def test_every_method_is_told_of_the_same_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr(gap_ablations.gap_solve, "main", asked.append)
    for method in ("whole", "no_box"):
        gap_ablations.solve(method, tmp_path, "3")
    whole, no_box = asked
    assert f"cases={tmp_path / 'cases'}" in whole
    assert whole[0] == no_box[0]
    assert {*no_box} - {*whole} == {f"out={tmp_path / 'no_box'}", "calibrate=false", "max_terms=1"}


def test_a_missing_extra_is_told_before_anything_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gap_ablations.gap_sysid, "sysid", object())
    with pytest.raises(SystemExit, match=r"mujoco\[sysid\]"):
        gap_ablations.main([f"out={tmp_path / 'x'}", "seed=1"])
    assert not (tmp_path / "x").exists()


def test_cases_are_drawn_once_and_their_answers_sealed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one case of each kind, of which the simulation is left out."""
    monkeypatch.setattr(gap_ablations, "PLAN", {kind: (1, size) for kind, (_, size) in gap_ablations.PLAN.items()})
    monkeypatch.setattr(generate, "write_case", lambda case, out, signals=None: (out / case.name).mkdir())
    for _ in range(2):
        gap_ablations.draw(tmp_path, 5, "1")
    answers = json.loads((tmp_path / "answers.json").read_text())
    assert sorted(a["kind"] for a in answers.values()) == ["near_null", "null", "outside", "single"]
    assert sorted(p.name for p in (tmp_path / "cases").iterdir()) == sorted(answers)
    assert all(p.resolve().is_dir() for p in (tmp_path / "cases").iterdir())
    with pytest.raises(SystemExit, match="other settings"):
        gap_ablations.draw(tmp_path, 6, "1")


def test_there_are_sixty_cases_and_every_ablation_is_a_setting() -> None:
    from go1exp.gap.result import GapSettings

    assert sum(n for n, _ in gap_ablations.PLAN.values()) >= 60
    names = GapSettings.__dataclass_fields__
    assert all(key in names for _, settings in gap_ablations.METHODS.values() for key in settings)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["out=x"], "usage"),
        (["out=x", "seed=one"], "seed=one: must be a whole number"),
        (["out=x", "seed=1", "methods=whole,guess"], "methods=guess: there are whole"),
    ],
)
def test_a_wrong_argument_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        gap_ablations.main(words)
