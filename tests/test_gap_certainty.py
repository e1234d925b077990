"""Which terms are certified or compensating, and why (``go1exp/gap/search/certainty.py``)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.gap.answer import Answer, bounded_joints, weak_joints
from go1exp.gap.report.words import sentence
from go1exp.gap.result import Candidate, GapSettings, NamedEffect
from go1exp.gap.search.candidates import Trial
from go1exp.gap.search.certainty import beside_a_gap, doubt, spanned, widened
from go1exp.gap.search.state import LastCheck, Search
from go1exp.sim.effects.tolerances import DECLARED, declared

JOINTS = ("a_hip", "a_thigh", "b_hip", "b_thigh")
BORNE_OUT = LastCheck(True, 0.9)


@pytest.mark.parametrize(
    ("gain", "p", "why"),
    [
        ((0.9, -1.0), 0.004, "removes 52.0% of the excess, but other windows lose as much in log chi2"),
        ((0.9, -1.0), 0.5, "no significant gain on held-out windows (p = 0.5)"),
        ((0.9, 0.1), 0.5, "removes 52.0% of the excess, but too few windows show it (p = 0.5)"),
    ],
)
def test_why_what_removes_half_of_a_gap_is_rejected(gain: tuple[float, ...], p: float, why: str) -> None:
    one: dict[str, Any] = {"after": [0.33], "gain": np.array([gain]), "p": np.array([p]), "share": np.array([0.52])}
    no, shown = np.array([False]), np.array([p < 0.01])
    trial = Trial(
        ["viscous"], **one, sizes=np.array([2.7]), needed=0.1, shown=shown, helps=no, alias=no, aside=no, chosen=None
    )
    assert trial.reason(0) == ("rejected", why)


@dataclass
class Stub:
    """The part of a search that is read: one term at all joints, which took 90 % by itself."""

    shares: dict[str, float] = field(default_factory=lambda: {"coulomb": 1.0, "encoder_offset": 1.0})
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    signal: dict[str, float] = field(default_factory=dict)
    own: float = 0.9
    first: float = 100.0
    marginal: bool = False
    select_chi2: float = 2.0
    settings: GapSettings = field(default_factory=GapSettings)
    state: Any = field(
        default_factory=lambda: SimpleNamespace(
            tolerances=DECLARED, scorer=SimpleNamespace(windows=SimpleNamespace(joints=JOINTS))
        )
    )

    def removes(self, term: str) -> float:
        return self.own


def why(
    search: Stub, effect: str = "coulomb", value: float = 0.3, adequate: bool = False, check: LastCheck = BORNE_OUT
) -> str:
    theta = {(effect, "bound" if effect == "coulomb" else "offset"): np.full(4, value)}
    return doubt(search, effect, theta, JOINTS, adequate, check)  # type: ignore[arg-type]


def test_a_term_that_took_most_of_a_gap_is_certain_though_some_remains() -> None:
    assert why(Stub()) == ""


@pytest.mark.parametrize("own", [0.4, math.nan])
def test_a_term_is_judged_by_what_it_took_itself_not_by_what_all_took(own: float) -> None:
    assert "a gap remains, and of what there is without it, it removes only" in why(Stub(own=own))
    assert why(Stub(own=own), adequate=True) == ""


@pytest.mark.parametrize(
    ("returned", "left", "share"),
    [
        (0.06, 2.0, 0.75),  # 6 of 100 come back without it, and 2 are left with it
        (0.66, 2.0, 66 / 68),
        (0.06, 18.0, 0.25),
        (0.0, 2.0, 0.0),
        (0.06, -0.1, 1.0),  # below the floor counts as nothing
        (math.nan, 2.0, math.nan),
    ],
)
def test_beside_a_large_effect_a_small_one_is_judged_by_what_is_left_without_it(
    returned: float, left: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("go1exp.gap.search.state.excess", lambda chi2: chi2)
    search: Any = SimpleNamespace(first=100.0, select_chi2=left, share_of=lambda term: returned)
    assert Search.removes(search, "torque_delay") == pytest.approx(share, nan_ok=True)


@pytest.mark.parametrize(
    ("goes", "half"),
    [(1.0, 0.0), (0.75, 1.96 * 0.2), (0.0, 1.96 * 0.4), (-0.4, 1.96 * 0.4), (math.nan, 1.96 * 0.4 * math.sqrt(0.16))],
    ids=["all", "three quarters", "nothing", "less than nothing", "nobody looked: what all terms take"],
)
def test_beside_a_gap_a_value_is_as_unsure_as_what_remains_is_large(
    goes: float, half: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("go1exp.gap.search.certainty.excess", lambda chi2: 16.0)  # of 100 within the tolerances
    search: Any = Stub(own=goes)
    assert beside_a_gap(search, "coulomb") == pytest.approx(half, rel=1e-3, abs=1e-12)


def test_an_interval_is_widened_as_independent_errors_add() -> None:
    value = np.array([1.3, 1.0, 0.4])
    low, high = widened(value, value - 0.04, value + 0.03, null=1.0, share=0.1)
    drawn = np.random.default_rng(0).standard_normal((2, 400_000))
    for k, v in enumerate(value):
        off = 0.04 / 1.96 * drawn[0] + 0.1 / 1.96 * abs(v - 1.0) * drawn[1]
        assert low[k] == pytest.approx(v + np.quantile(off, 0.025), abs=5e-4)
    assert high - value == pytest.approx(np.hypot(0.03, 0.1 * np.abs(value - 1.0)))
    same = widened(value, value - 0.04, value + 0.03, null=1.0, share=0.0)
    assert same[0] == pytest.approx(value - 0.04)
    assert same[1] == pytest.approx(value + 0.03)


@pytest.mark.parametrize(
    ("share", "first", "adequate", "sure"),
    [(0.6, 100.0, True, True), (0.45, 100.0, True, False), (0.6, 100.0, False, False), (0.6, 0.3, True, False)],
    ids=["closes the gap", "too rarely", "a gap remains", "the tolerances suffice"],
)
def test_half_of_the_resamples_are_enough_where_the_gap_is_closed(
    share: float, first: float, adequate: bool, sure: bool
) -> None:
    reason = why(Stub(shares={"coulomb": share}, first=first), adequate=adequate)
    assert (reason == "") is sure
    assert sure or f"named again in {share:.0%} of the resamples only" in reason


@pytest.mark.parametrize(
    ("joints", "marginal", "left", "sure"),
    [(1, True, -0.05, False), (1, True, -0.15, True), (1, False, -0.05, True), (2, True, -0.05, True)],
    ids=["doubted", "it gains a tenth of the floor", "the tolerances do not suffice", "two joints"],
)
def test_one_joint_alone_is_doubted_where_the_tolerances_do_nearly_as_well(
    joints: int, marginal: bool, left: float, sure: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("go1exp.gap.search.certainty.excess", lambda chi2: chi2)
    search: Any = Stub(first=0.0, marginal=marginal, select_chi2=left)
    theta = {("coulomb", "bound"): np.full(4, 0.3)}
    assert (doubt(search, "coulomb", theta, JOINTS[:joints], True, BORNE_OUT) == "") is sure


def test_a_value_on_its_bound_is_no_certain_one() -> None:
    high = declared(("encoder_offset", "offset")).high
    assert "offset at a_hip lies on its bound" in why(Stub(), "encoder_offset", high, adequate=True)
    assert why(Stub(), "encoder_offset", 0.5 * high, adequate=True) == ""


def test_where_another_does_as_well_and_a_gap_remains_neither_is_certain() -> None:
    pair = Stub(aliases={"coulomb": ("coulomb", "load_friction")})
    assert "load_friction would do as well" in why(pair)
    assert why(pair, adequate=True) == ""  # the set explains everything, and is named as a set


def test_what_the_last_check_does_not_bear_out_is_not_certain() -> None:
    assert "does not confirm it" in why(Stub(), check=LastCheck(False, -0.2), adequate=True)
    assert "only 30% of the excess goes" in why(Stub(), check=LastCheck(True, 0.3), adequate=True)
    assert why(Stub(), check=LastCheck(True, math.nan), adequate=True) == ""  # there was no gap on it


def test_what_took_most_of_a_gap_is_said_though_it_is_not_named() -> None:
    def tried(after: float) -> list[Candidate]:
        return [Candidate("coulomb", (), {}, after, 1.0, 0.2, 3.0, ("coulomb",), "rejected", "too few windows show it")]

    answer = Answer("unexplained", (), {}, {"box": 100.0, "final": 100.0}, math.nan)
    text = sentence(answer, Stub(candidates=tried(26.0)), {}, ())  # type: ignore[arg-type]
    assert "no effect of the library" not in text
    assert "takes 74% away and yet is not named: too few windows show it" in text
    text = sentence(answer, Stub(candidates=tried(80.0)), {}, ())  # type: ignore[arg-type]
    assert "no effect of the library explains it" in text


def test_what_is_named_is_not_said_to_be_rejected() -> None:
    """Plain friction takes the place of one that depends on direction, although as a candidate it had been rejected."""
    tried = [
        Candidate(name, (), {}, 1.0, 1.0, 0.2, 3.0, (name,), "rejected", "")
        for name in ("asymmetric_friction", "coulomb", "stribeck")
    ]
    friction = NamedEffect(
        "coulomb", ("a_hip",), {"bound": {"a_hip": 0.3}}, {"bound": {"a_hip": (0.28, 0.32)}}, ("coulomb",), "certified"
    )
    answer = Answer("explained", (friction,), {}, {"box": 25.0, "final": 0.0}, 1.0)
    text = sentence(answer, Stub(candidates=tried), {}, ())  # type: ignore[arg-type]
    assert "asymmetric_friction and stribeck were considered and rejected." in text


def test_a_joint_a_little_beyond_its_tolerance_is_weak_beside_a_strong_one() -> None:
    """With 0.05 tolerated: 1.06 +- 0.03 beside 0.70 is weak; alone it is not, nor are 1.10 +- 0.03 and 0.85 +- 0.15."""
    key = ("strength", "scale")

    def weak(values: tuple[float, ...], spreads: tuple[float, ...]) -> tuple[int, ...]:
        noise = np.random.default_rng(0).standard_normal((400, 4))
        drawn = np.asarray(values) + 0.5 * np.asarray(spreads) * noise
        search: Any = Stub()
        return weak_joints(search, "strength", {key: np.asarray(values)}, {key: drawn})

    assert weak((0.70, 1.06, 1.10, 0.85), (0.03, 0.03, 0.03, 0.15)) == (1,)
    assert weak((1.0, 1.06, 1.0, 1.0), (0.03, 0.03, 0.03, 0.03)) == ()
    assert weak((0.70, 1.04, 1.0, 1.0), (0.03, 0.03, 0.03, 0.03)) == ()


@pytest.mark.parametrize(
    ("scale", "joints"),
    [((0.5, 0.8, 1.0, 2.0), (0, 3)), ((0.5, 1.0, 1.0, 2.0), ()), ((0.6, 0.8, 1.0, 1.3), ())],
    ids=["two of three", "all that leave it", "none"],
)
def test_joints_on_a_bound_are_doubted_unless_all_are(scale: tuple[float, ...], joints: tuple[int, ...]) -> None:
    p = DECLARED.param(("link_mass", "scale"))
    assert (p.low, p.high) == (0.5, 2.0)
    asked: Any = Stub()
    assert bounded_joints(asked, "link_mass", {("link_mass", "scale"): np.array(scale)}) == joints


def test_strength_acts_as_both_gains_together_and_as_neither_alone() -> None:
    columns = np.random.default_rng(0).normal(size=(500, 3)) * [1.0, 0.1, 7.0]  # of kp, of kd, of something else
    columns = np.column_stack([columns, 1.2 * columns[:, 0] - 3.0 * columns[:, 1]])
    matrix = columns.T @ columns
    assert spanned(matrix, 3, np.array([0, 1]))
    assert spanned(matrix, 0, np.array([1, 3]))
    assert not spanned(matrix, 3, np.array([0]))
    assert not spanned(matrix, 2, np.array([0, 1, 3]))
    assert not spanned(matrix, 3, np.array([], dtype=int))
