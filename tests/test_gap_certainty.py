"""What is certain: terms (``search/certainty.py``), values that are alike, and what the user accepts."""

from __future__ import annotations

import ast
import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

import go1exp.gap
from go1exp.cli.gap import GapVerb
from go1exp.config.compose import compose
from go1exp.config.schema.registry import members
from go1exp.config.schema.settings import parse
from go1exp.gap.answer import Answer, bounded_joints, decide, weak_joints
from go1exp.gap.files import from_dict
from go1exp.gap.report import words
from go1exp.gap.report.words import sentence
from go1exp.gap.result import AngleErrors, Candidate, GapResult, GapSettings, NamedEffect
from go1exp.gap.score import angle_errors
from go1exp.gap.score.likelihood import KNEE, excess, log_chi2, removed
from go1exp.gap.search import significance, thresholds, tolerances
from go1exp.gap.search.candidates import Trial
from go1exp.gap.search.certainty import beside_a_gap, doubt, spanned, widened
from go1exp.gap.search.single_cause import differ
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


# ---------------------------------------------------------------------- values that may be the same at all joints


TOLERANCE = declared(("encoder_offset", "offset")).tolerance
WALK = 0.001 * np.array([9.5, 8.3, 9.6, 9.6, 9.6, 9.6, 11.4, 9.6, 6.9, 9.6, 9.7, 9.5])
"""Offsets like those that walks gave, rad."""

EVEN = np.ones(12)


def resampled(values: np.ndarray, sd: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return resampled values (200, J) with these errors."""
    return values + sd * np.random.default_rng(seed).standard_normal((200, len(values)))


def test_values_differ_beyond_one_tolerance_and_beyond_their_own_errors() -> None:
    close = 0.009 + 0.0029 * np.linspace(0.0, 1.0, 12)
    assert not differ(close, resampled(close, 1e-7 * EVEN), TOLERANCE)  # within one tolerance, however well known
    assert np.ptp(WALK) > TOLERANCE
    assert differ(WALK, np.tile(WALK, (200, 1)), TOLERANCE)
    for sd, differs in ((0.0009, False), (0.0001, True)):
        draws = resampled(WALK, sd * EVEN)
        assert differ(WALK, draws, TOLERANCE) == differs
        assert differ(WALK, draws + 0.003 * np.arange(12), TOLERANCE) == differs  # where resamples lie is no matter
    shared = 0.01 * np.random.default_rng(1).standard_normal((200, 1))
    assert differ(WALK, resampled(WALK, 0.0001 * EVEN) + shared, TOLERANCE)  # errors of all joints are of no difference


def test_a_joint_of_which_little_is_known_hides_no_others() -> None:
    values, sd = np.full(12, 0.009), 0.0002 * EVEN
    values[4], sd[4] = 0.02, 0.01
    assert not differ(values, resampled(values, sd), TOLERANCE)
    values[7] = 0.014
    assert differ(values, resampled(values, sd), TOLERANCE)


@pytest.mark.parametrize("spread", [0.0, 1.0], ids=["one value", "a tolerance apart"])
def test_causes_that_are_alike_are_refused_no_more_often_than_said(spread: float) -> None:
    rng = np.random.default_rng(2)
    sd = 0.001 * rng.uniform(0.3, 3.0, 12)
    true = 0.009 + spread * TOLERANCE * (np.arange(12) % 2)
    trials = [differ(true + sd * rng.standard_normal(12), resampled(true, sd, k), TOLERANCE) for k in range(300)]
    assert np.mean(trials) <= thresholds.SHARED_LEVEL + 0.02


def test_what_one_fault_may_give_to_all_joints_is_known_of_the_effects_themselves() -> None:
    alike = {name for name in members("effect") if tolerances.identification(name).uniform}
    assert alike == {"strength", "kp_scale", "link_mass", "encoder_offset"}


# ---------------------------------------------------------------------- what the user accepts


def accepting(accept: str) -> GapVerb:
    container = compose("gap", ["logs=recordings", f"accept={accept}"])
    return parse(GapVerb, {k: v for k, v in container.items() if k not in ("robot", "model")})


@pytest.mark.parametrize(("given", "rad"), [("2mrad", 0.002), ("0.002", 0.002), ("1deg", math.pi / 180), ("0", 0.0)])
def test_an_angle_is_in_rad_or_says_its_unit(given: str, rad: float) -> None:
    assert accepting(given).accept == pytest.approx(rad)


def asked(**changes: Any) -> Any:
    signal = dict.fromkeys(("coulomb", "viscous"), 100.0)
    return SimpleNamespace(**{"settings": GapSettings(), "signal": signal, "first": 80.0, **changes})


def named(status: Literal["certified", "compensating"]) -> NamedEffect:
    return NamedEffect("coulomb", ("knee",), {}, {}, ("coulomb",), status)


def test_what_remains_is_right_if_it_is_accepted_and_the_names_stay() -> None:
    sure = (named("certified"),)
    assert decide(asked(), sure, 40.0, False) == "partly explained"
    assert decide(asked(), sure, 40.0, True) == "explained"
    assert decide(asked(), (), 80.0, False) == "unexplained"
    assert decide(asked(), (), 80.0, True) == "no gap"
    assert decide(asked(signal={"coulomb": 0.0}), (), 80.0, True) == "not excited"


def test_names_none_of_which_is_certain_explain_nothing_however_near_they_come() -> None:
    sure, unsure = named("certified"), named("compensating")
    assert decide(asked(), (unsure, unsure), 0.1, False) == "partly explained"
    assert decide(asked(), (unsure,), 0.1, True) == "explained"
    assert decide(asked(), (unsure, sure), 0.1, False) == "explained"
    quick = asked(settings=GapSettings(bootstraps=0))  # how certain they are was not asked
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


# ---------------------------------------------------------------------- windows at rest and wild windows


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
    errors = angle_errors.angle_errors((scorer, scorer), flat, halved, np.arange(4), ["slow", "fast"])
    assert errors.by_joint["hip"][0] < 0.1e-3
    assert errors.by_joint["calf"] == pytest.approx((6e-3, 3e-3), rel=0.02)
    assert errors.by_episode["slow"] == pytest.approx((4e-3 / np.sqrt(2), 2e-3 / np.sqrt(2)), rel=0.02)
    assert errors.removed == pytest.approx(0.5, abs=0.01)
    assert errors.worse == 0.25
    assert "The error of a window decreases by 50 % in the median" in words.angles(errors).replace("50.0", "50")
    assert ("calf", "6", "3") in words.angle_rows(errors)
