"""How wrong a model is: windows at rest and wild windows must not decide (``go1exp/gap/score/likelihood.py``)."""

from __future__ import annotations

import ast
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import go1exp.gap
from go1exp.gap.report import words
from go1exp.gap.result import GapSettings
from go1exp.gap.score.angle_errors import angle_errors
from go1exp.gap.score.likelihood import KNEE, excess, log_chi2, removed
from go1exp.gap.search import significance


def test_a_joint_that_sticks_exactly_decides_nothing() -> None:
    """In a window at rest chi2 of a model with dry friction falls to 1e-11; that is no gain of 25 over a floor of 1."""
    before = np.array([[1.0], [50.0], [40.0], [60.0], [45.0]])
    rests = np.array([[1e-11], [55.0], [44.0], [66.0], [49.0]])  # worse in all windows that move
    moves = np.array([[1.0], [25.0], [20.0], [30.0], [22.0]])
    gain = significance.gains(before, np.stack([rests, moves]))
    assert gain.max(axis=1)[0] <= 1.0
    assert gain.mean(axis=1).argmax() == 1
    np.testing.assert_allclose(gain[0, 1:], -np.log([1.1, 1.1, 1.1, 49 / 45]), rtol=1e-9)


def test_below_the_floor_the_logarithm_goes_on_as_a_line() -> None:
    chi2 = np.array([1e-12, 0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 7.0])
    np.testing.assert_allclose(log_chi2(chi2), [-1.0, -0.5, 0.0, 0.0, 0.0, np.log(7.0)], atol=1e-8)
    grid = np.linspace(0.01, 5.0, 4000)
    np.testing.assert_allclose(np.gradient(log_chi2(grid), grid), 1 / np.maximum(grid, 1.0), atol=2e-3)


def test_no_other_logarithm_of_chi2_is_taken() -> None:
    """One place: a fit, a test or a screening with a logarithm of its own would have no floor again."""
    taken = []
    for file in sorted(Path(go1exp.gap.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.log":
                taken.append(f"{file.name}: {ast.unparse(node)}")
    # Schwarz's criterion, an ablation, is defined by the plain logarithm
    assert [line for line in taken if not line.startswith(("likelihood.py", "candidates.py"))] == []


def test_excess_is_the_plain_mean_where_no_window_is_wild() -> None:
    chi2 = np.random.default_rng(0).uniform(0.3, 0.95 * KNEE, (40, 4))
    assert excess(chi2) == pytest.approx(chi2.mean() - 1.0)
    assert np.isnan(excess(np.empty((0, 4))))


def test_a_few_wild_windows_do_not_decide_what_is_gone() -> None:
    """5 % of the windows get worse tenfold, all others four times better: a plain mean sees nothing gained."""
    rng = np.random.default_rng(1)
    before = 100.0 * rng.lognormal(0.0, 0.3, (200, 1))
    before[:10] *= 20.0
    after = before / 4.0
    after[:10] = 10.0 * before[:10]
    assert after.mean() > before.mean()
    assert removed(excess(before), excess(after)) > 0.5
    assert excess(before) < 150.0 < before.mean()


def test_a_gap_that_few_windows_show_is_still_one() -> None:
    settings = GapSettings()
    chi2 = np.full((160, 1), 0.9)
    chi2[:8] = 100.0  # a limit that is reached in a twentieth of the windows; a median would not see it
    assert excess(chi2) > settings.adequate
    assert np.median(chi2) < 1.0


def test_errors_are_told_in_mrad_by_joint_and_episode() -> None:
    """Two joints, four windows of two episodes, noise of 0.5 mrad; an initial state that explains a constant."""
    rng, samples = np.random.default_rng(2), 50
    windows = SimpleNamespace(
        joints=("hip", "calf"),
        quantities=("q",),
        t=np.zeros((4, samples)),
        valid=np.ones((4, samples), dtype=bool),
        episode=np.array([0, 0, 1, 1]),
    )
    machine = SimpleNamespace(groups=((0, 1),))
    state = np.zeros((4, 1, 2 * samples, 1))
    state[:, 0, ::2] = 1e4  # the hip's angle may be off by a constant
    scorer: Any = SimpleNamespace(
        windows=windows,
        replayer=SimpleNamespace(machine=machine),
        scale=np.full((4, 1, 2), 0.5e-3),
        state=state,
        common=np.zeros(1, dtype=bool),
    )
    wave = np.sin(np.linspace(0.0, 6 * np.pi, samples, endpoint=False))
    before = np.zeros((4, 1, samples, 2))
    before[..., 0] = 20.0 + 0.1 * rng.standard_normal((4, 1, samples))
    before[..., 1] = np.sqrt(2.0) * np.array([8.0, 8.0, 16.0, 16.0])[:, None, None] * wave  # 4 and 8 mrad
    after = before * np.array([1.0, 0.5])
    after[3] *= 100.0  # one wild window
    flat, halved = (r.reshape(4, 1, -1) for r in (before, after))
    errors = angle_errors((scorer, scorer), flat, halved, np.arange(4), ["slow", "fast"])
    assert errors.by_joint["hip"][0] < 0.1e-3
    assert errors.by_joint["calf"] == pytest.approx((6e-3, 3e-3), rel=0.02)
    assert errors.by_episode["slow"] == pytest.approx((4e-3 / np.sqrt(2), 2e-3 / np.sqrt(2)), rel=0.02)
    assert errors.removed == pytest.approx(0.5, abs=0.01)
    assert errors.worse == 0.25
    assert "The error of a window decreases by 50 % in the median" in words.angles(errors).replace("50.0", "50")
    assert ("calf", "6", "3") in words.angle_rows(errors)
