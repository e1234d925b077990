"""What the user accepts: an error of the angles that does not matter, beside the noise floor."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from go1exp.cli.gap import GapVerb
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.settings import parse
from go1exp.gap.answer import decide
from go1exp.gap.files import from_dict
from go1exp.gap.report import words
from go1exp.gap.result import AngleErrors, GapResult, GapSettings, NamedEffect
from go1exp.gap.score import angle_errors


def settings(accept: str) -> GapVerb:
    container = compose("gap", ["logs=recordings", f"accept={accept}"])
    return parse(GapVerb, {k: v for k, v in container.items() if k not in ("robot", "model")})


@pytest.mark.parametrize(("given", "rad"), [("2mrad", 0.002), ("0.002", 0.002), ("1deg", math.pi / 180), ("0", 0.0)])
def test_an_angle_is_in_rad_or_says_its_unit(given: str, rad: float) -> None:
    assert settings(given).accept == pytest.approx(rad)


@pytest.mark.parametrize("given", ["2inch", "mrad", "-1", "much"])
def test_another_angle_is_refused_in_one_line(given: str) -> None:
    with pytest.raises(ConfigError) as error:
        settings(given)
    assert len(error.value.problems) == 1
    assert str(error.value).startswith("accept = ")


def search(**changes: Any) -> Any:
    signal = dict.fromkeys(("coulomb", "viscous"), 100.0)
    return SimpleNamespace(**{"settings": GapSettings(), "signal": signal, "first": 80.0, **changes})


def term(status: Literal["certified", "compensating"]) -> NamedEffect:
    return NamedEffect("coulomb", ("knee",), {}, {}, ("coulomb",), status)


def test_what_remains_is_right_if_it_is_accepted_and_the_names_stay() -> None:
    sure = (term("certified"),)
    assert decide(search(), sure, 40.0, False) == "partly explained"
    assert decide(search(), sure, 40.0, True) == "explained"
    assert decide(search(), (), 80.0, False) == "unexplained"
    assert decide(search(), (), 80.0, True) == "no gap"
    assert decide(search(signal={"coulomb": 0.0}), (), 80.0, True) == "not excited"


def test_names_none_of_which_is_certain_explain_nothing_however_near_they_come() -> None:
    sure, unsure = term("certified"), term("compensating")
    assert decide(search(), (unsure, unsure), 0.1, False) == "partly explained"
    assert decide(search(), (unsure,), 0.1, True) == "explained"
    assert decide(search(), (unsure, sure), 0.1, False) == "explained"
    quick = search(settings=GapSettings(bootstraps=0))  # how certain they are was not asked
    assert decide(quick, (unsure,), 0.1, False) == "explained"


def test_every_joint_of_a_window_must_be_within_beside_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    off = 1e-3 * np.array([[1.0, 1.0], [1.0, 2.2], [0.0, 3.0], [0.5, 0.5]])  # windows by joints
    monkeypatch.setattr(angle_errors, "of_angles", lambda scorer, residual, windows: off[windows])
    quiet: Any = SimpleNamespace(scale=np.full((4, 1, 1), 1e-6))
    noisy: Any = SimpleNamespace(scale=np.full((4, 1, 1), 1e-3))
    every, empty = np.arange(4), np.empty(0)
    assert angle_errors.within(quiet, empty, every, 0.002) == 0.5
    assert angle_errors.within(noisy, empty, every, 0.002) == 0.75  # 2.2 is less than the root of 2² + 1²
    assert angle_errors.within(quiet, empty, every, 0.003001) == 1.0


def test_the_report_says_the_share_and_older_files_have_none() -> None:
    errors = AngleErrors(10, (0.005, 0.001), 0.8, 0.1, {"a": (0.005, 0.001)}, {"e": (0.005, 0.001)}, (0.2, 0.95))
    assert "Within the accepted error: 20 % of the windows before, 95 % after." in words.angles(errors)
    plain = GapResult("no gap", "", errors=errors).as_dict()
    assert from_dict(plain).errors == errors
    del plain["errors"]["within"], plain["tolerances"]
    assert from_dict(plain).errors == dataclasses.replace(errors, within=None)
    assert "accept" not in words.angles(dataclasses.replace(errors, within=None))


def test_a_verdict_by_what_is_accepted_says_what_would_change_it() -> None:
    about = {"settings": {"accept": 0.006, "adequate": 0.5}}
    result = GapResult("no gap", "", excess={"null": 400.0, "box": 77.0, "final": 77.0}, provenance=about)
    assert words.would_change(result)[0].startswith("An accept below 6 mrad: relative to the noise, 78 is above 1.5")
    small = dataclasses.replace(result, excess={"null": 1.0, "box": 0.2, "final": 0.2})
    assert words.would_change(small)[0].startswith("A held-out error above 1.5")
