"""``benchmarks/gap_next.py``: what is counted of recordings until a pair is separated."""

from __future__ import annotations

import pytest

from benchmarks.gap_next import CASES, SEPARATED, Row, figures, line_of, main, ratios
from go1exp.config.schema.registry import members
from go1exp.gap.search.tolerances import confounded

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


@pytest.mark.parametrize(
    ("words", "message"),
    [(["out=x", "pairs=kd,tilts"], "pairs=tilts: there are tilt"), (["out=x", "strategies=best"], "strategies=best: ")],
)
def test_an_unknown_pair_or_strategy_is_named(words: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        main(words)


@pytest.mark.parametrize("words", [["n=2"], ["out=x", "most"], ["out=x", "strategy=next"]])
def test_a_call_that_is_wrong_is_answered_with_the_usage(words: list[str]) -> None:
    with pytest.raises(SystemExit, match=r"python -m benchmarks.gap_next out=DIR"):
        main(words)
