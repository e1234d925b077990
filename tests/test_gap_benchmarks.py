"""Benchmarks of ``go1exp gap``: what each counts, worked out by hand, and what it refuses."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import commands, gap_ablations, gap_next, gap_real, gap_sysid
from benchmarks.gap import cases, generate, known, logger, score
from benchmarks.gap.intervals import median, share
from benchmarks.gap.simulate import simulate
from benchmarks.gap.truth import Truth, apply
from benchmarks.gap_next import CASES, SEPARATED, Row, figures, line_of, ratios
from go1exp import robot
from go1exp.config.schema.registry import members
from go1exp.gap import files
from go1exp.gap.result import AngleErrors, GapResult, NamedEffect
from go1exp.gap.search.tolerances import confounded
from go1exp.logs.recording import Recording

CALVES = ["FR_calf", "FL_calf"]


def effect(name: str, size: float = 5.0, joints: list[str] = CALVES, **params: Any) -> dict[str, Any]:
    return {"effect": name, "size": size, "joints": joints, "params": params, "sizes": list(params)}


def answer(kind: str, *effects: dict[str, Any], beyond: str | None = None, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "effects": list(effects), "background_beyond": beyond, "clean": False, **more}


def named(name: str, alias: tuple[str, ...] = (), joints: list[str] = CALVES, **more: Any) -> dict[str, Any]:
    return {"effect": name, "joints": joints, "alias_set": [name, *alias], "params": {}, "interval": {}, **more}


def result(verdict: str, *names: dict[str, Any], closed: float | None = None, seconds: float = 1.0) -> dict[str, Any]:
    return {"verdict": verdict, "named": list(names), "closed": closed, "seconds": seconds}


def value(found: score.Score, figure: str) -> float | None:
    return found.figures[figure][0]


def counted(found: score.Score, **figures: float | None) -> None:
    """The score has these figures."""
    for name, wanted in figures.items():
        assert value(found, name) == (None if wanted is None else pytest.approx(wanted, rel=1e-12, abs=0)), name


def test_wilson_is_the_textbook_formula() -> None:
    good, n, z = 9, 12, 1.959964
    middle = (good / n + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(good / n * (1 - good / n) / n + z**2 / (4 * n**2))
    assert share([True] * 9 + [False] * 3) == pytest.approx((0.75, middle - half, middle + half, 12), abs=1e-5)
    assert share([]) == (None, 0.0, 1.0, 0)
    assert median([3.0]) == (3.0, 3.0, 3.0, 1)
    m, low, high, n = median(list(np.arange(101.0)))
    assert (m, n) == (50.0, 101)
    assert 35 < low < 50 < high < 65


def test_single_effects() -> None:
    answers = {
        "right": answer("single", effect("coulomb", bound=[0.2, 0.3])),
        "alias": answer("single", effect("viscous", damping=[0.1, 0.1])),
        "wrong": answer("single", effect("lag", time=[0.005, 0.005])),
        "unnamed": answer("single", effect("cogging", 2.0, amplitude=[0.1, 0.1])),
        "missing": answer("single", effect("armature", 2.0, added=[0.002, 0.002])),
        "small": answer("single", effect("strength", 1.0, scale=[1.05, 1.05])),
    }
    estimate: Any = {"params": {"bound": {"FR_calf": 0.22, "FL_calf": 0.27}}}
    interval: Any = {"interval": {"bound": {"FR_calf": [0.21, 0.23], "FL_calf": [0.25, 0.31]}}}
    results = {
        "right": result("explained", named("coulomb", ("load_friction",), **estimate, **interval), closed=0.998),
        "alias": result("explained", named("kd_scale", ("viscous",)), closed=0.9, seconds=3.0),
        "wrong": result("explained", named("kp_scale"), closed=0.5),
        "unnamed": {**result("unexplained"), "candidates": [{"effect": "cogging"}, {"effect": "coulomb"}]},
        "small": result("no gap"),
    }
    found = score.evaluate(answers, results)
    counted(found, first=3 / 5, first_exact=2 / 5, in_set=2 / 5, set_size=5 / 3)  # ranked first, though not named
    counted(found, singles_wrong=1 / 5, small_not_wrong=1.0, wrong_explained_library=1 / 5, missing=1.0)
    counted(found, param_error=0.1, coverage=1 / 2, closed_median=0.9)  # errors of 0.02 / 0.2 and 0.03 / 0.3
    counted(found, seconds_per_case=1.0, seconds_single=1.0, seconds_pair=None)
    assert found.confusion["viscous", "kd_scale"] == 1
    assert found.confusion["armature", "-"] == 1
    assert any(line.startswith("wrong: single, lag x5 on 2 joints -> explained") for line in found.failures["first"])
    assert "viscous: kd_scale 1" in score.table(found)


def test_visible_effects_are_counted_apart() -> None:
    answers = {
        "seen": answer("single", effect("coulomb", bound=0.2), signal=4.0),
        "hidden": answer("single", effect("base_tilt", 2.0, [], roll=0.02), signal=0.4),
    }
    found = score.evaluate(answers, {"seen": result("explained", named("coulomb")), "hidden": result("no gap")})
    counted(found, first=0.5, first_visible=1.0)


def test_effects_that_the_tolerances_make_up_for_are_counted_apart() -> None:
    answers = {name: answer("single", effect("coulomb", bound=0.2)) for name in ("gap", "missed", "made_up", "silent")}
    found = score.evaluate(
        answers,
        {
            "gap": {**result("explained", named("coulomb")), "excess": {"box": 3.0}},
            "missed": {**result("no gap"), "excess": {"box": 0.11}},
            "made_up": {**result("no gap"), "excess": {"box": 0.09}},
            "silent": result("bad log"),
        },
    )
    assert found.figures["in_set_material"][::3] == (0.5, 2)
    assert found.figures["in_set"][::3] == (0.25, 4)


def test_null_cases() -> None:
    answers = dict.fromkeys(("good", "named", "compensating"), answer("null"))
    answers["background"] = answer("null", beyond="encoder_offset")
    results = {
        "good": result("no gap"),
        "named": result("partly explained", named("lag")),
        "compensating": result("partly explained", named("lag", status="compensating")),
        "background": result("explained", named("base_tilt")),  # in the family of what is really there
    }
    found = score.evaluate(answers, results)
    counted(found, false_names=2.0, nulls=4.0, false_name_rate=0.5)
    near = {"right": answer("near_null", beyond="viscous"), "wrong": answer("near_null", beyond="viscous")}
    found = score.evaluate(
        answers | near,
        results | {"right": result("explained", named("kd_scale")), "wrong": result("explained", named("coulomb"))},
    )
    counted(found, false_names=2.0, nulls=6.0, false_names_beyond=1 / 3, nulls_no_gap=1 / 3)


def test_joints_are_right_if_they_are_all_and_no_others() -> None:
    at = ["FR_hip", "FR_thigh"]
    hidden = answer("single", effect("coulomb", joints=at, bound=[0.3, 0.3]))
    answers = dict.fromkeys(("right", "more", "less", "other"), hidden)
    results = {
        "right": result("explained", named("coulomb", joints=at[::-1])),
        "more": result("explained", named("coulomb", joints=[*at, "FL_hip"])),
        "less": result("explained", named("coulomb", joints=at[:1])),
        "other": result("explained", named("stribeck", joints=at)),  # counted by ``first``
    }
    assert score.evaluate(answers, results).figures["joints_exact"][::3] == (1 / 3, 3)


def test_effects_beyond_the_library() -> None:
    answers = {k: answer("outside", outside={"effect": "wind"}) for k in ("left", "partly", "named", "explained", "no")}
    results = {
        "left": result("unexplained"),
        "partly": result("partly explained", named("coulomb")),
        "named": result("unexplained", named("coulomb")),
        "explained": result("explained", named("coulomb")),
    }
    found = score.evaluate(answers, results)
    counted(found, outside_handled=2 / 5, wrong_explained=1 / 5)


def test_pairs() -> None:
    pair = (effect("coulomb", bound=0.2), effect("command_delay", delay=0.005))
    answers = {"both": answer("pair", *pair), "one": answer("pair", *pair), "worse": answer("pair", *pair)}
    compensating = named("command_delay", status="compensating")
    results = {
        "both": result("explained", named("command_delay"), named("coulomb")),
        "one": result("partly explained", named("coulomb"), compensating),
        "worse": result("explained", named("coulomb"), named("payload")),
    }
    found = score.evaluate(answers, results)
    counted(found, pairs_both=1 / 3, pair_precision=4 / 5)


def test_friction_of_two_directions_is_its_mean_and_a_constant() -> None:
    answers = {"a": answer("single", effect("asymmetric_friction", forward=[0.2, 0.2], backward=[0.0, 0.0]))}
    both = result("explained", named("coulomb"), named("encoder_offset"))
    found = score.evaluate(answers, {"a": both})
    counted(found, first=1.0, in_set=1.0, first_exact=0.0)
    found = score.evaluate(answers, {"a": result("explained", named("coulomb"))})
    counted(found, first=1.0, in_set=0.0)


def test_silent_and_damaged_logs() -> None:
    hidden = effect("torque_speed_limit", peak=[0.8, 0.8], droop=[0.4, 0.4])
    answers = {
        "silent": answer("not_excited", hidden),
        "loud": answer("not_excited", hidden),
        "bad": answer("damaged", damage="degrees"),
        "passed": answer("damaged", damage="dropped"),
        "null": answer("null"),
    }
    results = {
        "silent": result("not excited"),
        "loud": result("explained", named("torque_speed_limit")),
        "bad": result("bad log"),
        "passed": result("no gap"),
        "null": result("bad log"),
    }
    found = score.evaluate(answers, results)
    counted(found, not_excited_unnamed=0.5, not_excited_said=0.5, damaged_caught=0.5, bad_log_only_if_bad=2 / 3)


def test_numbers_and_lists_are_parameters_too() -> None:
    true = {**effect("base_tilt", joints=[], roll=0.02, pitch=-0.04), "sizes": ["roll", "pitch"]}
    answers = {"tilt": answer("single", true), "scale": answer("single", effect("strength", scale=[0.8, 0.9]))}
    tilt: Any = {"params": {"roll": 0.021, "pitch": {"robot": -0.044}}, "interval": {"roll": [0.015, 0.03]}}
    scale: Any = {"params": {"scale": [0.9, 0.9]}, "interval": {"scale": [[0.85, 0.95], [0.85, 0.95]]}}
    results = {
        "tilt": result("explained", named("base_tilt", joints=[], **tilt)),
        "scale": result("explained", named("strength", **scale)),
    }
    found = score.evaluate(answers, results)
    assert found.figures["param_error"] == pytest.approx((0.1, 0.05, 0.25, 3), abs=0.06)  # 5 %, 10 %, 25 %
    counted(found, coverage=2 / 3)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="b: no such case"):
        score.evaluate({"a": answer("null")}, {"b": result("no gap")})
    with pytest.raises(ValueError, match="a: verdict 'fine'"):
        score.evaluate({"a": answer("null")}, {"a": result("fine")})


def test_the_command_checks_the_seal_and_writes_flat_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers, results, seal = tmp_path / "answers.json", tmp_path / "results", tmp_path / "SEAL"
    answers.write_text(json.dumps({"case_a": answer("null"), "case_b": answer("null")}))
    (results / "case_b").mkdir(parents=True)
    (results / "case_a.json").write_text(json.dumps(result("no gap")))
    (results / "case_b" / "verdict.json").write_text(json.dumps(result("explained", named("coulomb"))))
    seal.write_text(hashlib.sha256(answers.read_bytes()).hexdigest() + "  answers.json\n")
    words = [f"answers={answers}", f"results={results}", f"seal={seal}", f"out={tmp_path / 'results.json'}"]
    score.main(words)
    assert "false_names" in capsys.readouterr().out
    flat = json.loads((tmp_path / "results.json").read_text())
    assert (flat["false_names"], flat["nulls"], flat["first"]) == (1.0, 2.0, None)
    assert set(score.BARS) | {"nulls"} <= set(flat)
    assert all(x is None or isinstance(x, int | float) for x in flat.values())
    (results / "case_a.json").unlink()
    for only, count in (("solved=false", 2.0), ("solved=true", 1.0)):
        score.main([*words, only])
        assert json.loads((tmp_path / "results.json").read_text())["nulls"] == count
    seal.write_text("0" * 64 + "  answers.json\n")
    with pytest.raises(SystemExit, match="not the answers that were sealed"):
        score.main(words)


# ---------------------------------------------------------------------- ablations: one set of cases for all methods


ANSWERS: dict[str, dict[str, Any]] = {
    "case_a": answer("null"),
    "case_b": answer("null"),
    "case_c": answer("single", effect("lag", 3.0)),
    "case_d": answer("outside", outside={"effect": "stick"}),
}
LAG, MASS = named("lag"), named("link_mass")
RESULTS: dict[str, dict[str, Any]] = {
    "whole": {
        "case_a": result("no gap"),
        "case_b": result("no gap"),
        "case_c": result("explained", LAG),
        "case_d": result("unexplained"),
    },
    "bic": {
        "case_a": result("explained", MASS),
        "case_c": result("explained", MASS),
        "case_d": result("explained", LAG),
    },
}


def drawn(out: Path, *_: Any) -> None:
    (out / "answers.json").parent.mkdir(parents=True, exist_ok=True)
    (out / "answers.json").write_text(json.dumps(ANSWERS))


def solved(method: str, out: Path, jobs: str) -> None:
    for case, result in RESULTS[method].items():
        (out / method / case).mkdir(parents=True, exist_ok=True)
        (out / method / case / "verdict.json").write_text(json.dumps(result))


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
    ("main", "words", "message"),
    [
        (gap_ablations.main, ["out=x"], "usage"),
        (gap_ablations.main, ["out=x", "seed=one"], "seed=one: must be a whole number"),
        (gap_ablations.main, ["out=x", "seed=1", "methods=whole,guess"], "methods=guess: there are whole"),
        (gap_next.main, ["out=x", "pairs=kd,tilts"], "pairs=tilts: there are tilt"),
        (gap_next.main, ["out=x", "strategies=best"], "strategies=best: "),
        (gap_next.main, ["n=2"], r"python -m benchmarks.gap_next out=DIR"),
        (gap_next.main, ["out=x", "most"], r"python -m benchmarks.gap_next out=DIR"),
        (gap_next.main, ["out=x", "strategy=next"], r"python -m benchmarks.gap_next out=DIR"),
        (gap_real.main, ["data=x"], "usage"),
        (gap_real.main, ["data=x", "out=y", "nonsense"], "usage"),
        (gap_real.main, ["data=x", "out=y", "sets=go3"], "sets=go3: there are xl330"),
        (score.main, [], "usage"),
    ],
)
def test_a_wrong_argument_is_refused(main: Callable[[list[str]], object], words: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        main(words)


# ---------------------------------------------------------------------- recordings until a pair is separated


MOST = 4


def row(strategy: str, seconds: float | None, seed: int = 0, **searched: object) -> Row:
    ended = "called not separable" if seconds is None else SEPARATED
    about = {"truth": "viscous", "rival": "kd_scale", "strategy": strategy, "seed": seed, "ended": ended}
    return about | {"seconds": seconds or 0.0, "powers": [0.1, 0.9]} | searched


def test_a_ratio_needs_one_of_the_two_to_tell_the_pair_apart() -> None:
    assert ratios([row("next", 6.0), row("standard", 24.0)], MOST, 6.0) == [0.25]
    assert ratios([row("next", 6.0), row("standard", None)], MOST, 6.0) == [0.2]
    assert ratios([row("next", None), row("standard", 12.0)], MOST, 6.0) == [2.5]
    assert ratios([row("next", None), row("standard", None)], MOST, 6.0) == []
    assert ratios([row("next", 6.0), row("standard", 24.0, seed=1)], MOST, 6.0) == []
    at_hand = {"ended": SEPARATED, "seconds": 0.0}
    assert ratios([row("next", None) | at_hand, row("standard", None) | at_hand], MOST, 6.0) == []


def test_the_ratio_is_a_median_over_pairs_and_seeds_with_an_interval() -> None:
    rows = [row(s, t, seed) for seed, t in enumerate((6.0, 12.0, 24.0)) for s in ("next",)]
    rows += [row("standard", 24.0, seed) for seed in range(3)]
    flat = figures(rows, MOST, 6.0)
    assert flat["next_over_standard"] == 0.5
    assert flat["next_over_standard_n"] == 3
    assert (flat["next_over_standard_low"], flat["next_over_standard_high"]) == (0.25, 1.0)


def test_searches_count_where_one_name_is_left_and_where_a_certified_one_is_wrong() -> None:
    right = row("next", 6.0, named=True, equals=1, false=0, answer="explained, viscous (certified)")
    several = row("next", 6.0, seed=1, named=True, equals=2, false=0, answer="")
    wrong = row("next", 6.0, seed=2, named=False, equals=0, false=1, answer="")
    flat = figures([right, several, wrong], MOST, 6.0)
    assert (flat["next_one_name"], flat["next_false_names"], flat["next_searches"]) == (1, 1, 3)
    assert "next_over_standard" not in flat
    assert line_of(right).endswith("10% 90% (separated; explained, viscous (certified))")


def test_pairs_are_of_registered_effects_that_look_alike() -> None:
    for case in CASES.values():
        assert {case.truth, case.rival} <= {*members("effect")}
    assert all(confounded(CASES[name].truth, CASES[name].rival) for name in {*CASES} - {"spring"})


# ---------------------------------------------------------------------- real robots


def friction(effect: str, low: float, high: float, status: str = "certified") -> NamedEffect:
    interval = {"bound": {"elbow": (low, high)}}
    return NamedEffect(effect, ("elbow",), {"bound": {"elbow": low}}, interval, (effect,), status)  # type: ignore[arg-type]


def compared(*effects: NamedEffect, removed: float = 0.8) -> GapResult:
    errors = AngleErrors(20, (0.02, 0.004), removed, 0.05, {}, {})
    return replace(GapResult("partly explained", "so"), named=effects, errors=errors)


def test_halves_contradict_each_other_where_intervals_of_one_joint_do_not_meet() -> None:
    low, high, near = friction("coulomb", 0.1, 0.2), friction("coulomb", 0.3, 0.4), friction("coulomb", 0.15, 0.35)
    assert gap_real.compared([compared(low), compared(high)]) == (2, 2, 2)
    assert gap_real.compared([compared(low), compared(near)]) == (2, 2, 0)
    assert gap_real.compared([compared(low), compared(friction("coulomb", 0.3, 0.4, "compensating"))]) == (1, 1, 1)
    assert gap_real.compared([compared(low), compared(friction("viscous", 0.3, 0.4))]) == (2, 0, 0)
    assert gap_real.compared([compared(), compared(friction("coulomb", 0.3, 0.4, "compensating"))]) == (0, 0, 0)


def test_every_second_recording_is_of_each_half(tmp_path: Path) -> None:
    logs = tmp_path / "xl330"
    logs.mkdir()
    for name in "dbac":
        (logs / f"{name}.parquet").write_text(name)
    first, second = gap_real.halves(logs)
    assert [file.name for file in sorted(first.iterdir())] == ["a.parquet", "c.parquet"]
    assert [file.name for file in sorted(second.iterdir())] == ["b.parquet", "d.parquet"]


def test_least_is_none_where_a_set_could_not_be_compared() -> None:
    flat = gap_real.figures("xl330", compared(removed=0.7)) | gap_real.figures("go2", compared(removed=0.6))
    assert gap_real.least(flat) == 0.6
    assert flat["real_after_go2_mrad"] == 4.0
    bad = replace(compared(), errors=None)
    assert gap_real.least(flat | gap_real.figures("so101", bad)) is None


def test_sets_are_asked_as_a_whole_and_by_halves_and_never_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def answering(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        asked.append(words)
        out = Path(words[-1].removeprefix("out="))
        if words[0] == "record":
            out.mkdir(parents=True)
            for k in range(gap_real.FEWEST):
                (out / f"{k}.parquet").touch()
        else:
            files.save(compared(friction("coulomb", 0.1, 0.2)), out)
        return 0

    monkeypatch.setattr(commands, "run", answering)
    for _ in range(2):
        gap_real.main([f"data={tmp_path}", f"out={tmp_path / 'out'}", "sets=xl330"])
    assert [words[0] for words in asked] == ["record", "gap", "gap", "gap"]
    assert {word for words in asked[1:] for word in words if "model=" in word} == {"model=xl330_pendulum"}
    assert '"real_certified": 2' in (tmp_path / "out" / "gap.json").read_text()


# ---------------------------------------------------------------------- the baseline that fits everything at once


needs_sysid = pytest.mark.skipif(
    not hasattr(gap_sysid.sysid, "optimize"), reason='mujoco.sysid lacks its own dependencies: "mujoco[sysid]"'
)

EVERY = np.arange(robot.NUM_JOINTS)
NOISE = np.repeat([4e-4, 0.04], robot.NUM_JOINTS)


def recordings(truth: Truth, seconds: float, motions: tuple[str, ...] = ("steps", "gait")) -> list[Recording]:
    """Return what a logger without errors writes about a robot that is simulated in steps of 0.1 ms."""
    rng = np.random.default_rng(3)
    episodes = cases.experiment(motions, len(motions) + 1, seconds, rng)[:-1]
    samples = simulate(truth, episodes, 1e-4, rng, np.zeros(robot.NUM_JOINTS, dtype=bool))
    perfect = logger.Logger()
    return [
        Recording(logger.meta(e), logger.log(perfect, samples, k, e.target, e.on, rng)) for k, e in enumerate(episodes)
    ]


@needs_sysid
@pytest.mark.parametrize("effect", gap_sysid.FITTED)
def test_the_model_at_the_hidden_values_replays_the_hidden_robot(effect: str) -> None:
    name = gap_sysid.FITTED[effect][0]
    null, unit = known.null(effect, name), known.TOLERANCES[effect][name]
    truth = Truth()
    value = null + 5.0 * unit if effect == "base_tilt" else np.full(robot.NUM_JOINTS, null + 5.0 * unit)
    apply(truth, effect, {"roll": 0.0, name: value} if effect == "base_tilt" else {name: value}, EVERY)
    fit = gap_sysid.Fit(recordings(truth, 0.4), NOISE)
    params = gap_sysid.parameters()
    for each in gap_sysid.FITTED:
        at_null = np.zeros(params[each].size)
        params[each].value = at_null + (5.0 if each == effect else 0.0)
    right = fit.rms(params.as_vector())
    assert right < 0.7  # the truth steps by 0.1 ms, and friction is LuGre's
    assert fit.rms(np.zeros(params.size)) > 3.0 * right


@needs_sysid
def test_one_replay_for_four_legs_gives_the_jacobian() -> None:
    fit = gap_sysid.Fit(recordings(Truth(), 0.4, ("gait",)), NOISE)
    x = np.zeros(gap_sysid.parameters().size)
    r = np.concatenate(fit.residual(x, gap_sysid.parameters())[0])
    one_by_one = np.concatenate(fit.residual(x[:, None] + gap_sysid.STEP * np.eye(x.size), gap_sysid.parameters())[0])
    expected = (one_by_one - r[:, None]) / gap_sysid.STEP
    found = fit.jacobian(x[:, None], r[:, None])
    assert np.linalg.norm(expected, axis=0).min() > 0.0
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@needs_sysid
@pytest.mark.slow("benchmarks/")
def test_a_large_armature_is_found_and_the_verdict_can_be_scored(tmp_path: Path) -> None:
    case = cases.make("null", 0, 5, count=3, seconds=1.5)  # a clean robot, to which one effect is added
    joint = robot.JOINTS.index("FL_thigh")
    values: cases.Values = {"added": np.array([0.005])}
    apply(case.truth, "armature", values, np.array([joint]))
    case.answer |= {"kind": "single", "effects": [cases.effect_answer("armature", 5.0, np.array([joint]), values)]}
    generate.write_case(case, tmp_path / "cases")
    line = gap_sysid.solve(tmp_path / "cases" / case.name, tmp_path / "out")
    assert "armature" in line
    verdict = json.loads((tmp_path / "out" / case.name / "verdict.json").read_text())
    assert verdict["verdict"] == "explained"
    assert verdict["closed"] > 0.8
    assert verdict["named"][0]["effect"] == "armature"
    assert verdict["named"][0]["joints"] == ["FL_thigh"]
    assert verdict["named"][0]["params"]["added"]["FL_thigh"] == pytest.approx(0.005, rel=0.1)
    assert {c["effect"] for c in verdict["candidates"]} == set(gap_sysid.FITTED) <= set(known.LIBRARY)
    found = score.evaluate({case.name: case.answer}, score.read_results(tmp_path / "out"))
    assert found.figures["first_exact"][0] == 1.0, found.failures


@needs_sysid
def test_what_is_no_recording_is_a_bad_log(tmp_path: Path) -> None:
    (tmp_path / "case_x").mkdir()
    (tmp_path / "case_x" / "episode_00.parquet").write_bytes(b"nothing")
    assert "bad log" in gap_sysid.solve(tmp_path / "case_x", tmp_path / "out")
    assert json.loads((tmp_path / "out/case_x/verdict.json").read_text())["verdict"] == "bad log"
