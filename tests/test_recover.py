"""Getting up and falling: what stands and rests by figures by hand, starts on side and back, motors that only brake."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from go1exp import robot
from go1exp.deploy.runtime.safety import SafetyConfig
from go1exp.evaluate.agents import PolicyAgent
from go1exp.evaluate.protocol.kinds.recover import Stand, posture, stood_up
from go1exp.evaluate.protocol.plan import NEVER, Braking, Plan
from go1exp.evaluate.protocol.playing import Rates, Result, play
from go1exp.evaluate.protocol.stage import Stage
from tests.test_protocols import selected


@pytest.fixture(scope="module")
def result(stands: PolicyAgent) -> Result:
    small = ("robots=2", "settle_s=2.0", "seconds=1.0", "push.after_s=0.4", "brake.seconds=3.0")
    return play(selected("recover", *small), stands, Rates(seed=1))


def test_a_robot_stands_from_the_time_on_from_which_it_holds_for_long_enough() -> None:
    dt, stand = 0.1, Stand(height=0.2, tilt=0.3, hold_s=0.5)
    height, tilt = np.full((20, 4), 0.3), np.zeros((20, 4))
    height[:6, 0] = 0.1  # up from the seventh step on
    height[:2, 1], height[6, 1] = 0.1, 0.1  # for four steps, then for good
    tilt[::5, 2] = 0.4  # never for five steps
    height[:16, 3] = 0.1  # too late to hold
    found = stood_up(height, tilt, dt, stand)
    np.testing.assert_allclose(found, [0.7, 0.8, np.nan, np.nan])


def test_robots_lie_on_side_and_back_at_rest_with_joints_all_over_their_range(stage: Stage) -> None:
    protocol: Any = selected("recover", "robots=6").protocol
    start = np.stack([protocol.lying(stage, n) for n in range(12)])
    joints, stops = start[:, 7:], robot.JOINT_POS_LIMITS
    assert ((joints >= stops[:, 0]) & (joints <= stops[:, 1])).all()
    assert (np.ptp(joints[:6], axis=0) > 0.4 * np.ptp(stops, axis=1)).all()
    np.testing.assert_allclose(np.linalg.norm(start[:, 3:7], axis=1), 1.0)
    braking = Braking(0.0, protocol.hold[1], protocol.hold[0])
    plan = Plan(np.zeros((100, 12, 3)), start=start, terminations=(), braking=braking, figures=posture)
    motion = stage.run(plan)
    assert motion.figures is not None
    np.testing.assert_allclose(motion.figures[0, :6, 0], 0.5 * np.pi, atol=0.1)
    np.testing.assert_allclose(motion.figures[0, 6:, 0], np.pi, atol=0.1)
    assert motion.alive.all()  # a fall ends nothing here
    assert (motion.figures[-1, :, 0] > 1.0).sum() >= 9  # some roll onto the belly
    assert (motion.figures[-1, :, 1] < 0.1).sum() >= 11


def test_motors_that_brake_make_no_other_torque_than_the_runtimes(stage: Stage) -> None:
    """Whatever the policy wants; and none brakes that is not tilted far enough."""
    start = np.tile(np.r_[0.0, 0.0, 0.33, 1.0, 0.0, 0.0, 0.0, robot.NOMINAL_STANCE], (2, 1))
    start[1, 2:7] = [0.4, np.cos(0.6), np.sin(0.6), 0.0, 0.0]  # rolled by 1.2 rad
    kd = SafetyConfig().damping_kd
    session = stage.session(
        Plan(np.zeros((4, 2, 3)), start=start, terminations=(), braking=Braking(SafetyConfig().tilt, kd))
    )
    plant = session.core.plant
    seen: list[tuple[np.ndarray, np.ndarray]] = []  # before each physics step: speeds, and the torques of the last one
    plant.observer = lambda target: seen.append((plant.qd.numpy().copy(), plant.torque.numpy().copy()))
    session.run(4)
    assert len(seen) == 16
    peak = robot.per_joint(robot.EFFORT_LIMIT)
    speeds, torques = np.array([qd for qd, _ in seen[:-1]]), np.array([torque for _, torque in seen[1:]])
    np.testing.assert_allclose(torques[:, 1], np.clip(-kd * speeds[:, 1], -peak, peak))
    assert np.abs(torques[:, 0] + kd * speeds[:, 0]).max() > 1.0
    assert session.brake is not None
    assert session.brake.since.tolist() == [np.inf, 0.0]
    assert session.brake.joint_speed[0] == 0.0 < session.brake.joint_speed[1]  # of those that brake alone


def test_a_stance_does_not_get_up_and_a_robot_on_its_feet_did_not_lie(result: Result, stage: Stage) -> None:
    lying = [r for r in result.played.rows if r["case"] != "pushed"]
    assert {r["case"] for r in lying} == {"side", "back"}
    assert any(r["lay"] for r in lying)
    assert all(r["stood"] is None for r in lying if not r["lay"])
    assert not any(r["stood"] for r in lying if r["case"] == "back" and r["lay"])
    assert all(r["torque_share"] > 0.0 < r["joint_speed"] for r in lying)


def test_who_is_pushed_over_brakes_and_comes_to_rest(result: Result, stands: PolicyAgent) -> None:
    pushed = [r for r in result.played.rows if r["case"] == "pushed"]
    assert all(r["toppled"] and r["fell"] and r["rested"] for r in pushed)
    assert all(0.2 < r["sink"] < 4.0 and 0.0 < r["rest_s"] < 3.0 for r in pushed)
    assert all(0.4 < r["moving_s"] < 1.5 for r in pushed)  # until the fall
    gently = selected("recover", "robots=2", "push.impulse=0.1", *SHORT)
    still = [r for r in play(gently, stands, Rates(seed=1)).played.rows if r["case"] == "pushed"]
    assert not any(r["toppled"] or r["rested"] for r in still)


SHORT = (*("settle_s=0.1", "seconds=0.1", "push.after_s=0.1", "brake.seconds=0.3", "noise=false", "randomize=false"),)


def test_never_is_a_tilt_that_nothing_exceeds(stage: Stage) -> None:
    start = np.r_[0.0, 0.0, 0.3, 0.0, 1.0, 0.0, 0.0, robot.NOMINAL_STANCE][None]
    session = stage.session(Plan(np.zeros((2, 1, 3)), start=start, terminations=(), braking=Braking(NEVER, 2.0)))
    session.run(2)
    assert session.brake is not None
    assert session.brake.since.isinf().all()
    assert session.brake.torque_share[0] > 0.0
