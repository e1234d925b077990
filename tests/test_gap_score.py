"""The score of the sealed benchmark, worked out by hand on small sets of answers and results."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.gap import score
from benchmarks.gap.intervals import median, share

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
    assert value(found, "first") == pytest.approx(3 / 5)  # right, alias, and ranked first though not named
    assert value(found, "first_exact") == pytest.approx(2 / 5)
    assert value(found, "in_set") == pytest.approx(2 / 5)
    assert value(found, "set_size") == pytest.approx(5 / 3)
    assert value(found, "singles_wrong") == pytest.approx(1 / 5)
    assert value(found, "small_not_wrong") == 1.0
    assert value(found, "wrong_explained_library") == pytest.approx(1 / 5)
    assert value(found, "param_error") == pytest.approx(0.1)  # 0.02 / 0.2 and 0.03 / 0.3
    assert value(found, "coverage") == pytest.approx(1 / 2)
    assert value(found, "closed_median") == pytest.approx(0.9)
    assert value(found, "seconds_per_case") == value(found, "seconds_single") == 1.0
    assert value(found, "seconds_pair") is None
    assert value(found, "missing") == 1.0
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
    assert (value(found, "first"), value(found, "first_visible")) == (0.5, 1.0)


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
    answers = {
        "good": answer("null"),
        "named": answer("null"),
        "compensating": answer("null"),
        "background": answer("null", beyond="encoder_offset"),
    }
    results = {
        "good": result("no gap"),
        "named": result("partly explained", named("lag")),
        "compensating": result("partly explained", named("lag", status="compensating")),
        "background": result("explained", named("base_tilt")),  # in the family of what is really there
    }
    found = score.evaluate(answers, results)
    assert (value(found, "false_names"), value(found, "nulls")) == (2.0, 4.0)
    assert found.figures["false_name_rate"][0] == 0.5
    near = {"right": answer("near_null", beyond="viscous"), "wrong": answer("near_null", beyond="viscous")}
    found = score.evaluate(
        answers | near,
        results | {"right": result("explained", named("kd_scale")), "wrong": result("explained", named("coulomb"))},
    )
    assert (value(found, "false_names"), value(found, "nulls")) == (2.0, 6.0)
    assert value(found, "false_names_beyond") == pytest.approx(1 / 3)
    assert value(found, "nulls_no_gap") == pytest.approx(1 / 3)


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
    assert value(found, "outside_handled") == pytest.approx(2 / 5)
    assert value(found, "wrong_explained") == pytest.approx(1 / 5)


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
    assert value(found, "pairs_both") == pytest.approx(1 / 3)
    assert value(found, "pair_precision") == pytest.approx(4 / 5)


def test_friction_of_two_directions_is_its_mean_and_a_constant() -> None:
    answers = {"a": answer("single", effect("asymmetric_friction", forward=[0.2, 0.2], backward=[0.0, 0.0]))}
    both = result("explained", named("coulomb"), named("encoder_offset"))
    found = score.evaluate(answers, {"a": both})
    assert (value(found, "first"), value(found, "in_set"), value(found, "first_exact")) == (1.0, 1.0, 0.0)
    found = score.evaluate(answers, {"a": result("explained", named("coulomb"))})
    assert (value(found, "first"), value(found, "in_set")) == (1.0, 0.0)


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
    assert value(found, "not_excited_unnamed") == value(found, "not_excited_said") == 0.5
    assert value(found, "damaged_caught") == 0.5
    assert value(found, "bad_log_only_if_bad") == pytest.approx(2 / 3)


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
    assert value(found, "coverage") == pytest.approx(2 / 3)


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
    for only, cases in (("solved=false", 2.0), ("solved=true", 1.0)):
        score.main([*words, only])
        assert json.loads((tmp_path / "results.json").read_text())["nulls"] == cases
    seal.write_text("0" * 64 + "  answers.json\n")
    with pytest.raises(SystemExit, match="not the answers that were sealed"):
        score.main(words)
    with pytest.raises(SystemExit, match="usage"):
        score.main([])
