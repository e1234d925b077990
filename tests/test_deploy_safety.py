"""The runtime's safety and loop: every fault is injected and leads to damping; deadlines are counted as by hand."""

from __future__ import annotations

import dataclasses
import gc
import math
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from go1exp import robot
from go1exp.deploy.runtime import loop as loop_module
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.controller import STAND_KD, STAND_KP, Controller, Cycle, Estimator, Stages
from go1exp.deploy.runtime.loop import Deadlines, MonotonicClock, Timing, run
from go1exp.deploy.runtime.metadata import Port
from go1exp.deploy.runtime.safety import RULES, Safety, SafetyConfig, sdk_range, tilt_angle
from go1exp.robot.messages import LowCmd, LowState
from tests.made import FakeLink, at, low_cmd, low_state

NOMINAL = robot.NOMINAL_STANCE
LIMIT = robot.per_joint(robot.EFFORT_LIMIT)
KP, KD = np.full(12, 20.0), np.full(12, 0.5)


def make_safety(**changes: float) -> Safety:
    return Safety(robot.JOINTS, robot.JOINT_POS_LIMITS, LIMIT, SafetyConfig(**changes))  # type: ignore[arg-type]


def leaning(angle: float, axis: Sequence[float] = (0.6, 0.8, 0.0)) -> np.ndarray:
    return np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.asarray(axis))])


# ---------------------------------------------------------------------- faults

SOUND = low_state()
JUST_RIGHT: dict[str, tuple[LowState, LowCmd, float]] = {
    "stale_state": (low_state(0.0), low_cmd(), 0.0299),
    "not_finite": (low_state(joint_vel=np.full(12, 20.0)), low_cmd(), 0.0),
    "attitude": (low_state(imu_quat=np.array([1.049, 0, 0, 0])), low_cmd(), 0.0),
    "tilt": (low_state(imu_quat=leaning(0.999)), low_cmd(), 0.0),
    # The second one is beyond the SDK's range of targets, which is no stop.
    "joint_range": (low_state(joint_pos=at(at(NOMINAL, 0, 0.863 + 0.086), 1, 4.0)), low_cmd(), 0.0),
    "torque": (low_state(joint_torque=at(np.zeros(12), 5, -1.19 * 35.55)), low_cmd(), 0.0),
    "power": (low_state(joint_torque=np.full(12, 20.0), joint_vel=np.full(12, 499 / 240)), low_cmd(), 0.0),
}
FAULTS: dict[str, list[tuple[LowState, LowCmd, float, str]]] = {
    "stale_state": [(low_state(0.0), low_cmd(), 0.0301, "the newest state is 30 ms old")],
    "not_finite": [
        (low_state(0.0, **{name: at(getattr(SOUND, name), 2, value)}), low_cmd(), 0.0, f"{name} of")
        for name in ("joint_pos", "joint_vel", "joint_torque", "imu_quat", "imu_gyro", "imu_acc")
        for value in (np.nan, np.inf)
    ]
    + [
        (low_state(), low_cmd(**{name: at(NOMINAL, 4, np.nan)}), 0.0, f"{name} of FL_thigh is nan")
        for name in ("joint_target", "kp", "kd")
    ],
    "attitude": [
        (low_state(imu_quat=np.zeros(4)), low_cmd(), 0.0, "length is 0.000 instead of 1"),
        (low_state(imu_quat=np.array([1.06, 0, 0, 0])), low_cmd(), 0.0, "length is 1.060"),
    ],
    "tilt": [
        (low_state(imu_quat=leaning(1.01, axis)), low_cmd(), 0.0, "tilt 58 deg, the limit is 57 deg")
        for axis in ((1, 0, 0), (0, 1, 0), (0, -1, 0), (0.6, -0.8, 0))
    ]
    + [(low_state(imu_quat=leaning(math.pi)), low_cmd(), 0.0, "tilt 180 deg")],
    "joint_range": [
        (low_state(joint_pos=at(NOMINAL, 0, 0.863 + 0.088)), low_cmd(), 0.0, "FR_hip is at 0.951 rad, 0.088"),
        (low_state(joint_pos=at(NOMINAL, 11, -2.818 - 0.1)), low_cmd(), 0.0, "RL_calf is at -2.918 rad, 0.100"),
    ],
    "torque": [
        (low_state(joint_torque=at(np.zeros(12), 5, -1.21 * 35.55)), low_cmd(), 0.0, "FL_calf reports -43.0 N m")
    ],
    "power": [
        (low_state(joint_torque=np.full(12, 20.0), joint_vel=np.full(12, 501 / 240)), low_cmd(), 0.0, "501 W"),
        # A joint that brakes does not make good for one that drives.
        (
            low_state(joint_torque=np.array([20.0, -20.0] * 6), joint_vel=np.full(12, 2.1)),
            *(low_cmd(), 0.0, "power is 504 W, the limit is 500 W"),
        ),
    ],
}
COUNTED = ("torque", "power")


def cycles(name: str) -> int:
    return SafetyConfig().count if name in COUNTED else 1


CASES = [(name, *case) for name, cases in FAULTS.items() for case in cases]


@pytest.mark.parametrize(("name", "state", "command", "now", "message"), CASES, ids=[f"{c[0]}: {c[4]}" for c in CASES])
def test_a_fault_is_named_and_the_drives_brake_from_then_on(
    name: str, state: LowState, command: LowCmd, now: float, message: str
) -> None:
    safety = make_safety()
    for _ in range(cycles(name) - 1):
        assert not safety.review(state, command, now).damping
    sent = safety.review(state, command, now)
    assert safety.fault is not None
    assert (safety.fault.name, safety.fault.t) == (name, now)
    assert message in safety.fault.message
    for later in (sent, safety.review(low_state(now), low_cmd(), now)):
        assert later.damping
        assert (later.kp == 0).all()
        assert (later.kd == SafetyConfig().damping_kd).all()
        assert np.isfinite(later.joint_target).all()
    assert safety.fault.name == name  # the first one stays


@pytest.mark.parametrize("name", JUST_RIGHT)
def test_just_within_a_limit_nothing_happens(name: str) -> None:
    safety = make_safety()
    for _ in range(20):
        sent = safety.review(*JUST_RIGHT[name])
        assert not sent.damping
    assert safety.fault is None


def test_every_rule_is_tried() -> None:
    assert {*FAULTS, "operator_stop"} == set(RULES)
    assert {*JUST_RIGHT, "operator_stop"} == set(RULES)


def test_a_stop_acts_in_the_next_cycle_and_comes_first() -> None:
    safety = make_safety()
    assert not safety.review(low_state(), low_cmd(), 0.0).damping
    safety.stop("SIGINT")
    assert safety.review(low_state(imu_quat=np.zeros(4)), low_cmd(), 1.0).damping
    assert str(safety.fault) == "operator_stop at 1.000 s: requested by SIGINT"


@pytest.mark.parametrize("name", COUNTED)
def test_a_spike_is_forgiven_and_a_burst_is_not(name: str) -> None:
    """The SDK's counter: up while over the limit, down while not; alternation never trips it, two of three do."""
    bad, command, now, _ = FAULTS[name][0]
    alternating, mostly = make_safety(), make_safety()
    for _ in range(100):
        alternating.review(bad, command, now)
        alternating.review(low_state(), command, now)
    assert alternating.fault is None
    for k in range(100):
        mostly.review(low_state() if k % 3 == 2 else bad, command, now)
    assert mostly.fault is not None
    assert mostly.fault.name == name


def test_before_the_first_state_and_without_a_command_the_drives_brake() -> None:
    safety = make_safety()
    assert safety.review(None, None, 5.0).damping
    assert safety.review(None, low_cmd(), 5.0).damping
    assert safety.review(low_state(), None, 0.0).damping
    assert safety.fault is None


def test_a_fault_found_elsewhere_counts_too_and_the_first_stays() -> None:
    safety = make_safety()
    safety.fail("estimator", "diverged", 1.0)
    safety.fail("command", "late", 2.0)
    assert safety.review(low_state(), low_cmd(), 2.0).damping
    assert str(safety.fault) == "estimator at 1.000 s: diverged"


def test_lean_is_the_angle_to_the_vertical_whatever_the_heading() -> None:
    for angle in (0.0, 0.3, 1.5, 3.0):
        yaw = np.array([math.cos(0.7), 0, 0, math.sin(0.7)])
        w, x, y, z = leaning(angle)
        turned = np.array(
            [yaw[0] * w - yaw[3] * z, yaw[0] * x - yaw[3] * y, yaw[0] * y + yaw[3] * x, yaw[0] * z + yaw[3] * w]
        )
        for length in (0.95, 1.0, 1.05):
            assert tilt_angle(length * turned) == pytest.approx(angle, abs=1e-7)


# ---------------------------------------------------------------------- what is cut


def test_targets_are_cut_to_the_sdks_range_and_the_stops() -> None:
    assert sdk_range(robot.JOINTS).tolist() == [[-1.047, 1.047], [-0.663, 2.966], [-2.721, -0.837]] * 4
    safety = make_safety()
    for ask, expected in ((9.0, [0.863, 2.966, -0.888]), (-9.0, [-0.863, -0.663, -2.721])):
        near = low_state(joint_pos=np.tile(expected, 4))  # so that the torque limit does not act
        sent = safety.review(near, low_cmd(joint_target=np.full(12, ask)), 0.0)
        np.testing.assert_allclose(sent.joint_target, np.tile(expected, 4), atol=1e-12)
        assert not sent.damping
    assert (safety.clamped == 2).all()


def test_targets_are_cut_to_the_peak_torque() -> None:
    safety, rng = make_safety(), np.random.default_rng(0)
    for _ in range(200):
        q = rng.uniform(*robot.JOINT_POS_LIMITS.T)
        qd = rng.uniform(-5, 5, 12)
        command = low_cmd(joint_target=rng.uniform(-3, 3, 12), kp=np.full(12, 60.0))
        sent = safety.limited(low_state(joint_pos=q, joint_vel=qd), command)
        torque = 60.0 * (sent.joint_target - q) - 0.5 * qd
        inside = (sent.joint_target > safety._low) & (sent.joint_target < safety._high)
        assert (np.abs(torque)[inside] <= LIMIT[inside] + 1e-9).all()
        low, high = robot.JOINT_POS_LIMITS.T
        assert ((sent.joint_target >= low) & (sent.joint_target <= high)).all()
        same = sent.joint_target == command.joint_target
        asked = 60.0 * (command.joint_target - q) - 0.5 * qd
        fine = (np.abs(asked) < LIMIT) & (command.joint_target > safety._low) & (command.joint_target < safety._high)
        assert (same | ~fine).all()


def test_torque_that_is_fed_forward_is_cut_too_and_counts_in_what_targets_need() -> None:
    safety = make_safety()
    fed = np.full(12, 100.0)
    sent = safety.review(low_state(), low_cmd(kp=np.zeros(12), feedforward=fed), 0.0)
    assert sent.feedforward is not None
    np.testing.assert_allclose(sent.feedforward, LIMIT)
    assert (sent.joint_target == NOMINAL).all()  # nothing is divided by a gain of zero
    for torque, ask in ((10.0, 0.5), (10.0, -0.3), (-20.0, -0.5), (0.0, 0.1)):
        command = low_cmd(joint_target=NOMINAL + ask, feedforward=np.full(12, torque))
        sent = safety.review(low_state(), command, 0.0)
        asked = np.clip(KP * ask + torque, -LIMIT, LIMIT)
        inside = (sent.joint_target > safety._low) & (sent.joint_target < safety._high)
        found = KP * (sent.joint_target - NOMINAL) + torque
        np.testing.assert_allclose(found[inside], asked[inside], atol=1e-9)
    spoilt = low_cmd(feedforward=at(np.zeros(12), 4, np.nan))
    assert safety.review(low_state(), spoilt, 0.0).damping
    assert safety.fault is not None
    assert safety.fault.message == "feedforward of FL_thigh is nan"


# ---------------------------------------------------------------------- the controller


class FakePolicy:
    """Answers with its command, as an action for every joint."""

    sizes = {"base_lin_vel_b": 3, "command": 3, "walked": 1}  # noqa: RUF012
    sizes |= dict.fromkeys(("joint_pos", "previous_action", "lowest_action", "highest_action"), 12)
    inputs = tuple(Port(name, size, "", "", "") for name, size in sizes.items())

    def __init__(self) -> None:
        self.calls: list[dict[str, np.ndarray]] = []

    def __call__(self, readings: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self.calls.append({name: values.copy() for name, values in readings.items()})
        action = np.repeat(readings["command"][:, :1], 12, axis=1)
        target = np.asarray(NOMINAL, np.float32) + 0.1 * action
        return {"joint_target": target, "observation": readings["joint_pos"], "action": action}


class Velocity(Estimator):
    """An estimator that counts."""

    def __init__(self, fails_at: int = 10**9, how: str = "nan") -> None:
        self.count, self._fails_at, self._how = 0, fails_at, how

    def update(self, state: LowState) -> np.ndarray:
        self.count += 1
        if self.count >= self._fails_at and self._how == "raise":
            raise FloatingPointError("singular")
        return self.ahead(0.0)

    def ahead(self, age: float) -> np.ndarray:
        return np.array([math.nan if self.count >= self._fails_at else self.count, 0.0, 0.0])


def always(cycle: int) -> Sequence[LowState]:
    """Five states in each cycle of 10 ms."""
    return [low_state(0.01 * cycle - 0.002 * k) for k in (4, 3, 2, 1, 0)]


def controller(
    script: Callable[[int], Sequence[LowState]] = always,
    commands: Callable[[float], np.ndarray] = lambda t: np.array([0.3, 0.0, 0.0]),
    estimator: Velocity | None = None,
    **settings: Any,
) -> SimpleNamespace:
    link, policy, log = FakeLink(script), FakePolicy(), list[Cycle]()
    ports = {"inputs": policy.inputs, "observation": (), "joints": robot.JOINTS}
    about = SimpleNamespace(kp=tuple(KP), kd=tuple(KD), nominal_stance=tuple(NOMINAL), policy_dt=0.04, **ports)
    bundle = cast(Bundle, SimpleNamespace(metadata=about, policy=policy))
    usual: dict[str, Any] = {"rate": 25.0, "on_cycle": log.append}
    times = {"stand_up": 0.1, "hand_over": 0.0, "lie_down": 0.0, "brake": 0.045}
    times |= {field.name: settings.pop(field.name) for field in dataclasses.fields(Stages) if field.name in settings}
    usual["stages"] = Stages(**times)
    made = Controller(bundle, link, commands, estimator or Velocity(), make_safety(), **{**usual, **settings})

    def run_cycles(cycles: int, start: int = 0) -> list[bool]:
        return [made.cycle(0.01 * k) for k in range(start, start + cycles)]

    return SimpleNamespace(it=made, link=link, policy=policy, log=log, run_cycles=run_cycles, safety=made.safety)


def test_a_robot_stands_up_and_then_walks() -> None:
    lying = at(NOMINAL, 1, 1.1)

    def script(cycle: int) -> Sequence[LowState]:
        return [low_state(0.01 * cycle, joint_pos=lying if cycle < 13 else NOMINAL)] if cycle >= 3 else []

    made = controller(script)
    assert all(made.run_cycles(30))
    assert [c.phase for c in made.log] == ["waiting"] * 3 + ["standing_up"] * 10 + ["walking"] * 17
    assert [c.command is None for c in made.log] == [True] * 3 + [False] * 27  # nothing is sent to who says nothing
    thighs = [c.command.joint_target[1] for c in made.log[3:13]]
    np.testing.assert_allclose(thighs, 1.1 + (NOMINAL[1] - 1.1) * np.arange(10) / 10, atol=1e-9)
    assert [(*{*c.kp}, *{*c.kd}) for c in made.link.sent] == [(STAND_KP, STAND_KD)] * 10 + [(20.0, 0.5)] * 17
    np.testing.assert_allclose(made.link.sent[-1].joint_target[0], NOMINAL[0] + 0.03, atol=1e-6)
    actions = [readings["previous_action"][0, 0] for readings in made.policy.calls]
    np.testing.assert_allclose(actions, [0.0] + [0.3] * 16, atol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"joint_pos": at(NOMINAL, 8, NOMINAL[8] - 0.6)}, r"in 3\.1 s: RR_calf is -0\.60 rad off \(at most 0\.15\)"),
        ({"imu_quat": leaning(0.5)}, r"in 3\.1 s: tilt 29 deg \(at most 20\)"),
    ],
)
def test_a_stance_that_is_not_reached_is_a_fault_that_names_what_is_not(wrong: dict[str, Any], message: str) -> None:
    made = controller(lambda cycle: [low_state(0.01 * cycle, **wrong)])
    made.run_cycles(330)
    assert "walking" not in {c.phase for c in made.log}
    assert made.safety.fault is not None
    assert made.safety.fault.name == "stand_up"
    assert re.search(message, made.safety.fault.message)
    assert made.link.sent[-1].damping


def test_in_the_hand_over_torques_go_from_the_stance_to_the_policy_without_a_jump() -> None:
    """Torque at a share s: (1 - s) of that of the stance, s of the policy's, which is commanded to stand."""
    sagging = at(NOMINAL, 8, NOMINAL[8] - 0.1)
    made = controller(lambda cycle: [low_state(0.01 * cycle, joint_pos=sagging)], hand_over=0.1)
    made.run_cycles(35)
    assert [c.phase for c in made.log] == ["standing_up"] * 10 + ["handing_over"] * 10 + ["walking"] * 15
    for k, cycle in enumerate(made.log[10:20]):
        assert cycle.command is not None
        torque = cycle.command.kp * (cycle.command.joint_target - sagging)
        np.testing.assert_allclose(torque, (STAND_KP + k / 10 * (20.0 - STAND_KP)) * (NOMINAL - sagging), atol=1e-5)
        assert cycle.command.kd[0] == pytest.approx(STAND_KD + k / 10 * (0.5 - STAND_KD))
        assert not cycle.velocity.any()


def test_the_estimator_gets_every_state_once_and_the_policy_the_newest_estimate() -> None:
    made = controller()
    made.run_cycles(20)
    assert made.it._estimator.count == 100
    assert [readings["base_lin_vel_b"][0, 0] for readings in made.policy.calls] == [5.0 * k for k in range(11, 21)]


def test_at_another_rate_the_policy_gets_mean_lowest_and_highest_action_of_a_training_period() -> None:
    waving = lambda t: np.array([np.sin(40.0 * t), 0.0, 0.0])  # noqa: E731
    made = controller(commands=waving, rate=100.0)  # 4 cycles in a training period
    made.run_cycles(30)
    actions = [float(readings["command"][0, 0]) for readings in made.policy.calls]  # what ``FakePolicy`` answers with
    previous = [float(readings["previous_action"][0, 0]) for readings in made.policy.calls]
    periods = [([0.0] * 4 + actions)[k : k + 4] for k in range(len(actions))]
    np.testing.assert_allclose(previous, np.mean(periods, axis=1), rtol=1e-5, atol=1e-6)
    for name, of in (("lowest_action", np.min), ("highest_action", np.max)):
        np.testing.assert_array_equal([float(r[name][0, 0]) for r in made.policy.calls], of(periods, axis=1))


def test_a_rehearsal_leaves_no_trace() -> None:
    beyond = lambda t: np.array([9.0, 0.0, 0.0])  # targets 0.9 rad off, which are cut  # noqa: E731
    plain, rehearsed = controller(commands=beyond), controller(commands=beyond)
    for k in range(30):
        asked = len(rehearsed.policy.calls)
        rehearsed.it.rehearse()
        assert len(rehearsed.policy.calls) - asked == (rehearsed.it.phase == "walking")  # and nothing before it
        plain.run_cycles(1, k)
        rehearsed.run_cycles(1, k)
    assert rehearsed.safety.clamped.any()
    assert (rehearsed.safety.clamped == plain.safety.clamped).all()
    assert len(rehearsed.link.sent) == len(plain.link.sent) == 30
    for one, other in zip(rehearsed.link.sent, plain.link.sent, strict=True):
        assert (one.joint_target == other.joint_target).all()


def test_states_that_are_taken_before_their_cycle_count_once_and_in_order() -> None:
    plain, early = controller(), controller()
    states: list[list[float]] = []
    early.it._on_cycle = lambda cycle: states.append([state.t for state in cycle.fresh])
    for k in range(20):
        plain.run_cycles(1, k)
        early.link.script = lambda _, k=k: always(k)[:3]
        early.it.prepare()
        early.link.script = lambda _, k=k: always(k)[3:]
        early.run_cycles(1, k)
    assert states == [[state.t for state in always(k)] for k in range(20)]
    assert early.it._estimator.count == plain.it._estimator.count == 100
    for one, other in zip(early.link.sent, plain.link.sent, strict=True):
        assert (one.joint_target == other.joint_target).all()


def test_what_fails_before_a_cycle_is_a_fault_in_it() -> None:
    made = controller(estimator=Velocity(fails_at=90, how="raise"))
    for k in range(30):
        if made.it.phase == "walking":
            made.it.prepare()
        made.run_cycles(1, k)
    assert made.safety.fault is not None
    assert (made.safety.fault.name, made.safety.fault.message) == ("runtime", "FloatingPointError: singular")
    assert made.link.sent[-1].damping


def test_the_reach_of_a_target_follows_the_gains() -> None:
    safety, far = make_safety(), low_cmd(joint_target=at(NOMINAL, 0, NOMINAL[0] + 9.0))
    fresh = [make_safety().review(low_state(), dataclasses.replace(far, kp=f * KP), 0.0) for f in (1, 50)]
    kept = [safety.review(low_state(), dataclasses.replace(far, kp=f * KP), 0.0) for f in (1, 50, 1)]
    assert [k.joint_target[0] for k in kept[:2]] == [f.joint_target[0] for f in fresh]
    assert kept[2].joint_target[0] == kept[0].joint_target[0] != kept[1].joint_target[0]
    moving, thigh = low_state(joint_vel=np.full(12, 5.0)), low_cmd(joint_target=at(NOMINAL, 1, 9.0))
    damped = dataclasses.replace(thigh, kd=4.0 * KD)  # at the same kp
    asked = ((safety, thigh), (safety, damped), (make_safety(), damped))
    first, other, alone = (s.review(moving, command, 0.0).joint_target[1] for s, command in asked)
    assert other == alone != first


def test_a_gait_clock_and_the_command_source_are_told_the_time_since_walking_began() -> None:
    asked: list[float] = []
    made = controller(commands=lambda t: asked.append(t) or np.zeros(3))  # type: ignore[func-returns-value]
    made.run_cycles(30)
    walking = [cycle.t for cycle in made.log if cycle.phase == "walking"]
    assert walking[0] == pytest.approx(0.1)
    np.testing.assert_allclose(asked, np.array(walking) - walking[0], atol=1e-9)
    np.testing.assert_allclose([readings["walked"][0, 0] for readings in made.policy.calls], asked, atol=1e-6)


def odd_from(cycle: int, **changes: Any) -> Callable[[int], Sequence[LowState]]:
    return lambda k: [low_state(0.01 * k, **changes)] if k >= cycle else always(k)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("no_state", {"script": lambda k: [], "patience": 0.15}),
        ("stale_state", {"script": lambda k: always(k) if k < 17 else []}),
        ("not_finite", {"script": odd_from(20, joint_vel=at(np.zeros(12), 3, np.nan))}),
        ("tilt", {"script": odd_from(20, imu_quat=leaning(1.2))}),
        ("torque", {"script": odd_from(15, joint_torque=at(np.zeros(12), 0, 40.0))}),
        ("estimator", {"estimator": Velocity(101)}),
        ("runtime", {"estimator": Velocity(101, "raise")}),
        ("command", {"commands": lambda t: np.full(3, np.nan if t > 0.095 else 0.0)}),
        ("runtime", {"commands": lambda t: np.zeros(3) if t < 0.095 else 1 / 0}),
    ],
)
def test_whatever_goes_wrong_while_walking_the_robot_brakes_and_the_loop_ends(
    name: str, settings: dict[str, Any]
) -> None:
    made = controller(**settings)
    going = made.run_cycles(30)
    fault = made.safety.fault
    assert fault is not None
    assert fault.name == name
    last = next(k for k, c in enumerate(made.log) if c.phase == "damping")
    assert fault.t == pytest.approx(0.01 * last)
    assert 14 <= last <= 21
    assert all(c.command.damping and (c.command.kp == 0).all() for c in made.log[last:])
    assert not any(c.command.damping for c in made.log[:last] if c.command is not None)
    assert going == [True] * (last + 5) + [False] * (30 - last - 5)  # braking goes on for a while


def test_a_fault_while_lying_down_is_the_end_and_no_orderly_one() -> None:
    made = controller(odd_from(22, imu_quat=leaning(1.2)), lie_down=0.2)
    made.run_cycles(20)
    made.it.finish(0.2)
    made.run_cycles(30, 20)
    assert [c.phase for c in made.log[20:]] == ["lying_down"] * 2 + ["damping"] * 28
    assert made.safety.fault is not None
    assert not made.it.finished


def test_of_the_states_of_a_cycle_the_newest_by_the_robots_clock_counts() -> None:
    def script(cycle: int) -> Sequence[LowState]:
        first, overtaken = (low_state(0.01 * cycle, clock=0.01 * cycle - late) for late in (0.0, 0.002))
        return [first, overtaken]

    made = controller(script)
    made.run_cycles(20)
    assert [c.state.clock for c in made.log] == [0.01 * k for k in range(20)]


def test_a_stop_before_the_robot_has_said_anything_ends_the_loop() -> None:
    made = controller(lambda k: [])
    made.run_cycles(2)
    made.safety.stop("a key")
    assert made.run_cycles(1, 2) == [True]
    assert made.it.phase == "damping"
    assert made.link.sent[-1].damping


def test_times_of_a_walk_that_cannot_be_are_refused_together() -> None:
    with pytest.raises(ValueError, match="must be") as error:
        Stages(stand_up=-1.0, patience=0.0)
    assert str(error.value).split("\n") == [
        "stand_up = -1.0: must be at least 0",
        "patience = 0.0: must be greater than 0",
    ]


def test_gains_that_nobody_knows_have_to_be_given() -> None:
    ports = {"inputs": FakePolicy().inputs, "observation": (), "joints": robot.JOINTS}
    about = SimpleNamespace(kp=None, kd=None, nominal_stance=tuple(NOMINAL), policy_dt=0.02, **ports)
    bundle = cast(Bundle, SimpleNamespace(metadata=about, policy=FakePolicy()))
    arguments = (FakeLink(always), lambda t: np.zeros(3), Velocity(), make_safety())
    with pytest.raises(ValueError, match="kp, kd: the bundle has none"):
        Controller(bundle, *arguments)
    assert Controller(bundle, *arguments, kp=KP, kd=KD).cycle(0.0)


# ---------------------------------------------------------------------- the loop


class FakeClock(MonotonicClock):
    """Time that passes only while somebody works or sleeps; a sleeper wakes ``late`` s after the time."""

    def __init__(self, late: Callable[[int], float] = lambda sleep: 0.0) -> None:
        self.t, self._late, self._sleeps = 100.0, late, 0

    def now(self) -> float:
        return self.t

    def sleep_until(self, when: float) -> None:
        if when > self.t:
            self.t = when + self._late(self._sleeps)
        self._sleeps += 1


def played(work_ms: Sequence[float], rate: float = 100.0, **settings: Any) -> tuple[list[float], Timing]:
    """Run a loop whose cycles work for the given times; return when they started, in ms, and the account."""
    clock, starts = FakeClock(**settings), list[float]()

    def work(now: float) -> bool:
        starts.append(round(1e3 * (now - 100.0), 6))
        clock.t += 1e-3 * work_ms[len(starts) - 1]
        return len(starts) < len(work_ms)

    return starts, run(work, rate, clock=clock)


@pytest.mark.parametrize(
    ("work", "late", "starts", "missed", "figures"),
    [
        ([1.0, 9.0, 3.0, 9.9, 0.0], 0.0, [0.0, 10.0, 20.0, 30.0, 40.0], (0, 0), {"work_p50": 0.003}),
        ([1.0, 12.0, 1.0, 1.0], 0.0, [0.0, 10.0, 22.0, 30.0], (1, 0), {"start_delay_worst": 0.002}),
        # The second cycle is done at 45 ms: its own deadline and those of the two after it are missed.
        ([1.0, 35.0, 1.0, 1.0], 0.0, [0.0, 10.0, 45.0, 50.0], (3, 2), {"missed_share": 3 / 6}),
        ([1.0] * 5, 0.004, [0.0, 14.0, 20.0, 30.0, 40.0], (0, 0), {"start_delay_worst": 0.004}),
    ],
)
def test_a_loop_keeps_its_phase_and_counts_what_is_late_or_left_out(
    work: list[float], late: float, starts: list[float], missed: tuple[int, int], figures: dict[str, float]
) -> None:
    found, timing = played(work, late=lambda sleep: late if sleep == 1 else 0.0)
    assert found == starts
    assert (timing.cycles, timing.missed, timing.left_out) == (len(work), *missed)
    worst = {"period_p50": 0.01, "period_worst": 1e-3 * max(np.diff(starts)), "work_worst": 1e-3 * max(work)}
    for name, value in {**figures, **worst}.items():
        assert getattr(timing, name) == pytest.approx(value)
    assert str(timing).startswith(f"{len(work)} cycles; period p50 10.000, p99 ")
    assert f"missed {missed[0]} (" in str(timing)


def test_a_loop_ends_with_its_time_however_late_it_is() -> None:
    clock = FakeClock()
    starts: list[float] = []

    def work(now: float) -> bool:
        starts.append(now)
        clock.t += 0.025
        return True

    timing = run(work, 100.0, seconds=0.1, clock=clock)
    assert starts[-1] < 100.1
    assert timing.cycles + timing.left_out == 10
    assert timing.missed == 10


def test_percentiles_are_numpys_and_the_oldest_cycles_are_forgotten() -> None:
    account, rng = Deadlines(0.01, kept=50), np.random.default_rng(0)
    starts, ends = np.cumsum(rng.uniform(0.009, 0.011, 80)), []
    for start in starts:
        ends.append(start + rng.uniform(0.0, 0.005))
        account.note(start, start, ends[-1], 0)
    timing = account.timing()
    periods = np.array([b - a for a, b in pairwise(starts)])
    work = np.array(ends) - starts
    np.testing.assert_allclose([timing.period_p50, timing.period_p99], np.percentile(periods[-50:], [50, 99]))
    np.testing.assert_allclose([timing.work_p50, timing.work_p99], np.percentile(work[-50:], [50, 99]))
    assert timing.period_worst == pytest.approx(periods.max())
    assert timing.cycles == 80


def test_reports_come_about_every_second() -> None:
    clock, reported = FakeClock(), list[int]()
    run(lambda now: True, 10.0, seconds=3.5, clock=clock, on_report=lambda t: reported.append(t.cycles))
    assert reported == [11, 21, 31]


def test_the_percentiles_of_a_report_are_over_the_newest_cycles_alone() -> None:
    """Those over all take longer than a cycle, every second, once a walk has lasted for minutes."""
    clock, reported = FakeClock(), list[float]()

    def work(now: float) -> bool:
        clock.t += 0.005 if now < 120.0 else 0.001
        return True

    timing = run(work, 100.0, seconds=40.0, clock=clock, on_report=lambda t: reported.append(t.work_p99))
    assert reported[0] == pytest.approx(0.005)
    assert reported[-1] == pytest.approx(0.001)
    assert timing.work_p99 == pytest.approx(0.005)


def test_the_collector_is_off_in_the_loop_and_back_after_it() -> None:
    readings: list[bool] = []

    def work(now: float) -> bool:
        readings.append(gc.isenabled())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(work, 100.0, clock=FakeClock())
    assert readings == [False]
    assert gc.isenabled()


def test_before_a_cycle_there_is_one_rehearsal_unless_it_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    now, slept, rehearsed = [0.0], list[float](), list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    def perf_counter() -> float:
        now[0] += 1e-5
        return now[0]

    monkeypatch.setattr(loop_module, "time", SimpleNamespace(sleep=sleep, perf_counter=perf_counter))
    clock = MonotonicClock(0.001, lambda: rehearsed.append(now[0]))
    clock.sleep_until(0.01)
    assert slept == pytest.approx([0.009], abs=1e-4)
    assert rehearsed == pytest.approx([0.009], abs=1e-4)
    assert 0.01 <= now[0] < 0.0101
    clock.sleep_until(0.01)  # that has passed
    assert len(rehearsed) == 1
    now[0] = 0.0195
    clock.sleep_until(0.02)  # too late to sleep, but not to rehearse
    assert len(slept) == 1
    assert len(rehearsed) == 2


def test_real_time_passes_at_the_rate() -> None:
    """No bound on lateness: the machine may be busy. But no cycle comes early, and the average is held."""
    starts: list[float] = []
    run(lambda now: starts.append(now) or True, 200.0, seconds=0.25, clock=MonotonicClock(spin=0.0002))  # type: ignore[func-returns-value]
    due = starts[0] + np.arange(len(starts)) / 200.0
    assert len(starts) <= 50
    assert (np.array(starts) >= due - 1e-3).all()
