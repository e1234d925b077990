"""``go1exp.gap`` on a robot on its feet: the initial state and the IMU against the truth, a null, a payload."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp.gap.comparison import prepare
from go1exp.gap.data.standing import AGREE, Base, Log, StandingWindows, base_state
from go1exp.gap.data.windows import splits
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Probe, Theta, variants
from go1exp.gap.replay.walking import StandingReplayer
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.go1 import StandingGo1, SuspendedGo1
from go1exp.gap.score.angle_errors import ON_FEET, REGIMES, localise
from go1exp.gap.score.initial_state import converged
from go1exp.gap.score.likelihood import Scorer, excess
from go1exp.gap.search import reduction, single_cause
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.state import Search, State, begun
from go1exp.gap.search.stepwise import alone, run
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import VECTORS, Recording
from go1exp.robot import JOINTS
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import declared, sizes
from go1exp.sim.physics.dynamics import Legs
from go1exp.sim.physics.scene import build_model
from go1exp.sim.terrain import TerrainConfig, build_terrain
from tests import laboratory

QUICK = GapSettings(window_s=0.1, stride_s=0.25, physics_dt=0.002, bootstraps=20, overlays=0)


@cache
def recorded(*overrides: str) -> tuple[RobotConfig, tuple[Recording, ...]]:
    """Record a Go1 on the ground for 2 s a motion."""
    rig, found = laboratory.recorded(
        ["support=ground", "gains=[[35,0.6]]", "seconds=2.0", "sensors.truth=true", *overrides]
    )
    return rig.robot, found


def truth(recording: Recording) -> np.ndarray:
    """Return the bases (T, 13) of a recording that has them, as ``StandingWindows.base`` has them."""
    names = (VECTORS[name] for name in ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel"))
    return np.concatenate([recording.block(*columns) for columns in names], axis=1)


def errors(config: RobotConfig, recording: Recording) -> tuple[np.ndarray, list[Base]]:
    """Return by how much estimates miss height, roll, pitch, velocity and rate (K, 9), and the estimates."""
    legs, log, true = Legs(config), Log.from_recording(recording), truth(recording)
    found, bases = [], []
    for row in range(40, len(log.t) - 40, 31):
        base = base_state(legs, log, float(log.t[row]))
        bases.append(base)
        if base.spread < AGREE:
            was, now = (Rotation.from_quat(x[3:7], scalar_first=True) for x in (true[row], base.state))
            turn = (was.inv() * now).as_rotvec()[:2]
            found.append([base.state[2] - true[row, 2], *turn, *(base.state[7:] - true[row, 7:])])
    return np.array(found), bases


def test_a_squatting_base_is_where_legs_and_imu_say() -> None:
    config, (squat, *_) = recorded("excitation=[squat,gait]")
    missed, bases = errors(config, squat)
    assert len(missed) > 25
    assert all(base.loaded.all() for base in bases)
    miss = np.sqrt(np.mean(missed**2, axis=0))
    assert miss[0] < 5e-4
    assert miss[1:3].max() < 1e-3
    assert miss[3:6].max() < 5e-3
    assert miss[6:].max() < 6e-3


def test_a_walking_base_is_estimated_where_two_feet_agree_and_nowhere_else() -> None:
    config, (_, gait) = recorded("excitation=[squat,gait]")
    missed, bases = errors(config, gait)
    assert 10 < len(missed) < len(bases)
    assert all(base.spread == np.inf for base in bases if base.loaded.sum() < 2)
    middle = np.median(np.abs(missed), axis=0)
    assert middle[0] < 1.5e-3
    assert middle[3:6].max() < 0.06


def ready(config: RobotConfig, recordings: tuple[Recording, ...]) -> tuple[StandingReplayer, float]:
    """Return the replayer of ``QUICK`` windows, and its step."""
    machine, done = prepare(recordings, SuspendedGo1(config), QUICK)
    windows = machine.windows(done)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(windows), 1))
    replayer = machine.replayer(windows, level, 512, 1)
    assert isinstance(replayer, StandingReplayer)
    return replayer, float(windows.period)


def test_the_replayed_imu_says_what_the_engine_s_own_sensors_say() -> None:
    config, recordings = recorded("excitation=[squat,gait]")
    replayer, dt = ready(config, recordings)
    windows = replayer.windows
    assert isinstance(windows, StandingWindows)
    everything = np.arange(len(windows))
    ours = replayer.run(variants(replayer.machine, {}, everything, []), dt)[:, :, 2, :6]
    backend = next(iter(replayer._backends.values()))[0]
    model, blocks = build_model(config, build_terrain(TerrainConfig(kind="flat")), dt, imu=True)
    data = mujoco.MjData(model)
    last = len(everything) - 1
    data.qpos[:], data.qvel[:] = backend.qpos[last].numpy(), backend.qvel[last].numpy()
    mujoco.mj_forward(model, data)
    speed = torch.as_tensor(data.qvel.copy())
    mujoco.mj_step(model, data)
    change = (data.qvel - speed.numpy()) / dt
    rotation = Rotation.from_quat(backend.qpos[last, 3:7].numpy(), scalar_first=True)
    rate = data.sensordata[blocks.imu_gyro]
    site = windows.imu_site
    force = rotation.inv().apply(change[:3] + np.array([0.0, 0.0, 9.81])) + np.cross(change[3:6], site)
    force += np.cross(rate, np.cross(rate, site))
    np.testing.assert_allclose(force, data.sensordata[blocks.imu_acc], rtol=1e-6, atol=1e-6)
    measured = windows.y[:, :, 2, :6]
    calm = windows.episode == 0  # the squat
    assert np.abs(ours - measured)[calm, :, :3].max() < 0.1
    assert np.sqrt(np.mean((ours - measured)[calm, :, 3:] ** 2)) < 0.2


@cache
def scored() -> tuple[Scorer, np.ndarray]:
    """Return the scorer of a robot as the model has it, and its residuals."""
    replayer, dt = ready(*recorded("excitation=[squat,gait]"))
    score, _ = converged(replayer, dt, 0.00015)
    return score, residuals(score, [{}], np.arange(len(score.windows)), dt)[0]


def test_a_robot_like_the_model_scores_the_floor_squatting_and_walking() -> None:
    score, residual = scored()
    chi2 = score.chi2(residual, np.arange(len(score.windows)))[:, 0]
    squat = score.windows.episode == 0
    assert chi2[squat].mean() == pytest.approx(1.0, abs=0.15)
    assert np.median(chi2[~squat]) < 1.3
    assert not np.isnan(chi2).any()


def test_regimes_of_the_ground_follow_the_feet() -> None:
    score, residual = scored()
    everything = np.arange(len(score.windows))
    found = localise(score, residual, everything, np.random.default_rng(0))
    assert found.regimes == (*REGIMES, *ON_FEET)
    stance, swing, impact = (found.samples[:, found.regimes.index(name)] for name in ON_FEET)
    assert (stance > swing).all()
    assert (swing > 0).all()
    assert (impact > 0).all()
    assert (stance + swing == score.windows.valid.sum()).all()


def test_hung_windows_among_standing_ones_are_replayed_as_by_themselves() -> None:
    config, recordings = recorded("excitation=[squat,gait]")
    _, hung = recorded("excitation=[chirp]", "support=suspended")
    assert isinstance(SuspendedGo1(config).suited((*recordings, *hung)), StandingGo1)
    assert isinstance(SuspendedGo1(config).suited(hung), SuspendedGo1)
    replayer, dt = ready(config, (*recordings, *hung))
    windows = replayer.windows
    assert isinstance(windows, StandingWindows)
    held = np.flatnonzero(windows.held)
    assert set(windows.episode[held]) == {len(recordings)}
    assert np.isinf(windows.scale[held, 2]).all()
    probes = [Probe(("coulomb", "bound"), 1, np.full(12, 0.2))]
    found = replayer.run(variants(replayer.machine, {}, held, probes), dt)
    alone = Replayer(SuspendedGo1(config), windows.plain(), replayer.quats, 512, 1)
    expected = alone.run(variants(alone.machine, {}, held, []), dt)
    np.testing.assert_allclose(found[::2, :, :2], expected, atol=1e-12)
    assert np.abs(found[1::2] - found[::2]).max() > 1e-3
    assert not found[:, :, 2].any()


def test_a_recording_without_an_imu_says_so() -> None:
    config, (squat, *_) = recorded("excitation=[squat,gait]")
    gone = set(VECTORS["imu_acc"])
    deaf = Recording(squat.meta, {k: v for k, v in squat.channels.items() if k not in gone})
    found = explain([deaf], config, QUICK)
    assert found.verdict == "bad log"
    assert "no imu_acc" in found.sentence


def search_in(*overrides: str) -> Search:
    """Return a search that has not begun, in a squatting and falling robot's recordings."""
    config, recordings = recorded("excitation=[squat,drop]", "seeds=[0,1]", *overrides)
    replayer, dt = ready(config, recordings)
    score, _ = converged(replayer, dt, 0.00015)
    rng = np.random.default_rng(0)
    parts = splits([r.meta for r in recordings], score.windows.episode, 0.2, rng)
    return begun(score, parts, QUICK, dt, rng)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_payload_is_named_although_the_tolerances_of_the_joints_could_carry_it() -> None:
    search = search_in("+effect.payload.mass=1.0")
    plain = excess(search.state.held_out({}))
    search, found = alone(search)
    assert found is not None
    assert found.name == "payload"
    assert found.theta["payload", "mass"].item() == pytest.approx(1.0, abs=0.1)
    assert [(c.effect, c.status) for c in search.candidates] == [("payload", "accepted")]
    assert plain > 1.0
    assert search.candidates[0].excess_after < 0.1 * plain


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_payload_on_a_walking_robot_fits_best_by_first_states_of_its_own() -> None:
    config, recordings = recorded("excitation=[gait]", "seeds=[0,1]", "+effect.payload.mass=2.0")
    replayer, dt = ready(config, recordings)
    score, _ = converged(replayer, dt, 0.00015)
    everything, first = np.arange(len(score.windows)), single_cause.unmoved(score, dt)
    assert first.windows is replayer.windows
    found, _ = single_cause.fitted_alike(first, sizes("payload"), everything, dt)
    assert found["payload", "mass"].item() == pytest.approx(2.0, abs=0.2)
    truth = {("payload", "mass"): np.array([2.0])}
    right, none = (np.log(single_cause.profile_chi2(first, theta, everything, dt)).mean() for theta in (truth, {}))
    assert right < 0.5
    assert none > right + 1.0
    # By initial states that suit the nominal model the truth is hidden.
    hidden = np.log(score.chi2(residuals(score, [truth], everything, dt)[0], everything)).mean()
    assert hidden > right + 0.5


def test_rungs_of_a_ladder_are_on_both_sides_of_null_and_no_farther_than_a_parameter_goes() -> None:
    rungs = single_cause.ladder(declared(("payload", "mass")))
    assert rungs == pytest.approx([-0.8, -0.4, 0.0, 0.4, 0.8, 1.6, 3.2, 6.4])


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_nothing_alone_is_named_in_a_robot_like_the_model() -> None:
    search = search_in()
    search, found = alone(search)
    assert found is None
    assert search.candidates == ()
    assert excess(search.state.held_out({})) < search.settings.material


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize(
    "hidden",
    [("+effect.strength.scale=0.93",), ("+effect.strength.scale=0.96", "+effect.kp_scale.scale=0.92")],
    ids=["strength", "strength and gain"],
)
def test_drives_that_are_all_a_little_weak_are_no_payload_and_within_tolerances(hidden: tuple[str, ...]) -> None:
    search = search_in(*hidden)
    plain = excess(search.state.held_out({}))
    search, found = alone(search)
    assert found is None
    # Where the tolerances reach, what they do alike is all but the answer, and the fit of all joints begins there.
    for key, values in search.within.items():
        p = search.state.tolerances.param(key)
        assert np.ptp(values) == 0.0
        assert np.abs(values - p.null).max() <= p.tolerance * (1.0 + 1e-9)
    state = replace(search.state, theta=search.within).updated()
    assert excess(state.held_out()) < 0.2 * plain


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_drives_that_are_all_weaker_than_tolerances_allow_are_one_cause() -> None:
    _, cause = alone(search_in("+effect.strength.scale=0.8"))
    assert cause is not None
    assert cause.name == "strength"
    assert cause.theta["strength", "scale"] == pytest.approx(np.full(12, 0.8), abs=0.02)


@pytest.mark.parametrize(("offset", "named"), [(0.009, True), (0.0045, True), (0.0031, False), (0.0025, False)])
def test_offsets_that_are_alike_are_one_cause_where_their_tolerance_does_not_reach(
    monkeypatch: pytest.MonkeyPatch, offset: float, named: bool
) -> None:
    score, _ = scored()
    _, recordings = recorded("excitation=[squat,gait]")
    parts = splits([r.meta for r in recordings], score.windows.episode, 0.2, np.random.default_rng(0))
    (key,) = sizes("encoder_offset")

    def made_up(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> np.ndarray:
        missed = (theta.get(key, np.zeros(12)) - offset) / 0.001
        return np.full((len(windows), 1), 1.0 + np.mean(missed**2))

    monkeypatch.setattr(single_cause, "profile_chi2", made_up)
    sought = single_cause.clearest(score, State(score, parts, QUICK, 0.002))
    best, tolerance = sought.best, declared(key).tolerance
    if offset > tolerance:
        assert sought.within[key] == pytest.approx(np.full(12, tolerance), abs=1e-4)
    assert (best is not None) == named
    if best is not None:
        assert best.name == "encoder_offset"
        assert best.theta[key] == pytest.approx(np.full(12, offset), abs=1e-3)


@pytest.mark.parametrize(("hips", "others"), [(0.855, 1.0), (1.0, 1.0), (0.96, 0.96)])
def test_the_drives_of_one_part_may_be_off_together_within_their_tolerances(
    monkeypatch: pytest.MonkeyPatch, hips: float, others: float
) -> None:
    """Hips of 0.855 are 0.95 of strength and 0.9 of the gain, as far as this robot tells."""
    score, _ = scored()
    keys = [("strength", "scale"), ("kp_scale", "scale")]
    truth = np.where(np.arange(12) % 3 == 0, hips, others)

    def made_up(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> np.ndarray:
        made = np.prod([np.broadcast_to(theta.get(key, np.ones(1)), (12,)) for key in keys], axis=0)
        return np.full((len(windows), 1), 1.0 + 1e4 * np.mean((made - truth) ** 2))

    monkeypatch.setattr(single_cause, "profile_chi2", made_up)
    begin: Theta = {keys[0]: np.full(12, others)}
    theta = single_cause.at_one_part(score, begin, keys, reduction.parts(JOINTS), np.arange(2), 0.002)
    if hips == others:
        assert theta == begin  # nothing fits better, so nothing changes
        return
    made = theta[keys[0]] * theta[keys[1]]
    np.testing.assert_allclose(made, truth, atol=1e-3)
    for key in keys:
        assert (abs(theta[key] - 1.0) <= declared(key).tolerance + 1e-9).all()


def test_the_fit_within_tolerances_begins_at_what_is_off_alike_where_nothing_alone_explains_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    score, _ = scored()
    _, recordings = recorded("excitation=[squat,gait]")
    rng = np.random.default_rng(0)
    parts = splits([r.meta for r in recordings], score.windows.episode, 0.2, rng)
    within: Theta = {("strength", "scale"): np.full(12, 0.96)}
    starts: list[Theta] = []

    class Stopped(Exception):
        pass

    def stopped(self: State, rounds: int) -> State:
        starts.append(self.theta)
        raise Stopped

    monkeypatch.setattr(single_cause, "cause", lambda search, test: (search, single_cause.Sought(None, within)))
    monkeypatch.setattr(State, "updated", lambda self: self)
    monkeypatch.setattr(State, "converged", stopped)
    for settings in (QUICK, replace(QUICK, calibrate=False)):
        with pytest.raises(Stopped):
            run(begun(score, parts, settings, 0.002, rng))
    assert starts == [within, {}]
