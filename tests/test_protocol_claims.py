"""Verdicts at their borders, figures from rows, and the statistics that both stand on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from go1exp.evaluate.protocol.claims import Claim, evaluated, verdict
from go1exp.evaluate.quantities import FELL, FINGERPRINT, MOVING, Column, distinct, summary
from go1exp.evaluate.statistics.intervals import (
    Interval,
    bootstrap_interval,
    logistic_fit,
    paired_mean_interval,
    paired_share_interval,
    pairs_needed,
    rate_interval,
)
from go1exp.evaluate.statistics.runs import verdict_by_interval

MOST = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here")
LEAST = Claim(quantity="error", at_least=1.0, tolerance=0.2, source="here")
BETWEEN = Claim(quantity="error", at_least=0.9, at_most=1.1, tolerance=0.05, source="here")
NAN = math.nan


@pytest.mark.parametrize(
    ("claim", "estimate", "low", "high", "said"),
    [
        (MOST, 0.9, 0.8, 1.0, "met"),
        (MOST, 0.9, 0.8, 1.01, "close"),
        (MOST, 1.0, 0.8, 1.2, "close"),
        (MOST, 1.0, 0.8, 1.21, "inconclusive"),
        (MOST, 1.2, 1.01, 1.5, "close"),
        (MOST, 1.21, 1.01, 1.5, "not met"),
        (MOST, 0.9, NAN, NAN, "inconclusive"),
        (MOST, NAN, NAN, NAN, "inconclusive"),
        (LEAST, 1.1, 1.0, 1.2, "met"),
        (LEAST, 1.0, 0.8, 1.2, "close"),
        (LEAST, 1.0, 0.79, 1.2, "inconclusive"),
        (LEAST, 0.79, 0.6, 0.99, "not met"),
        (BETWEEN, 1.0, 0.9, 1.1, "met"),
        (BETWEEN, 1.0, 0.86, 1.14, "close"),
        (BETWEEN, 1.0, 0.8, 1.2, "inconclusive"),
        (BETWEEN, 1.3, 1.2, 1.4, "not met"),
        (BETWEEN, 0.7, 0.6, 0.8, "not met"),
    ],
)
def test_verdicts_at_their_borders(claim: Claim, estimate: float, low: float, high: float, said: str) -> None:
    assert verdict(Interval(estimate, low, high, 10), claim) == said


def test_a_claim_is_judged_by_its_worst_condition() -> None:
    rows = [{"speed": s, "error": e, "robot": n} for s, e in ((1.0, 0.5), (2.0, 3.0)) for n in range(5)]
    for n, row in enumerate(rows):
        row["error"] += 0.01 * (n % 5)
    entries = summary(rows, ("speed",), (Column("error", "m", "an error"),))
    everywhere = evaluated({"small": MOST}, entries)[0]
    assert (everywhere.word, everywhere.condition, everywhere.conditions) == ("not met", {"speed": 2.0}, 2)
    where = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here", where={"speed": 1.0})
    assert evaluated({"small": where}, entries)[0].word == "met"
    nowhere = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here", where={"speed": 7.0})
    assert evaluated({"small": nowhere}, entries)[0].word == "inconclusive"


def test_falls_are_counted_per_moving_minute() -> None:
    rows = [{"a": 1, "robot": n, "fell": n < 3, "moving_s": 30.0} for n in range(20)]
    figures = summary(rows, ("a",), (FELL, MOVING))[0]["figures"]
    assert figures["fell"]["estimate"] == pytest.approx(0.15)
    assert figures["falls_per_minute"]["estimate"] == pytest.approx(3 / 10.0)
    known = stats.binomtest(3, 20).proportion_ci(method="wilson")
    assert figures["fell"]["low"] == pytest.approx(known.low, rel=1e-5)


def test_what_is_not_defined_of_a_robot_does_not_count() -> None:
    """A robot that was down before has no fall of its own, and is not in the share."""
    rows = [{"a": 1, "robot": n, "fell": None if n > 9 else n < 3, "moving_s": 30.0 * (n <= 9)} for n in range(20)]
    figures = summary(rows, ("a",), (FELL, MOVING))[0]["figures"]
    assert (figures["fell"]["n"], figures["fell"]["estimate"]) == (10, pytest.approx(0.3))
    assert figures["falls_per_minute"]["estimate"] == pytest.approx(3 / 5.0)


def test_only_robots_that_did_the_same_are_repeats() -> None:
    rows = [{"a": a, "robot": n, FINGERPRINT: mark} for a in (1, 2) for n, mark in enumerate((0.5, 0.7, 0.5))]
    assert [(r["a"], r["robot"]) for r in distinct(rows, ("a",), True)] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert [(r["a"], r["robot"]) for r in distinct(rows, ("a",), False)] == [(1, 0), (2, 0)]


# ---------------------------------------------------------------------- statistics


def test_rates_have_the_exact_poisson_interval() -> None:
    interval = rate_interval(3, 10.0)
    assert stats.poisson.cdf(3, 10.0 * interval.high) == pytest.approx(0.025)
    assert stats.poisson.sf(2, 10.0 * interval.low) == pytest.approx(0.025)
    none = rate_interval(0, 10.0)
    assert (none.low, none.high) == (0.0, pytest.approx(-math.log(0.025) / 10.0))
    assert math.isnan(rate_interval(0, 0.0).estimate)


@pytest.mark.parametrize(("middle", "slope"), [(15.0, 0.5), (0.08, 80.0)])
def test_a_known_threshold_is_found(middle: float, slope: float) -> None:
    rng = np.random.default_rng(0)
    x = np.repeat(np.linspace(0.2, 2.0, 9) * middle, 400)
    success = rng.uniform(size=len(x)) < 1.0 / (1.0 + np.exp(slope * (x - middle)))
    fit = logistic_fit(x, success)
    assert fit is not None
    assert fit.middle == pytest.approx(middle, rel=0.03)
    assert fit.slope == pytest.approx(slope, rel=0.15)
    assert float(fit(fit.where(0.95))) == pytest.approx(0.95)
    assert fit.where(0.95) < fit.middle


def test_a_threshold_between_two_levels_is_between_them_and_none_is_none() -> None:
    x = np.repeat([1.0, 2.0, 3.0, 4.0], 10)
    fit = logistic_fit(x, x < 2.5)
    assert fit is not None
    assert 2.0 < fit.middle < 3.0
    assert logistic_fit(x, x > 0) is None
    assert logistic_fit(x, x < 0) is None


def test_the_bootstrap_agrees_with_students_interval() -> None:
    each = np.random.default_rng(1).normal(size=200)
    found = bootstrap_interval(lambda robots: float(each[robots].mean()), 200, draws=2000)
    known = stats.t.interval(0.95, 199, each.mean(), stats.sem(each))
    np.testing.assert_allclose((found.low, found.high), known, atol=0.02)
    assert math.isnan(bootstrap_interval(lambda r: 1.0, 1).low)


@pytest.mark.parametrize("n", [3, 4, 8, 40])
def test_of_equal_pairs_one_in_twenty_is_told_apart_by_chance(n: int) -> None:
    rng = np.random.default_rng(n)
    words = [verdict_by_interval(paired_mean_interval(rng.normal(size=n)), "lower") for _ in range(2000)]
    significant = sum(w != "no significant difference" for w in words)
    assert stats.binomtest(significant, 2000, 0.05).pvalue > 0.001


def test_two_pairs_are_too_few_for_a_verdict() -> None:
    assert verdict_by_interval(paired_mean_interval(np.array([1.0, 1.01])), "lower") == "no significant difference"
    assert verdict_by_interval(paired_mean_interval(np.array([1.0, 1.01, 1.02])), "lower") == "worse"


def test_pairs_that_all_differ_alike_tell_nothing_and_equal_pairs_are_equal() -> None:
    same = paired_mean_interval([0.41 - 0.35, 0.43 - 0.37])  # kicks are timed by the policy's period
    assert same.estimate == pytest.approx(0.06)
    assert verdict_by_interval(same, "lower") == "no significant difference"
    assert pairs_needed([0.41 - 0.35, 0.43 - 0.37]) is None
    none = paired_mean_interval([0.0, 0.0, 0.0])
    assert (none.estimate, none.low, none.high) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("n", [10, 40, 400])
def test_shares_of_pairs_cover_the_truth(n: int) -> None:
    """Agresti and Min's interval holds the true difference in about 95 of 100 samples."""
    rng = np.random.default_rng(n)
    inside = 0
    for _ in range(400):
        base = rng.uniform(size=n)
        interval = paired_share_interval(base < 0.3, (base < 0.2) | (rng.uniform(size=n) < 0.3))
        inside += interval.low <= 0.2 + 0.8 * 0.3 - 0.3 <= interval.high
    assert 0.92 <= inside / 400 <= 0.995
    same = paired_share_interval(np.ones(n, bool), np.ones(n, bool))
    assert same.estimate == 0.0
    assert same.low < 0.0 < same.high


def test_the_pairs_that_would_tell_do_tell() -> None:
    rng = np.random.default_rng(3)
    seen = rng.normal(0.2, 1.0, 2000)
    needed = pairs_needed(seen)
    assert needed is not None
    known = (1.96 + 0.8416) ** 2 * (seen.std(ddof=1) / seen.mean()) ** 2
    assert needed == pytest.approx(known, rel=0.01)
    told = [stats.ttest_1samp(rng.normal(seen.mean(), seen.std(), needed), 0.0).pvalue < 0.05 for _ in range(300)]
    assert 0.72 <= np.mean(told) <= 0.88
    assert pairs_needed(np.zeros(10)) is None


def test_words_of_differences() -> None:
    assert verdict_by_interval(Interval(0.2, 0.1, 0.3, 9), "higher") == "better"
    assert verdict_by_interval(Interval(0.2, 0.1, 0.3, 9), "lower") == "worse"
    assert verdict_by_interval(Interval(-0.2, -0.3, -0.1, 9), "lower") == "better"
    assert verdict_by_interval(Interval(0.0, -0.1, 0.1, 9), "lower") == "no significant difference"
    assert verdict_by_interval(Interval(0.1, NAN, NAN, 1), "lower") == "no significant difference"
    assert verdict_by_interval(Interval(0.0, 0.0, 0.0, 9), "lower") == "no significant difference"
