"""Excitations: what every one of them owes its player, and that each excites what it is for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import signal

from go1exp import robot
from go1exp.config.schema import registry
from go1exp.logs import excitations
from go1exp.logs.audit.signals import stretches
from go1exp.logs.excitations import ExcitationError, Motion
from go1exp.mdp.kinematics import foot_positions

RATE = 500.0
MEMBERS = registry.members("excitation")
GO1 = (robot.NOMINAL_STANCE, robot.soft_limits(0.9))
HERE = [name for name, entry in MEMBERS.items() if entry.target.__module__.startswith(excitations.__name__)]


def clock(duration: float = 20.0, rate: float = RATE) -> np.ndarray:
    return np.arange(round(duration * rate)) / rate


def go1(name: str, seed: int = 0, t: np.ndarray | None = None, **parameters: object) -> Motion:
    return MEMBERS[name].target(clock() if t is None else t, *GO1, np.random.default_rng(seed), **parameters)


def power(target: np.ndarray, low: float, high: float) -> np.ndarray:
    """Mean power of each joint's angle in a band, rad2/Hz."""
    frequency, density = signal.periodogram(target - target.mean(axis=0), RATE, axis=0)
    return density[(frequency >= low) & (frequency < high)].mean(axis=0)


# ---------------------------------------------------------------------- the contract


def test_all_of_them_are_there() -> None:
    assert HERE == ["squat", "drop", "chirp", "multisine", "slow_ramps", "gait", "steps", "torque_off"]


@pytest.mark.parametrize("name", HERE)
@pytest.mark.parametrize("joints", [1, 2, 3, 6, 7, 12])
def test_it_stays_within_the_limits_of_any_robot(name: str, joints: int) -> None:
    draw = np.random.default_rng(joints)
    low = draw.uniform(-2, 0, joints)
    limits = np.stack([low, low + draw.uniform(0.05, 3, joints)], axis=1)
    for share in (0.0, 0.3, 1.0):  # also from the very limit
        centre = limits[:, 0] + share * (limits[:, 1] - limits[:, 0])
        centre = np.clip(centre, limits[:, 0], limits[:, 1])
        for t in (clock(6.0), clock(6.0, 50.0), clock(0.1), np.zeros(1), clock(4.0) + 100):
            motion = MEMBERS[name].target(t, centre, limits, np.random.default_rng(1))
            assert motion.target.shape == (len(t), joints)
            assert motion.target.dtype == np.float64
            assert motion.torque_enable.shape == (len(t),)
            assert motion.torque_enable.dtype == np.bool_
            assert motion.torque_enable[0]
            assert np.isfinite(motion.target).all()
            assert np.all((motion.target >= limits[:, 0]) & (motion.target <= limits[:, 1]))
            np.testing.assert_array_equal(motion.start, motion.target[0])
            np.testing.assert_allclose(motion.start, centre, atol=1e-12)
            assert motion.support in ("suspended", "ground", "either")
            assert motion.height >= 0


@pytest.mark.parametrize("name", HERE)
def test_a_seed_is_a_motion(name: str) -> None:
    first, again, other = go1(name, 3), go1(name, 3), go1(name, 4)
    np.testing.assert_array_equal(first.target, again.target)
    np.testing.assert_array_equal(first.torque_enable, again.torque_enable)
    assert first.height == again.height
    assert first.height != other.height or not np.array_equal(first.target, other.target)


@pytest.mark.parametrize("name", [n for n in HERE if n != "multisine"])  # which is scaled by its largest sample
def test_the_same_motion_at_any_rate_and_time_of_day(name: str) -> None:
    fine = go1(name, 3, np.append(clock(), 20.0))
    coarse = go1(name, 3, np.append(clock(rate=50.0), 20.0))
    np.testing.assert_allclose(coarse.target, fine.target[::10], atol=1e-9)
    np.testing.assert_array_equal(coarse.torque_enable, fine.torque_enable[::10])
    later = go1(name, 3, np.append(clock(), 20.0) + 64)
    np.testing.assert_allclose(later.target, fine.target, atol=1e-6)


@pytest.mark.parametrize("name", [n for n in HERE if MEMBERS[n].traits.get("smooth")])
def test_where_speed_is_promised_to_be_continuous_it_is(name: str) -> None:
    """Halving the step halves the jump of the speed from sample to sample; at a corner the jump would stay."""
    jump = []
    for rate in (500.0, 1000.0):
        speed = np.diff(go1(name, 3, np.append(clock(8.0, rate), 8.0)).target, axis=0) * rate
        jump.append(np.abs(np.diff(speed, axis=0)).max(axis=0))
        assert np.abs(speed[0]).max() < 1e-3  # and from rest
    assert np.all(jump[1] <= 0.6 * jump[0] + 1e-9)


@pytest.mark.parametrize("name", [n for n in HERE if n not in ("squat", "drop")])
def test_joints_do_not_move_as_one(name: str) -> None:
    target = go1(name, t=clock(40.0)).target
    highest = np.abs(np.corrcoef(target.T) - np.eye(12)).max()
    # Legs of a trot go together, and of some 14 poses chance makes two joints share nearly all signs; never the angles.
    assert highest < (0.995 if name in ("gait", "torque_off") else 0.9)


@pytest.mark.parametrize("name", HERE)
def test_its_parameters_are_checked(name: str) -> None:
    entry = MEMBERS[name]
    values, problems = entry.check({}, name)
    assert problems == []
    assert set(values) == set(entry.parameters)
    assert entry.check({"amplitudee": 1}, name)[1] != []
    for key, value in values.items():
        negative = [-1] * len(value) if isinstance(value, tuple) else -1
        assert entry.check({key: negative}, name)[1] != [], key


@pytest.mark.parametrize("name", HERE)
def test_every_parameter_is_described_and_acts(name: str) -> None:
    entry = MEMBERS[name]
    duration = 6.0
    usual = go1(name, 1, clock(duration))
    for key, p in entry.parameters.items():
        assert f"        {key}: " in (entry.target.__doc__ or ""), key
        value = p.default
        other = tuple(0.7 * v for v in value) if isinstance(value, tuple) else type(value)(0.7 * value)
        changed = go1(name, 1, clock(duration), **{key: other})
        assert changed.height != usual.height or not np.array_equal(changed.target, usual.target), key


@pytest.mark.parametrize("name", HERE)
def test_a_stance_outside_the_limits_is_refused(name: str) -> None:
    limits = GO1[1].copy()
    limits[4] = [1.0, 2.0]
    with pytest.raises(ExcitationError, match=r"joint 4: the centre 0.8 rad must lie in \[1, 2\] rad"):
        MEMBERS[name].target(clock(1.0), GO1[0], limits, np.random.default_rng(0))


@pytest.mark.parametrize(("name", "highest"), [("chirp", "10"), ("multisine", "8"), ("gait", "7.5")])
def test_a_command_rate_that_cannot_carry_it_is_refused(name: str, highest: str) -> None:
    with pytest.raises(ExcitationError, match=f"{highest} Hz cannot be commanded at 12 Hz; stay below 6 Hz"):
        go1(name, t=clock(5.0, 12.0))


# ---------------------------------------------------------------------- what each is for


def test_a_chirp_covers_its_band_and_little_above_and_reaches_its_amplitude() -> None:
    for band in ((0.1, 10.0), (0.5, 4.0)):
        target = go1("chirp", band=band).target
        edges = np.geomspace(*band, 8)
        inside = np.array([power(target, a, b) for a, b in pairwise(edges)])
        above = power(target, 2 * band[1], 5 * band[1])
        assert np.all(inside > 1000 * above)
    speed = np.abs(np.diff(go1("chirp", speed=5.0).target, axis=0)).max() * RATE
    assert 4 < speed < 5.2  # the fade and the falling amplitude add a little to the sine's own
    swing = np.ptp(go1("chirp", amplitude=(0.1, 0.2, 0.3)).target[:5000], axis=0)
    np.testing.assert_allclose(swing, np.tile([0.2, 0.4, 0.6], 4), rtol=0.05)


def test_a_multisine_has_each_joints_own_lines() -> None:
    t = clock(1000.0, 50.0)
    target = go1("multisine", t=t, lines=6).target
    part = np.geomspace(0.15, 8.0, 7)
    collected: list[np.ndarray] = []
    for joint in range(12):
        frequency, density = signal.periodogram(target[:, joint] - target[:, joint].mean(), 50.0, window="hann")
        peaks = []
        for low, high in pairwise(part):
            in_band = (frequency >= low) & (frequency < high)
            peaks.append(frequency[in_band][np.argmax(density[in_band])])
        lines = np.array(peaks)
        for i, low in enumerate(lines):
            for high in lines[i + 1 :]:
                assert np.all(np.abs(high / low / np.arange(2, 6) - 1) > 0.01)
        assert all(np.any(np.abs(lines / other - 1) > 0.02) for other in collected)
        collected.append(lines)
    np.testing.assert_allclose(np.abs(target - GO1[0]).max(axis=0)[[0, 1]], [0.3, 0.4], rtol=0.1)


def test_slow_ramps_are_slow_turn_often_and_rest() -> None:
    t = clock(40.0)
    target = go1("slow_ramps", t=t).target
    speed = np.diff(target, axis=0) * RATE
    assert np.abs(speed).max() < 0.2 + 1e-9
    assert np.median(np.abs(speed[np.abs(speed) > 0])) > 0.05
    for joint in range(12):
        turns = np.flatnonzero(np.diff(np.sign(speed[np.abs(speed[:, joint]) > 1e-9, joint])))
        assert len(turns) >= 4
        assert any(b - a > 0.1 * RATE for a, b in stretches(np.abs(speed[:, joint]) < 1e-9))
        assert np.ptp(target[:, joint]) > 0.3


def test_steps_are_many_some_large_and_off_the_policys_grid() -> None:
    target = go1("steps").target
    change = np.diff(target, axis=0)
    for joint in range(12):
        edges = np.flatnonzero(change[:, joint])
        sizes = np.abs(change[edges, joint])
        assert len(edges) > 20
        assert sizes.max() >= (0.8 if joint % 3 else 0.69)
        assert len(np.unique(np.diff(edges))) > 10
        assert np.mean((edges + 1) % 10 != 0) > 0.5  # 50 Hz is every tenth command
    assert 20 * np.abs(change[:, 1::3]).max() > robot.EFFORT_LIMIT[1]  # the limit is reached at a gain of 20 N m/rad
    change, collected = np.abs(change), set()  # two joints take a large step while the others rest
    for row in np.flatnonzero((change > 0.65).any(axis=1)):
        movers = np.flatnonzero(change[row] > 0)
        assert len(movers) == 2
        assert movers[1] - movers[0] == 6
        others = np.delete(target[row], movers)
        np.testing.assert_array_equal(others, np.delete(GO1[0], movers))
        collected |= set(movers.tolist())
    assert collected == set(range(12))


def test_a_gait_steps_at_its_rate_with_diagonal_legs_together() -> None:
    target = go1("gait").target
    thigh = target[1000:, 1::3] - target[1000:, 1::3].mean(axis=0)
    frequency, density = signal.periodogram(thigh, RATE, axis=0)
    np.testing.assert_allclose(frequency[np.argmax(density, axis=0)], 2.5, atol=0.06)
    correlation = np.corrcoef(thigh.T)  # FR FL RR RL
    assert correlation[0, 3] > 0.8
    assert correlation[1, 2] > 0.8
    assert max(correlation[0, 1], correlation[0, 2], correlation[3, 1]) < -0.8
    thigh, calf = target[1000:, 1], target[1000:, 2]  # the foot is lifted while it swings forward
    backward = np.gradient(thigh) > 0
    x = -0.213 * (np.sin(thigh) + np.sin(thigh + calf))
    height = -0.213 * (np.cos(thigh) + np.cos(thigh + calf))
    assert np.all(calf[backward] > GO1[0][2] - 0.01)  # on the ground the calf is not bent
    assert calf[~backward].min() < GO1[0][2] - 0.35
    assert height[~backward].max() > height[backward].max() + 0.03
    assert x[backward][-1] != x[backward][0]


def test_torque_off_lets_the_joints_swing_several_times() -> None:
    motion = go1("torque_off", t=clock(10.0))
    free = stretches(~motion.torque_enable)
    assert len(free) >= 2
    poses = []
    for first, end in free:
        assert end - first >= 0.5 * RATE
        assert end < len(motion.target)  # the drives come back
        rest = motion.target[first - int(0.3 * RATE) : first]
        assert np.ptp(rest, axis=0).max() < 1e-12  # it starts from rest
        poses.append(rest[-1] - GO1[0])
        np.testing.assert_allclose(motion.target[end], GO1[0], atol=1e-12)
    away = np.abs(np.array(poses))
    assert away.min() >= 0.6 * 0.3 - 1e-9
    assert np.all(np.sign(poses[0]) == -np.sign(poses[1]))
    assert motion.soft_start > 0
    speed = np.abs(np.diff(motion.target, axis=0)).max() * RATE
    assert speed < 3.0  # no jumps while they are on


def test_a_squat_keeps_the_feet_below_and_beside_one_another() -> None:
    target = go1("squat").target.reshape(-1, 4, 3)
    thigh, calf = target[..., 1], target[..., 2]
    x = -0.213 * (np.sin(thigh) + np.sin(thigh + calf))
    z = 0.213 * (np.cos(thigh) + np.cos(thigh + calf))
    assert np.ptp(x, axis=0).max() < 1e-4  # m
    np.testing.assert_array_equal(np.ptp(target[..., 0], axis=0), np.zeros(4))
    share = z / z[0]
    assert np.ptp(share, axis=1).max() < 1e-3  # all legs sink alike: the trunk stays level
    assert 0.74 < share.min() < 0.85
    below = share[:, 0] < 0.9
    assert len(stretches(below)) >= 4
    limits = GO1[1].copy()
    limits[5, 0] = -1.7  # one calf bends less
    target = MEMBERS["squat"].target(clock(), GO1[0], limits, np.random.default_rng(0)).target
    assert -1.7 <= target[:, 5].min() < -1.68
    assert target[:, 2].min() > -1.75  # and the others no farther than that


def test_drops_hold_the_stance_and_differ_in_height() -> None:
    heights = [go1("drop", seed, clock(1.0)).height for seed in range(50)]
    assert 0.02 <= min(heights) < 0.03
    assert 0.07 < max(heights) <= 0.08
    np.testing.assert_array_equal(go1("drop").target, np.tile(GO1[0], (10000, 1)))
    with pytest.raises(ExcitationError, match=r"height\[1\] = 0.5 m: falls stay below 0.2 m"):
        go1("drop", height=(0.1, 0.5))


@pytest.mark.parametrize("name", ["chirp", "multisine", "slow_ramps", "gait", "torque_off"])
def test_legs_of_the_go1_keep_their_distance(name: str) -> None:
    """Feet of one side stay apart lengthwise, feet of a pair sideways (the foot's radius is 23 mm)."""
    for seed in range(3):
        foot = foot_positions(torch.as_tensor(go1(name, seed).target)).numpy()
        assert (foot[:, [0, 1], 0] - foot[:, [2, 3], 0]).min() > 0.06
        assert (foot[:, [1, 3], 1] - foot[:, [0, 2], 1]).min() > 0.06
