"""Walking logs by their legs in swing: where they swing, the replay against the free robot, and what is named."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest

from go1exp.gap.comparison import Comparison, NotComparable, compare
from go1exp.gap.data.standing import LOADED, Log
from go1exp.gap.data.swings import SwingWindows, TrunkMotion, foot_forces, places, swings
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.replay.walking import SwingReplayer, packed_by_leg
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.go1 import StandingGo1, SuspendedGo1, SwingingGo1
from go1exp.gap.score.angle_errors import localise, of_angles
from go1exp.gap.score.likelihood import excess, state_probes
from go1exp.gap.search import tolerances
from go1exp.gap.search.fit import residuals
from go1exp.gap.stages import explain as stages_explain
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import Recording
from go1exp.robot import LEGS
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import sizes
from go1exp.sim.physics.dynamics import Legs
from tests import laboratory

EXACT = tuple(
    f"sensors.{name}={{noise: 0.0, step: 0.0}}"
    for name in ("q", "qd", "tau_est", "gyro", "acc", "attitude", "foot_force")
)
SWING = GapSettings(phase="swing", physics_dt=0.002, bootstraps=20, overlays=1, threads=1)


@cache
def recorded(*overrides: str) -> tuple[RobotConfig, tuple[Recording, ...]]:
    """Record a Go1 that trots on the spot, twice 3 s."""
    given = ["support=ground", "excitation=[gait]", "gains=[[35,0.6]]", "seconds=3.0", "seeds=[0,1]", *overrides]
    rig, found = laboratory.recorded(given)
    return rig.robot, found


@cache
def exact() -> Comparison:
    """Return a walk of which every sensor is exact, beside the model at a quarter of the usual step."""
    config, recordings = recorded("sensors.jitter=0.0", *EXACT)
    return compare(recordings, SuspendedGo1(config), SWING, physics_dt=0.0005)


def unexplained(comparison: Comparison, theta: Theta | None = None) -> np.ndarray:
    """Return the errors of the angles that are compared, rad, without what initial states and the IMU explain."""
    residual = residuals(comparison.scorer, [theta or {}], comparison.everything, comparison.dt)[0]
    errors = of_angles(comparison.scorer, residual, comparison.everything)
    return np.asarray(errors[comparison.windows.compared])


def test_feet_are_in_the_air_where_the_ground_does_not_push_them() -> None:
    config, (log, *_) = recorded()
    legs, read = Legs(config), Log.from_recording(log)
    air = foot_forces(config, legs, read, TrunkMotion.from_log(read, legs.imu_site)) < LOADED
    true = log.block(*(f"foot_force_{leg}" for leg in LEGS))
    changes = np.abs(np.diff((true < LOADED).astype(float), axis=0, prepend=1.0))
    calm = np.apply_along_axis(np.convolve, 0, changes, np.ones(15), "same") < 0.5  # 14 ms from any change
    assert calm.mean() > 0.5
    assert (air == (true < LOADED))[calm].mean() > 0.99
    for leg, begin, end in swings(read.t, np.where(air, 0.0, 2 * LOADED)):
        inside = (read.t > begin + 0.012) & (read.t < end - 0.012)
        assert (true[inside, leg] > 2 * LOADED).sum() <= 2  # a foot may tap the ground for a few milliseconds


def test_a_window_is_where_its_legs_swing_and_other_legs_are_not_compared() -> None:
    windows = exact().windows
    assert isinstance(windows, SwingWindows)
    assert len(windows) > 8
    legs = windows.compared.reshape(-1, 4, 3)
    assert (legs.all(axis=2) == legs.any(axis=2)).all()
    assert legs.all(axis=2).sum(axis=1).max() == 2
    logs = recorded("sensors.jitter=0.0", *EXACT)[1]
    for k, shown in enumerate(np.asarray(legs.all(axis=2))):
        log = logs[windows.episode[k]]
        true = log.block(*(f"foot_force_{leg}" for leg in LEGS))
        last = windows.begin[k] + windows.t[k, windows.valid[k]].max()
        inside = (log.t >= windows.begin[k]) & (log.t <= last)
        assert true[inside][:, shown].max() < 1.0


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([(0, 1.0, 1.2), (3, 1.01, 1.2)], [(0, 1, 2, 9, 10, 11)]),
        ([(0, 1.0, 1.2), (3, 1.15, 1.35)], [(0, 1, 2), (9, 10, 11)]),
        ([(1, 1.0, 1.05)], []),  # too short
        ([(1, 4.9, 5.1)], []),  # beyond the end
    ],
)
def test_legs_that_swing_together_share_a_window(
    found: list[tuple[int, float, float]], expected: list[tuple[int, ...]]
) -> None:
    made = places(found, 0.1, 5.0)
    assert [place.joints for place in made] == expected
    for place in made:
        assert place.first < place.last < place.end


def test_legs_in_the_air_follow_the_free_robot_and_not_without_the_motion_of_its_trunk() -> None:
    comparison = exact()
    right = unexplained(comparison)
    assert np.median(right) < 4e-5
    assert np.quantile(right, 0.9) < 1.5e-4
    windows = comparison.windows
    assert isinstance(windows, SwingWindows)
    still = tuple((t, np.tile([0.0, 0.0, 9.81, *[0.0] * 6], (len(t), 1))) for t, _ in windows.carried)
    replayer = dataclasses.replace(comparison.scorer.replayer, windows=dataclasses.replace(windows, carried=still))
    scorer = dataclasses.replace(comparison.scorer, replayer=replayer)
    assert np.median(unexplained(dataclasses.replace(comparison, scorer=scorer))) > 10 * np.median(right)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_an_imu_that_sits_tilted_is_turned_back() -> None:
    config, recordings = recorded("+effect.base_tilt.pitch=0.1", "+effect.base_tilt.roll=-0.06", *EXACT)
    comparison = compare(recordings, SuspendedGo1(config), SWING, physics_dt=0.0005)
    tilted = {("base_tilt", "pitch"): np.array([0.1]), ("base_tilt", "roll"): np.array([-0.06])}
    assert np.median(unexplained(comparison, tilted)) < 0.5 * np.median(unexplained(comparison))


def test_legs_share_simulations_and_move_as_in_one_for_each_row() -> None:
    comparison = exact()
    machine, replayer = comparison.robot, comparison.scorer.replayer
    keys = [key for effect in ("coulomb", "base_tilt", "torque_delay") for key in sizes(effect)]
    probes = [*state_probes(machine), *tolerances.probes(machine, keys, {})]
    rows = variants(machine, {}, comparison.everything[:3], probes)
    fewer, slot = packed_by_leg(rows, 12)
    assert len(fewer.window) < 0.4 * len(rows.window)
    assert (fewer.window[slot] == rows.window).all()
    assert isinstance(replayer, SwingReplayer)
    np.testing.assert_allclose(replayer.run(rows, 0.002), Replayer.run(replayer, rows, 0.002), atol=1e-6)


def test_a_walk_like_the_model_scores_the_floor_joint_by_joint() -> None:
    config, recordings = recorded()
    comparison = compare(recordings, SuspendedGo1(config), SWING)
    residual = residuals(comparison.scorer, [{}], comparison.everything, comparison.dt)[0]
    chi2 = comparison.scorer.chi2(residual, comparison.everything)
    assert chi2.mean() == pytest.approx(0.85, abs=0.2)
    assert chi2.max() < 2.0
    found = localise(comparison.scorer, residual, comparison.everything, np.random.default_rng(0))
    shown = (comparison.windows.valid.sum(1)[:, None] * comparison.windows.compared).sum(0)
    small, large = (found.samples[:, found.regimes.index(name)] for name in ("small angle", "large angle"))
    assert (small + large <= shown).all()
    assert (found.samples.sum(1) > 0).all()


def test_the_phase_says_what_of_a_walk_is_compared() -> None:
    config, recordings = recorded()
    machine = SuspendedGo1(config)
    assert isinstance(machine.suited(recordings, "swing"), SwingingGo1)
    assert isinstance(machine.suited(recordings, "whole"), StandingGo1)
    assert isinstance(machine.suited(recordings, "auto"), StandingGo1)


@pytest.mark.parametrize(
    ("verdict", "named", "compared", "note"),
    [
        ("explained", True, ["swing"], "search.phase=whole"),
        ("partly explained", True, ["swing"], "search.phase=whole"),
        ("unexplained", False, ["swing", "whole"], "do not agree with the model, and nothing in the library explains"),
        ("no gap", False, ["swing", "whole"], "Legs in the air agree with the model: error 7.2 times"),
        ("bad log", False, ["swing", "whole"], ""),
    ],
)
def test_the_whole_robot_is_compared_unless_legs_in_the_air_name_something(
    monkeypatch: pytest.MonkeyPatch, verdict: Any, named: bool, compared: list[str], note: str
) -> None:
    config, recordings = recorded()
    phases: list[str] = []
    one = NamedEffect("coulomb", ("FR_hip",), {}, {}, ("coulomb",), "certified")

    def judged(logs: object, robot: object, settings: GapSettings, on_progress: object) -> GapResult:
        phases.append(settings.phase)
        if settings.phase == "whole":
            return GapResult("explained", "the trunk")
        excess_of_legs = {} if verdict == "bad log" else {"box": 6.2}
        return GapResult(verdict, "the legs", named=(one,) if named else (), excess=excess_of_legs)

    monkeypatch.setattr(stages_explain, "_explained", judged)
    found = explain(recordings, config, dataclasses.replace(SWING, phase="auto"))
    assert phases == compared
    assert found.sentence == ("the legs" if named else "the trunk")
    assert len(found.warnings) == bool(note)
    assert all(note in line for line in found.warnings)


@pytest.mark.parametrize(
    ("effect", "on_ground", "warned"),
    [("encoder_offset", True, True), ("encoder_offset", False, False), ("payload", True, False)],
)
def test_an_offset_that_only_a_robot_on_its_feet_shows_comes_with_a_warning(
    effect: str, on_ground: bool, warned: bool
) -> None:
    one = NamedEffect(effect, ("FR_calf",), {}, {}, (effect,), "certified")
    lines = stages_explain.doubts([one], on_ground)
    assert [("record it suspended" in line) for line in lines] == [True] * warned


def test_a_robot_that_never_lifts_a_foot_is_told_so() -> None:
    config, recordings = recorded("excitation=[squat]")
    with pytest.raises(NotComparable, match="no leg swings"):
        compare(recordings, SuspendedGo1(config), SWING)


SEARCH = ("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
LONG = ("seeds=[0,1,2,3]", "seconds=4.0")


@pytest.mark.slow(*SEARCH)
def test_friction_is_named_from_the_legs_in_the_air() -> None:
    config, recordings = recorded(*LONG, "+effect.coulomb.bound=0.15")
    found = explain(recordings, config, dataclasses.replace(SWING, phase="auto"))
    assert found.verdict == "explained"
    assert [(n.effect, n.status) for n in found.named] == [("coulomb", "certified")]
    values = np.array(list(found.named[0].params["bound"].values()))
    assert values == pytest.approx(0.15, abs=0.03)
    assert {"payload", "foot_friction"} <= set(found.not_excited)
    assert any("search.phase=whole" in line for line in found.warnings)
    assert found.provenance["settings"]["phase"] == "swing"


@pytest.mark.slow(*SEARCH)
def test_nothing_is_named_in_legs_like_the_model_whatever_the_trunk_carries() -> None:
    config, recordings = recorded(*LONG, "+effect.payload.mass=2.0")
    found = explain(recordings, config, SWING)
    assert found.verdict == "no gap"
    assert found.named == ()
    assert found.excess["null"] == pytest.approx(excess(np.ones(1)), abs=0.3)
