"""Statistics over robots and training runs against closed forms, a published example, and studies of known truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import go1exp.evaluate.statistics.runs as compare
from go1exp.base.paths import data_root
from go1exp.evaluate.statistics import association
from go1exp.evaluate.statistics.intervals import (
    Interval,
    bootstrap_interval,
    logistic_fit,
    mean_interval,
    paired_mean_interval,
    paired_share_interval,
    pairs_needed,
    phase_interval,
    rate_interval,
    share_interval,
    stratified_mean_interval,
)

Floats = NDArray[np.float64]
SAME = "no significant difference"

# ---------------------------------------------------------------------- interquartile mean


def test_the_interquartile_mean_is_the_mean_of_the_middle_half() -> None:
    assert float(compare.iqm([100.0, 1.0, 2.0, 3.0, -50.0])) == 2.0
    assert float(compare.iqm(np.arange(8.0))) == 3.5
    assert float(compare.iqm([1.0, 2.0, 6.0])) == 3.0  # of three, nothing is cut
    assert compare.iqm([[0.0, 2.0], [1.0, 3.0]]).tolist() == [1.0, 2.0]


def test_with_three_runs_the_interval_is_students() -> None:
    values = np.array([1.0, 2.0, 4.0])
    half = stats.t.ppf(0.975, 2) * values.std(ddof=1) / math.sqrt(3)
    got = compare.iqm_interval(values)
    assert got.n == 3
    assert got.estimate == pytest.approx(7 / 3)
    assert got.high - got.estimate == pytest.approx(half, rel=0.02)  # its critical value is simulated


def test_an_interval_needs_two_runs_and_leaves_out_what_is_undefined() -> None:
    assert math.isnan(compare.iqm_interval([1.0]).low)
    assert compare.iqm_interval([]).n == 0
    assert compare.iqm_interval([1.0, math.nan, 3.0]) == compare.iqm_interval([1.0, 3.0])


def test_a_band_is_the_interval_at_each_time() -> None:
    values = np.random.default_rng(0).normal(size=(7, 4))
    middle, low, high = compare.iqm_band(values)
    for k in range(4):
        one = compare.iqm_interval(values[:, k])
        assert (one.estimate, one.low, one.high) == pytest.approx((middle[k], low[k], high[k]))


@pytest.mark.parametrize("n", [4, 6, 10])
def test_the_mean_of_few_robots_has_students_interval_and_the_bootstraps_would_be_too_narrow(n: int) -> None:
    """The figures of docs/notebook/experiments.md: 95 % at any n, and 79, 86 and 90 %."""
    rng = np.random.default_rng(n)
    studies = rng.normal(size=(2000, n))
    held = [i.low <= 0.0 <= i.high for i in map(mean_interval, studies)]
    assert 0.93 <= np.mean(held) <= 0.97

    def resampled(values: Floats) -> Interval:
        return bootstrap_interval(lambda robots: float(values[robots].mean()), n, draws=200)

    held = [i.low <= 0.0 <= i.high for i in map(resampled, studies[:400])]
    assert abs(np.mean(held) - {4: 0.79, 6: 0.86, 10: 0.90}[n]) < 0.06


# ---------------------------------------------------------------------- rliable's examples


def test_what_differs_between_strata_makes_nothing_uncertain() -> None:
    rng = np.random.default_rng(4)
    values, strata = rng.normal(size=(5, 8)), np.repeat(np.arange(5), 8).reshape(5, 8)
    one = stratified_mean_interval(values, strata)
    shifted = stratified_mean_interval(values + 10.0 * np.arange(5)[:, None], strata)
    assert shifted.estimate - one.estimate == pytest.approx(20.0)
    assert shifted.high - shifted.low == pytest.approx(one.high - one.low)
    alone = stratified_mean_interval(values[0], np.zeros(8))
    assert vars(alone) == pytest.approx(vars(mean_interval(values[0])))
    # A stratum with fewer robots counts as much as the others, and is known less well.
    fewer = stratified_mean_interval(values.ravel()[:-6], strata.ravel()[:-6])
    means = [*values[:4].mean(axis=1), values[4, :2].mean()]
    assert (fewer.n, fewer.estimate) == (34, pytest.approx(np.mean(means)))
    assert math.isnan(stratified_mean_interval([1.0, 2.0], [0, 1]).low)
    # The mean of three times 0.1 is not 0.1 in floating point.
    same = stratified_mean_interval([0.1, 0.1, 0.1, 0.2, 0.2, 0.2], [0, 0, 0, 1, 1, 1])
    assert same.estimate == pytest.approx(0.15)
    assert math.isnan(same.low)


def test_intervals_within_strata_hold_the_truth_in_nineteen_of_twenty_studies() -> None:
    rng, strata = np.random.default_rng(7), np.repeat(np.arange(4), 5)
    studies = rng.normal(size=(2000, 20)) + np.array([0.0, 3.0, -1.0, 5.0])[strata]
    held = [
        abs(i.estimate - 1.75) <= i.high - i.estimate for i in (stratified_mean_interval(s, strata) for s in studies)
    ]
    assert 0.93 <= np.mean(held) <= 0.97


def test_the_examples_of_rliable_give_its_numbers() -> None:
    """Of rliable 1.2.0: tests/rliable/metrics_test.py for the points, and tests/library_test.py for the scores."""
    x, y = np.array([[1, 2], [2, 2], [1, 1], [2, 1]]), np.array([[1, 1], [2, 2], [3, 3]])
    assert float(compare.iqm(x.ravel())) == 1.5
    assert float(compare.iqm(y.ravel())) == 2.0
    assert compare.probability_of_improvement(x, y) == pytest.approx(1 / 3)
    scores = np.arange(80.0).reshape(5, 16)
    assert compare.probability_of_improvement(scores, scores + 10.0) == pytest.approx(0.4)


# ---------------------------------------------------------------------- falls


def test_runs_that_fall_alike_have_students_wilson_interval() -> None:
    """Without more spread than chance gives, only the quantile differs from Wilson's: none fell in the closed form."""
    got = compare.clustered_share([0, 0, 0], [40, 40, 40])
    z2 = stats.t.ppf(0.975, 2) ** 2
    assert (got.estimate, got.low, got.n) == (0.0, 0.0, 3)
    assert got.high == pytest.approx(z2 / (120 + z2))


def test_runs_of_which_one_falls_always_tell_little() -> None:
    alike, apart = compare.clustered_share([10, 10, 10, 10], [40] * 4), compare.clustered_share([40, 0, 0, 0], [40] * 4)
    assert apart.estimate == alike.estimate == 0.25
    assert apart.high - apart.low > 2.0 * (alike.high - alike.low)


def test_the_bootstrap_over_runs_draws_whole_runs() -> None:
    got = compare.share_bootstrap([40, 0], [40, 40])
    assert (got.estimate, got.low, got.high) == (0.5, 0.0, 1.0)
    assert math.isnan(compare.share_bootstrap([3], [40]).low)
    assert math.isnan(compare.clustered_share([3], [40]).low)


# ---------------------------------------------------------------------- robots


def test_the_mean_has_student_s_interval() -> None:
    interval = mean_interval([1.0, 2.0, 3.0, math.nan])
    assert (interval.estimate, interval.n) == (2.0, 3)
    assert interval.high - 2.0 == pytest.approx(4.302653 / np.sqrt(3), rel=1e-5)  # t(0.975, 2 degrees of freedom)
    assert math.isnan(mean_interval([4.0]).low)
    assert mean_interval([math.nan]).n == 0


def test_the_share_has_wilson_s_interval() -> None:
    assert share_interval(0, 600).low == 0.0
    assert share_interval(0, 600).high == pytest.approx(1.959964**2 / (600 + 1.959964**2), rel=1e-5)
    assert share_interval(13, 500).low == pytest.approx(0.01526, abs=1e-4)
    assert share_interval(0, 0).n == 0


def test_phases_on_both_sides_of_zero_have_their_mean_at_zero() -> None:
    interval = phase_interval([0.98, 0.02, 0.99, 0.01, math.nan])
    assert min(interval.estimate, 1.0 - interval.estimate) == pytest.approx(0.0, abs=1e-9)
    assert interval.n == 4
    assert interval.high - interval.low == pytest.approx(2 * mean_interval([-0.02, 0.02, -0.01, 0.01]).high)
    assert math.isnan(phase_interval([]).estimate)


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
    words = [compare.verdict_by_interval(paired_mean_interval(rng.normal(size=n)), "lower") for _ in range(2000)]
    significant = sum(w != SAME for w in words)
    assert stats.binomtest(significant, 2000, 0.05).pvalue > 0.001


def test_two_pairs_are_too_few_for_a_verdict() -> None:
    assert compare.verdict_by_interval(paired_mean_interval(np.array([1.0, 1.01])), "lower") == SAME
    assert compare.verdict_by_interval(paired_mean_interval(np.array([1.0, 1.01, 1.02])), "lower") == "worse"


def test_pairs_that_all_differ_alike_tell_nothing_and_equal_pairs_are_equal() -> None:
    same = paired_mean_interval([0.41 - 0.35, 0.43 - 0.37])  # kicks are timed by the policy's period
    assert same.estimate == pytest.approx(0.06)
    assert compare.verdict_by_interval(same, "lower") == SAME
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
    assert compare.verdict_by_interval(Interval(0.2, 0.1, 0.3, 9), "higher") == "better"
    assert compare.verdict_by_interval(Interval(0.2, 0.1, 0.3, 9), "lower") == "worse"
    assert compare.verdict_by_interval(Interval(-0.2, -0.3, -0.1, 9), "lower") == "better"
    for low, high in ((-0.1, 0.1), (math.nan, math.nan), (0.0, 0.0)):
        assert compare.verdict_by_interval(Interval(0.0, low, high, 9), "lower") == SAME
    # With p values they need both a small one and a direction.
    assert compare.verdict_by_p(-0.1, 0.01, "lower") == "better"
    assert compare.verdict_by_p(-0.1, 0.01, "higher") == "worse"
    assert compare.verdict_by_p(-0.1, 0.06, "lower") == compare.verdict_by_p(-0.1, math.nan, "lower") == SAME


# ---------------------------------------------------------------------- two groups


def test_a_permutation_test_counts_the_ways_to_share_the_runs_out() -> None:
    a, b = np.array([5.0, 6.0, 7.0, 8.0]), np.array([1.0, 2.0, 3.0, 4.0])
    assert compare.permutation_p(a, b) == pytest.approx(2 / 70)
    assert compare.least_p(4, 4) == pytest.approx(2 / 70)
    assert compare.permutation_p(a, b, paired=True) == pytest.approx(2 / 16)
    assert math.isnan(compare.permutation_p(a[:1], b))
    assert (compare.runs_for_significance(), compare.runs_for_significance(paired=True)) == (4, 6)
    assert compare.runs_for_significance(figures=7) == 6  # 2 / 252 times 7 is more than 0.05


def test_random_permutations_have_a_least_p_of_their_own() -> None:
    """Of ten and ten runs there are 184,756 ways, of which 20,000 are tried."""
    a, b = np.arange(10.0) + 100.0, np.arange(10.0)
    assert compare.permutation_p(a, b) == pytest.approx(2 / 20_001) == compare.least_p(10, 10)
    assert compare.permutation_p(np.arange(1.0, 17.0), np.zeros(16), paired=True) == compare.least_p(
        16, 16, paired=True
    )
    assert compare.least_p(7, 7) == pytest.approx(2 / 3432)  # all ways
    assert compare.runs_for_significance(figures=500) == 9
    assert compare.runs_for_significance(figures=501) is None
    assert compare.runs_needed(a, b, alpha=0.05 / 501) is None


def test_holm_takes_the_smallest_times_all_and_never_falls() -> None:
    assert compare.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    adjusted = compare.holm([0.02, math.nan, 0.5])
    assert (adjusted[0], adjusted[2]) == (0.04, 0.5)
    assert math.isnan(adjusted[1])
    assert compare.holm([]) == []


def test_effect_sizes_are_those_of_their_formulas() -> None:
    a, b = np.array([2.0, 4.0, 6.0]), np.array([1.0, 3.0, 5.0])
    assert compare.hedges(a, b) == pytest.approx(0.5 * (1 - 3 / 15))
    assert compare.probability_of_improvement(a, b) == pytest.approx(6 / 9)
    assert compare.probability_of_improvement([1.0], [1.0]) == 0.5
    assert math.isnan(compare.hedges(np.ones(3), np.ones(3)))


@pytest.mark.parametrize("paired", [False, True])
def test_runs_that_are_all_alike_say_nothing_of_how_sure_a_difference_is(paired: bool) -> None:
    """Three times 0.1 has another mean than 0.1 in floating point; a warning of SciPy would fail this test."""
    tenths, rounded = np.full(3, 0.1), np.array([0.1 + 0.2, 0.3, 0.3])
    for a, b in ((tenths, np.full(3, 0.3)), (rounded, np.full(3, 0.5)), (np.append(np.zeros(7), 1.0), np.ones(8))):
        got = compare.difference(a, b, paired)
        assert got.estimate.estimate < -0.1
        assert math.isnan(got.estimate.low)
        assert math.isnan(got.estimate.high)
        assert math.isnan(got.effect) == (len(a) == 3)
    same = compare.difference(tenths, tenths, paired)
    assert (same.estimate, same.p) == (Interval(0.0, 0.0, 0.0, 3), 1.0)
    assert math.isnan(same.effect)
    assert compare.permutation_p(rounded, np.full(3, 0.3)) == 1.0
    assert not math.isnan(compare.yuen(tenths, np.array([0.3, 0.3, 0.4]), paired).low)


def test_the_runs_needed_are_those_of_the_normal_approximation() -> None:
    a, b = np.array([0.0, 2.0, 4.0]), np.array([1.0, 3.0, 5.0])  # 4 + 4 of variance, 1 apart
    assert compare.runs_needed(a, b) == math.ceil(7.8489 * 8 + 0.25 * 3.8415)
    assert compare.runs_needed(a, a) is None
    assert compare.runs_needed(a, a + 100.0) == 4


# ---------------------------------------------------------------------- association


def test_a_quantity_that_rules_a_figure_stands_first_and_others_have_no_importance() -> None:
    rng = np.random.default_rng(0)
    friction, mass = rng.uniform(size=200), rng.uniform(size=200)
    names = rng.choice(["pd", "net"], size=200)
    figure = -np.exp(friction) + 0.4 * (names == "net") + 0.05 * rng.normal(size=200)
    got = {a.name: a for a in association.associations({"mass": mass, "friction": friction, "drive": names}, figure)}
    assert next(iter(got)) == "friction"
    assert got["friction"].spearman < -0.8
    assert got["friction"].p < 0.001
    assert math.isnan(got["drive"].spearman)
    assert got["drive"].p < 0.01
    assert got["friction"].importance > 0.5 > got["drive"].importance > 0.02 > abs(got["mass"].importance)
    assert got["mass"].p > 0.05


def test_few_rows_and_what_does_not_vary_tell_nothing() -> None:
    assert association.associations({"mass": np.ones(20)}, np.arange(20.0)) == []
    (one,) = association.associations({"mass": np.arange(4.0)}, [1.0, 2.0, 3.0, 4.0])
    assert one.spearman == pytest.approx(1.0)
    assert one.p == pytest.approx(2 / 24)
    assert math.isnan(one.importance)
    (kept,) = association.associations({"mass": [1.0, 2.0, math.nan, 4.0]}, [1.0, 2.0, 3.0, 4.0])
    assert kept.n == 3


# ---------------------------------------------------------------------- known truth

STUDIES = 1000
"""Simulated studies; 95 of 100 then come out as 93.6 to 96.4 in nineteen of twenty tries."""

SHAPES: dict[str, tuple[Callable[[np.random.Generator, int], Floats], float]] = {
    "normal": (lambda rng, n: rng.normal(size=n), 0.0),
    "heavy tails": (lambda rng, n: rng.standard_t(3, size=n), 0.0),
    "one side": (lambda rng, n: rng.lognormal(0.0, 0.5, size=n), 1.01737),  # interquartile mean of the distribution
    "two heaps": (lambda rng, n: rng.normal(size=n) - 5.0 * (rng.random(n) < 0.2), -0.36994),  # of 4,000,000 draws
}


def coverage(interval: Callable[[], Interval], truth: float) -> float:
    """Share of studies whose interval holds the truth."""
    return float(np.mean([(i := interval()).low <= truth <= i.high for _ in range(STUDIES)]))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n", [3, 5, 10])
def test_intervals_hold_the_truth_in_nineteen_of_twenty_studies(n: int, shape: str) -> None:
    rng = np.random.default_rng(12)
    draw, truth = SHAPES[shape]
    assert 0.93 <= coverage(lambda: compare.iqm_interval(draw(rng, n)), truth) <= 0.97


@pytest.mark.parametrize(("n", "measured"), [(3, 0.924), (5, 0.918), (10, 0.942)])
def test_intervals_of_evenly_spread_runs_hold_the_truth_as_often_as_the_document_says(n: int, measured: float) -> None:
    """With 3 and 5 runs that is less than the 93 % that they should have; the document has 4,000 studies."""
    rng = np.random.default_rng(12)
    assert coverage(lambda: compare.iqm_interval(rng.uniform(size=n)), 0.5) == pytest.approx(measured, abs=0.02)
    assert f"{100 * measured:.1f} (" in (data_root() / "docs/notebook/studies.md").read_text()


def test_intervals_of_falls_hold_the_truth_where_runs_differ() -> None:
    """Runs with fall rates of a beta distribution (intraclass correlation 0.05) of 100 robots each, ten runs."""
    rng = np.random.default_rng(5)
    mean, spread = 0.2, 1 / 0.05 - 1

    def study() -> tuple[NDArray[np.int64], list[int]]:
        rates = rng.beta(mean * spread, (1 - mean) * spread, size=10)
        return rng.binomial(100, rates), [100] * 10

    assert 0.93 <= coverage(lambda: compare.clustered_share(*study()), mean) <= 0.97
    pooled = coverage(lambda: share_interval(*(int(np.sum(each)) for each in study())), mean)
    assert pooled < 0.75  # why Wilson's alone will not do


def test_the_test_of_two_groups_is_wilcoxons() -> None:
    rng = np.random.default_rng(4)
    for n, m in ((4, 4), (5, 7), (8, 8)):
        a, b = rng.normal(size=n), rng.normal(size=m) + 0.7
        assert compare.permutation_p(a, b) == pytest.approx(stats.mannwhitneyu(a, b, method="exact").pvalue)
        k = min(n, m)
        exact = stats.wilcoxon(a[:k], b[:k], method="exact").pvalue
        assert compare.permutation_p(a[:k], b[:k], paired=True) == pytest.approx(exact)
    assert compare.permutation_p(np.ones(4), np.ones(4)) == 1.0
    assert compare.permutation_p(np.ones(4), np.zeros(4)) == pytest.approx(2 / 70)
