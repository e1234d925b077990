"""``go1exp gap next``: what a design is worth, against slow references; what it may ask of a robot; its file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from go1exp.cli.gap_next import text
from go1exp.config.schema.registry import bind
from go1exp.gap import files as gap_files
from go1exp.gap.comparison import Comparison, compare
from go1exp.gap.design.choice import ENOUGH, Evaluator, Pair, Worth, choose, power
from go1exp.gap.design.plan import (
    Attitude,
    Design,
    DesignError,
    DesignSettings,
    Limits,
    Safety,
    library,
    limits_of,
    neighbours,
)
from go1exp.gap.design.rehearsal import Stage, write
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.description import ModelConfig
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.search import tolerances
from go1exp.gap.search.screen import Motion
from go1exp.gap.search.screen import library as ways
from go1exp.gap.stages import next as stage_next
from go1exp.gap.stages.explain import check
from go1exp.gap.stages.next import NextResult
from go1exp.logs import recording
from go1exp.logs.excitations import ExcitationError
from go1exp.logs.record.motions import playback
from go1exp.logs.record.simulate import held_quat
from go1exp.logs.recording import Recording, joint_channels
from go1exp.robot import JOINTS, NOMINAL_STANCE, soft_limits
from go1exp.sim.effects.tolerances import Tolerances
from tests import made
from tests.command import refuse
from tests.laboratory import at_rest, recorded

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="stand" pos="0 0 1">
<inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
<body name="upper"><joint name="shoulder" axis="0 1 0" range="-1.5 1.5" limited="true" armature="0.01"/>
<inertial mass="0.8" pos="0 0 -0.12" diaginertia="4e-3 4e-3 2e-4"/></body></body></worldbody></mujoco>"""
LEG = """<mujoco><compiler angle="radian"/><worldbody><body name="stand" pos="0 0 1">
<inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
<body name="hip"><joint name="hip" axis="1 0 0" range="-1.5 1.5" limited="true" armature="0.01"/>
<inertial mass="0.3" pos="0 0 -0.02" diaginertia="4e-4 4e-4 4e-4"/>
<body name="thigh"><joint name="thigh" axis="0 1 0" range="-1.5 1.5" limited="true" armature="0.01"/>
<inertial mass="0.8" pos="0 0 -0.12" diaginertia="4e-3 4e-3 2e-4"/></body></body></body></worldbody></mujoco>"""
SETTINGS = GapSettings(stride_s=0.5, threads=1)
LEVEL = held_quat((0.0, 0.0))
FIXED = (Attitude(None, None, LEVEL),)


@pytest.fixture
def arm(tmp_path: Path) -> FixedBase:
    """A bench arm of one joint."""
    return machine(tmp_path, ARM, "shoulder")


def machine(folder: Path, mjcf: str, *joints: str) -> FixedBase:
    (folder / "arm.xml").write_text(mjcf)
    given = {"robots": ("arm",), "base": "stand", "joints": joints, "torque_limit": 6.0, "speed_limit": 20.0}
    return FixedBase.from_config(ModelConfig(mjcf=str(folder / "arm.xml"), **given))  # type: ignore[arg-type]


def told(
    machine: FixedBase, kinds: Sequence[str], centre: Sequence[float] = (0.0,), **parameters: Any
) -> list[Recording]:
    """Record the level robot without effects, with kp 15 and kd 0.3, by a loop that is not that of the rehearsals."""
    found = []
    joints = machine.joints
    for k, kind in enumerate(kinds):
        term = bind("excitation", kind, parameters, kind)[0]
        assert term
        t = np.arange(1500) * 0.002
        motion = term(t, np.array(centre), np.tile([-1.4, 1.4], (len(joints), 1)), np.random.default_rng(k))
        plant = at_rest(machine, {}, motion.target[:1], 15.0, 0.3, 0.0005)
        rows = []
        for target in torch.tensor(motion.target[:, None], dtype=plant.q.dtype):
            rows.append(np.stack([plant.q[0].numpy(), plant.speed()[0].numpy(), target[0].numpy()]))
            for _ in range(4):
                plant.step(target)
        rng, values = np.random.default_rng(k + 10), np.array(rows)  # T 3 J
        values[:, :2] += np.array([[2e-4], [0.02]]) * rng.standard_normal((len(t), 2, len(joints)))
        about: dict[str, Any] = {"robot": "arm", "kp": (15.0,) * len(joints), "kd": (0.3,) * len(joints)}
        channels = {"t": t}
        for c, quantity in enumerate(("q", "qd", "q_target")):
            channels |= dict(zip(joint_channels(quantity, joints), values[:, c].T, strict=True))
        found.append(Recording(made.meta(joints, episode=f"{kind}_{k}", excitation=kind, **about), channels))
    return found


def hand(machine: FixedBase, kinds: Sequence[str] = ("slow_ramps", "slow_ramps", "gait", "gait")) -> Comparison:
    return compare(told(machine, kinds), machine, SETTINGS)


def pair(truth: str, rival: str, parameter: str, value: float) -> Pair:
    theta: Theta = {(truth, parameter): np.array([value])}
    return Pair(truth, rival, theta, {}, (rival,), 0.0, 0.02)


def stage(comparison: Comparison, theta: Theta, seconds: float = 3.0) -> Stage:
    targets = [r.joint("q_target") for r in comparison.recordings]
    return Stage(comparison, limits_of(comparison.robot, comparison.windows, targets, Safety()), theta, seconds)


# ---------------------------------------------------------------------- what a design is worth


@pytest.mark.parametrize("distance", [4.0, 12.0, 25.0])
def test_power_is_that_of_a_test_at_its_level(distance: float) -> None:
    """Noise drawn, both models fitted, the ratio of likelihoods held against a threshold of level 1 %."""
    rng = np.random.default_rng(0)
    count, alpha, draws = 300, 0.01, 20_000
    shared = np.linalg.qr(rng.standard_normal((count, 6)))[0]  # what both may move
    signal = rng.standard_normal(count)
    signal -= shared @ (shared.T @ signal)
    signal *= np.sqrt(distance) / np.linalg.norm(signal)

    def ratio(truth: np.ndarray) -> np.ndarray:
        y = truth + rng.standard_normal((draws, count))
        y -= y @ shared @ shared.T
        return np.asarray((y**2).sum(1) - ((y - signal) ** 2).sum(1))

    threshold = np.quantile(ratio(np.zeros(count)), 1 - alpha)
    found = power(distance, 1.0, 0.0, 1e9, 0.0, alpha)
    assert found == pytest.approx(float(np.mean(ratio(signal) > threshold)), abs=0.03)


def test_power_needs_more_than_what_counts_as_the_same_and_falls_with_a_doubtful_size() -> None:
    assert power(1e4, 0.01, 0.02, 1e6, 0.0, 0.01) < 0.01  # clear by noise, and still the same to the search
    assert power(1e4, 0.03, 0.02, 1e6, 0.0, 0.01) > 0.99
    assert power(20.0, 1.0, 0.02, 100, 0.4, 0.01) < power(20.0, 1.0, 0.02, 100, 0.0, 0.01)
    assert power(0.0, 0.0, 0.02, 100, 0.0, 0.01) < 0.011


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_worth_is_what_a_fit_of_the_rival_to_the_noise_free_truth_leaves(
    arm: FixedBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reference: SciPy's least squares over replays, nothing linear, priors and bounds as the search has them."""
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("viscous", "armature"))
    comparison = hand(arm, ("gait", "multisine"))
    both = pair("coulomb", "viscous", "bound", 0.1)
    evaluator = Evaluator(both, comparison.scorer, SETTINGS, comparison.dt)
    found = evaluator.worth(evaluator.at_hand)
    state, layout = evaluator.state, evaluator.layout
    assert state.fitted is not None
    limits = tolerances.bounds(layout, state.fitted.probes, {}, state.may)
    windows, scorer = state.splits.train, state.scorer
    probes = state.fitted.probes
    root = np.sqrt(limits.weight)

    def left(x: np.ndarray) -> np.ndarray:
        theta = tolerances.moved({}, layout, probes, x, arm)
        residual = scorer.residual(variants(arm, theta, windows, []), comparison.dt)
        whitened = []
        for r, s in zip(residual[:, 0].astype(float), scorer.state[windows, 0].astype(float), strict=True):
            values, vectors = np.linalg.eigh(s.T @ s)  # (I + S S')^-1/2 by the small matrix S'S
            shrink = (1.0 / np.sqrt(1.0 + values) - 1.0) / np.maximum(values, 1e-12)
            whitened.append(r + s @ vectors @ (shrink * (vectors.T @ (s.T @ r))))
        return np.concatenate([*whitened, root * (x - limits.centre)])

    fit = least_squares(left, np.zeros(layout.size), bounds=(limits.low - 1e-9, limits.high), x_scale=1 / root)
    data = fit.fun[: -layout.size]
    assert found.distance == pytest.approx(evaluator.at_hand.weight * float(data @ data), rel=0.05)
    assert found.distance > 100
    assert 0.0 < found.imitated < 1.0


def test_the_rival_that_is_the_truth_leaves_nothing(arm: FixedBase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("viscous", "kd_scale"))
    comparison = hand(arm)
    evaluator = Evaluator(pair("viscous", "kd_scale", "damping", 0.2), comparison.scorer, SETTINGS, comparison.dt)
    worth = evaluator.worth(evaluator.at_hand)
    assert worth.imitated > 0.999  # kd of 0.3 and damping of 0.2: the same torque
    assert worth.power < 0.1
    assert float(evaluator.state.theta["kd_scale", "scale"][0]) == pytest.approx(1 + 0.2 / 0.3, rel=0.05)


# ---------------------------------------------------------------------- designs


def chosen(
    comparison: Comparison, both: Pair, attitudes: Sequence[Attitude], **given: Any
) -> tuple[Worth, Worth, Any, Stage]:
    """Return the worth of the recordings at hand, with the design, the choice, and the stage."""
    evaluator = Evaluator(both, comparison.scorer, comparison.settings, 2 * comparison.dt)
    here = stage(comparison, both.theta)
    settings = DesignSettings(seconds=3.0, designs=12, refine=1, **given)
    choice = choose(here, [evaluator], attitudes, settings, lambda what, share: None)
    return evaluator.worth(evaluator.at_hand), choice.worths[0], choice, here


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_friction_and_kd_are_told_apart_by_another_kd_and_by_nothing_else(
    arm: FixedBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("viscous", "kd_scale"))
    # Without torque_off: swings without drives tell the two apart at any gain.
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("chirp", {"band": (0.5, 10.0)}), ("gait", {})))
    comparison, both = hand(arm), pair("viscous", "kd_scale", "damping", 0.2)
    before, same, choice, _ = chosen(comparison, both, FIXED, gains=((1.0, 1.0),))
    assert choice.best is None
    assert same.power < 0.1
    why = stage_next.reason(Evaluator(both, comparison.scorer, SETTINGS, 2 * comparison.dt), same, 0, DesignSettings())
    assert "kd_scale imitates all but" in why
    before, after, choice, here = chosen(comparison, both, FIXED, gains=((1.0, 1.0), (1.0, 2.0), (1.0, 3.0)))
    assert before.power < 0.1
    assert after.power > ENOUGH
    assert choice.best.design.gains[1] > 1.2
    assert here.limits.allow(choice.best.used)
    assert np.all(np.abs(choice.best.q) <= 1.5 * 0.95 + 1e-9)


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_swings_without_drives_tell_friction_from_kd_at_one_gain(
    arm: FixedBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("viscous", "kd_scale"))
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("torque_off", {}), ("gait", {})))
    comparison, both = hand(arm), pair("viscous", "kd_scale", "damping", 0.2)
    _, after, choice, _ = chosen(comparison, both, FIXED, gains=((1.0, 1.0),))
    assert choice.best.design.excitation == "torque_off"
    assert after.power > ENOUGH


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_a_tilt_and_an_offset_are_told_apart_by_another_attitude(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leg whose hip hardly leaves 0.5 rad: there a pitch is an offset of the thigh in one attitude, not in two."""
    leg, small = machine(tmp_path, LEG, "hip", "thigh"), {"amplitude": (0.005, 0.03)}
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("base_tilt", "encoder_offset"))
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("slow_ramps", small),))
    recordings = told(leg, ("slow_ramps", "slow_ramps", "slow_ramps"), (0.5, 0.0), **small)
    comparison = compare(recordings, leg, SETTINGS)
    both = pair("base_tilt", "encoder_offset", "pitch", 0.03)
    before, still, choice, _ = chosen(comparison, both, FIXED, gains=((1.0, 1.0),))
    assert before.power < 0.1
    assert still.power < 0.1
    assert choice.best is None
    rolled = Attitude(0.8, 0.0, held_quat((0.8, 0.0)))
    _, after, choice, _ = chosen(comparison, both, (*FIXED, rolled), gains=((1.0, 1.0),))
    assert after.power > ENOUGH
    assert choice.best.design.attitude == rolled


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_a_roll_is_an_offset_of_the_hip_in_every_attitude(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both turn the leg about the same axis; nothing that joints measure could tell them apart."""
    leg = machine(tmp_path, LEG, "hip", "thigh")
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("base_tilt", "encoder_offset"))
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("slow_ramps", {}), ("gait", {})))
    comparison = compare(told(leg, ("slow_ramps", "slow_ramps", "gait"), (0.5, 0.2)), leg, SETTINGS)
    rolled = Attitude(0.8, 0.0, held_quat((0.8, 0.0)))
    _, after, choice, _ = chosen(comparison, pair("base_tilt", "encoder_offset", "roll", 0.04), (*FIXED, rolled))
    assert choice.best is None
    assert after.imitated > 0.999


@pytest.mark.slow("go1exp/gap/design/", "go1exp/gap/stages/next.py", "tests/")
def test_designs_beyond_the_limits_are_left_out(arm: FixedBase) -> None:
    comparison = hand(arm, ("gait", "gait"))
    here = stage(comparison, {})
    played = here.rehearsed(library(12, ((1.0, 1.0),), FIXED, np.random.default_rng(0)), comparison.dt)
    assert len(played) > 6
    for r in played:
        assert r.used.angle == pytest.approx(np.abs(r.q).max() / (0.95 * 1.5), rel=1e-6)
        assert r.used.speed == pytest.approx(np.abs(r.qd).max() / (0.8 * 20.0), rel=1e-6)
    slow = min(played, key=lambda r: r.used.speed)
    tight = Limits(here.limits.centre, here.limits.angle, here.limits.speed, here.limits.torque, 1e-3)
    assert here.limits.allow(slow.used)
    assert not tight.allow(slow.used)
    none, settings = dataclasses.replace(here, limits=tight), DesignSettings(designs=12, gains=((1.0, 1.0),))
    with pytest.raises(DesignError, match=r"limits: all of 12 designs"):
        choose(none, [], FIXED, settings, lambda what, share: None)


def test_neighbours_stay_between_the_gains_that_are_allowed() -> None:
    best = Design("chirp", {"band": (0.5, 10.0)}, 1.0, (1.0, 1.0), FIXED[0], 0)
    near = neighbours(best, 40, ((0.5, 1.0), (1.5, 2.0)), FIXED, np.random.default_rng(0))
    gains = np.array([d.gains for d in near])
    assert np.all((gains >= [0.5, 1.0]) & (gains <= [1.5, 2.0]))
    assert len({d.seed for d in near}) > 5
    fixed = neighbours(best, 10, ((1.0, 1.0),), FIXED, np.random.default_rng(0))
    assert {d.gains for d in fixed} == {(1.0, 1.0)}


# ---------------------------------------------------------------------- questions


def answer(**changes: Any) -> GapResult:
    tilt = NamedEffect(
        "base_tilt",
        (),
        {"roll": {"robot": 0.0}, "pitch": {"robot": 0.04}},
        {"roll": {"robot": (-0.001, 0.001)}, "pitch": {"robot": (0.03, 0.05)}},
        ("base_tilt",),
        "certified",
    )
    usual: dict[str, Any] = {"named": (tilt,), "box": {"viscous": {"damping": {"FR_hip": 0.01}}}}
    return GapResult(**{"verdict": "explained", "sentence": "", **usual, **changes})


def robot() -> Any:
    from tests.test_gap_solver import simulate_config

    return suspended(simulate_config())


def test_a_named_effect_is_held_against_all_that_is_known_to_look_like_it() -> None:
    found = stage_next.pairs_of(answer(), robot())
    rivals = ("encoder_offset", "link_com", "soft_mount")
    assert [(p.truth, p.rival) for p in found] == [("base_tilt", rival) for rival in rivals]
    assert found[0].theta["base_tilt", "pitch"] == 0.04
    assert found[0].theta["viscous", "damping"][0] == 0.01
    within = abs(float(found[0].without.get(("base_tilt", "pitch"), np.zeros(1))[0]))
    assert within <= robot().tolerances.param(("base_tilt", "pitch")).tolerance
    assert found[0].spread == pytest.approx(0.02 / (2 * 1.96) / 0.04)


def test_what_was_not_excited_is_a_question_too() -> None:
    moved = Motion(np.zeros(12), np.full(12, -0.5), np.full(12, 0.5), np.full(12, 0.4))
    found = stage_next.unseen(answer(not_excited={"joint_stop": "steps", "payload": "squat"}), robot(), moved)
    assert [(p.truth, p.rival) for p in found] == [("joint_stop", "")]  # a held trunk feels no payload
    assert found[0].theta["joint_stop", "time_constant"].shape == (12,)


def test_every_effect_is_probed_at_twice_its_tolerance_however_narrow_that_is() -> None:
    moved = Motion(np.zeros(12), np.full(12, -0.5), np.full(12, 0.5), np.full(12, 0.4))
    narrow = {"fixed_point": {"steps": 0.4}, "dead_band": {"band": 1e-4}}
    machine = suspended(robot().config, Tolerances.from_effects(narrow))
    for one in (robot(), machine):
        least: dict[str, float] = {}
        for v in ways(one, moved):
            for p in v.probes:
                change = float(np.abs(p.delta).max()) / one.tolerances.param((v.effect, p.key[1])).tolerance
                least[v.effect] = min(least.get(v.effect, np.inf), change)
        known = tolerances.nominal(one)
        assert {effect: change for effect, change in least.items() if change > 3.01 and effect not in known} == {}


@pytest.mark.slow("go1exp/gap/", "tests/")
def test_gap_and_gap_next_agree_about_what_is_not_excited(arm: FixedBase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tolerances, "nominal", lambda machine: ("viscous",))
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("chirp", {"band": (0.5, 10.0)}),))
    search = replace(SETTINGS, effects=("lag", "quadratic_drag", "joint_stop", "torque_speed_limit"))
    slow = told(arm, ("slow_ramps",) * 3, amplitude=(0.005, 0.03))
    quiet = check(slow, arm, search).not_excited or {}
    assert set(quiet) == {"quadratic_drag", "joint_stop", "torque_speed_limit"}
    result = answer(verdict="no gap", named=(), box={}, not_excited={**quiet, "payload": "squat"})
    design_settings = DesignSettings(designs=12, refine=0, gains=((1.0, 1.0),), seconds=3.0)
    found = stage_next.design(result, slow, arm, search, design_settings)
    assert {p.truth for p in found.pairs} == set(quiet)
    assert found.distinguishable == ()
    assert dict(found.standing) == {"payload": "squat"}
    shown = {p.truth for p in found.pairs if not p.reason}
    assert shown == {"quadratic_drag"}
    assert found.best is not None
    fast = told(arm, ("chirp",) * 3, **found.best.design.parameters)
    assert shown.isdisjoint(check([*slow, *fast], arm, search).not_excited or shown)
    said = text(found, Path("x"))
    assert "whether there is quadratic_drag: not excited by the logs at hand, " in said
    assert "only a robot on its feet shows payload: excitation=squat" in said


def test_an_answer_without_names_has_no_question() -> None:
    with pytest.raises(DesignError, match=r"'unexplained'.*mend the logs"):
        stage_next.pairs_of(answer(verdict="unexplained", named=()), robot())
    nothing = stage_next.design(answer(named=(), verdict="no gap"), told_go1(), robot(), SETTINGS, DesignSettings())
    assert nothing.verdict == "nothing left"
    assert "nothing is left" in text(nothing, Path("x"))


def told_go1() -> list[Recording]:
    return list(recorded(["seconds=0.2", "physics_dt=0.002", "excitation=[chirp]"])[1])


def test_logs_of_another_search_are_refused() -> None:
    with pytest.raises(DesignError, match=r"logs: not those of the search \(walk missing\)"):
        stage_next.design(answer(provenance={"logs": {"walk": "x"}}), told_go1(), robot(), SETTINGS, DesignSettings())


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["logs=recordings"], "verdict.json: no such file; run go1exp gap explain first"),
        ([], "logs: required"),
        (["logs=x", "design.seconds=0.5"], "design.seconds = 0.5"),
        (["logs=x", "design.limits.speed=2"], "design.limits.speed = 2"),
        (["logs=x", "design.gains=[]"], "design.gains"),
    ],
)
def test_the_verb_says_what_is_missing(words: list[str], complaint: str, tmp_path: Path) -> None:
    done = refuse(tmp_path, "gap", "next", *words)
    assert done.returncode != 0
    assert complaint in done.stderr


def test_logs_that_the_search_left_out_are_left_out_here_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (told,) = told_go1()
    short = replace(told, channels={name: values[:5] for name, values in told.channels.items()})
    for name, each in (("walk", told), ("short", short)):
        recording.write(tmp_path / f"{name}.parquet", replace(each, meta=replace(each.meta, episode=name)))
    searched = replace(SETTINGS, window_s=0.1, burn_s=0.02)
    gap_files.save(answer(provenance={"settings": asdict(searched)}), tmp_path / "gap")
    given: list[str] = []

    def design(result: GapResult, recordings: Sequence[Recording], *rest: Any) -> NextResult:
        given.extend(r.meta.episode for r in recordings)
        return NextResult("nothing left", (), (), None, 500.0, JOINTS)

    monkeypatch.setattr(stage_next, "design", design)
    assert refuse(tmp_path, "gap", "next", "logs=.", "out=gap").returncode == 0
    assert given == ["walk"]


# ---------------------------------------------------------------------- the file


def test_the_file_plays_back_through_record(tmp_path: Path) -> None:
    """The design's file in the hands of ``go1exp record``: same targets, and the motion that the rehearsal promised."""
    _, found = recorded(["seconds=2.5", "physics_dt=0.001", "excitation=[chirp,gait]", "seeds=[0,1]"])
    comparison = compare(found, robot(), GapSettings(threads=1))
    here = stage(comparison, {}, seconds=2.0)
    pitched = Attitude(0.0, 0.26, held_quat((0.0, 0.26)))
    (played,) = here.rehearsed([Design("gait", {}, 0.8, (1.5, 2.0), pitched, 3)], comparison.dt)
    assert here.limits.allow(played.used)
    file = write(played, JOINTS, here.period, tmp_path / "next.csv")
    gains = f"gains=[[{played.kp[0]:g},{played.kd[0]:g}]]"
    excitation = f"excitation=[{{playback: {{file: {file}}}}}]"
    _, (again,) = recorded([excitation, gains, "hang=[[0,0.26]]", "seconds=2", "physics_dt=0.001"])
    np.testing.assert_allclose(again.joint("q_target"), played.motion.target, atol=2e-5)
    np.testing.assert_allclose(again.joint("q"), played.q, atol=0.01)
    assert np.sqrt(np.mean((again.joint("q") - played.q) ** 2)) < 0.002
    limits = soft_limits(0.95)
    assert np.all((again.joint("q") > limits[:, 0]) & (again.joint("q") < limits[:, 1]))
    header = file.read_text().splitlines()[0].split(",")
    assert header[:2] == ["t", "q_target_FR_hip"]
    assert {"kp_FR_hip", "kd_RL_calf", "torque_enable"} <= set(header)


def _file(folder: Path, *, joints: Sequence[str] = JOINTS, rows: int = 50, **columns: Any) -> Path:
    table = {"t": np.arange(rows) * 0.01, **dict.fromkeys(joint_channels("q_target", joints), np.zeros(rows))}
    for name, value in zip(joint_channels("q_target", JOINTS), NOMINAL_STANCE, strict=True):
        if name in table:
            table[name] = np.full(rows, value)
    table |= columns
    path = folder / "targets.csv"
    np.savetxt(path, np.stack(list(table.values()), axis=1), delimiter=",", header=",".join(table), comments="")
    return path


def test_playback_holds_targets_and_sorts_joints(tmp_path: Path) -> None:
    off = (np.arange(50) < 25).astype(float)
    path = _file(tmp_path, joints=JOINTS[::-1], torque_enable=off, q_target_FR_hip=np.linspace(0.0, 0.2, 50))
    t = 5.0 + np.arange(400) * 0.002
    motion = playback(t, NOMINAL_STANCE, soft_limits(0.95), np.random.default_rng(0), file=str(path))
    np.testing.assert_allclose(motion.target[:, 0], np.linspace(0, 0.2, 50)[(np.arange(400) // 5).clip(max=49)])
    np.testing.assert_allclose(motion.target[:, 1:], np.tile(NOMINAL_STANCE[1:], (400, 1)))
    assert motion.torque_enable[:125].all()
    assert not motion.torque_enable[125:].any()
    assert motion.support == "suspended"


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda d: d / "none.csv", "cannot be read"),
        (lambda d: _file(d, joints=JOINTS[:3]), "targets of 3 joints; needed are 12"),
        (lambda d: _file(d, q_target_FL_calf=np.full(50, -5.0)), r"q_target_FL_calf goes from -5 to -5 rad; allowed"),
        (lambda d: _file(d, t=np.zeros(50)), "column t must increase"),
        (lambda d: _file(d, kp_FR_hip=np.full(50, np.nan)), "column kp_FR_hip has a value that is not finite"),
    ],
)
def test_playback_says_what_is_wrong_with_a_file(tmp_path: Path, make: Any, complaint: str) -> None:
    t, file = np.arange(10) * 0.01, str(make(tmp_path))
    with pytest.raises(ExcitationError, match=complaint):
        playback(t, NOMINAL_STANCE, soft_limits(0.95), np.random.default_rng(0), file=file)


# ---------------------------------------------------------------------- the verb, as a user has it


@pytest.mark.slow("go1exp/gap/", "go1exp/cli/gap_next.py", "conf/gap_next.yaml", "tests/")
def test_next_as_a_user_runs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = "excitation=[multisine,gait]"
    (tmp_path / "hidden.yaml").write_text("kd_scale: {scale: 1.7}\n")
    words = [kinds, "seeds=[0,1,2]", "seconds=4", "effect=hidden.yaml", "backend.threads=1", "out=r"]
    assert refuse(tmp_path, "record", *words).returncode == 0
    search = ["search.bootstraps=5", "search.shortlist=3", "search.threads=1"]
    explained = refuse(tmp_path, "gap", "explain", "logs=r", "out=g", *search)
    assert explained.returncode in (10, 11), explained.stderr
    monkeypatch.setattr("go1exp.gap.design.plan.MOTIONS", (("multisine", {}), ("gait", {})))
    for gains, status in (("[[1,1],[1,2]]", 0), ("[[1,1]]", 16)):
        limits = ["design.designs=12", "design.refine=0", "design.hang=[[0,0]]", "design.seconds=4"]
        done = refuse(tmp_path, "gap", "next", "logs=r", "out=g", f"design.gains={gains}", *limits)
        assert done.returncode == status
        found = json.loads((tmp_path / "g/next.json").read_text())
        assert (tmp_path / "g/next.csv").exists() == (status == 0)
        if status == 0:
            assert "record next" in done.stdout
            assert found["design"]["kd"][0] > 0.6
            assert found["pairs"][0]["after"]["power"] > ENOUGH > found["pairs"][0]["before"]["power"]
        else:
            assert "not separable" in done.stdout
            assert "gains and hang may not change" in done.stdout
