"""The runtime as a whole: datagrams, the simulated robot, commands, estimate, log, the verb, and every fault."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest

from go1exp import cli, robot
from go1exp.base.errors import Expected
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.config.schema.registry import ConfigError, Term, members
from go1exp.deploy.estimation import from_json, go1, to_json
from go1exp.deploy.runtime import walk
from go1exp.deploy.runtime.bundle import load
from go1exp.deploy.runtime.commands import (
    CommandConfig,
    CommandError,
    Keyboard,
    Sinusoid,
    Table,
    make,
    parsed,
    range_array,
    stretched,
)
from go1exp.deploy.runtime.controller import LYING, PHASES, STANCE_ERROR, Cycle
from go1exp.deploy.runtime.estimate import BLIND_S, KalmanEstimator, settings
from go1exp.deploy.runtime.job import Job, run_job
from go1exp.deploy.runtime.launch import RefusedError, RobotError
from go1exp.deploy.runtime.log import About, Log
from go1exp.deploy.runtime.report import DONE
from go1exp.deploy.runtime.safety import RULES
from go1exp.deploy.runtime.walk import FAULTS, STATUS, Plan
from go1exp.deploy.sim_robot.__main__ import bundle_task, sim_config
from go1exp.deploy.sim_robot.machine import NOISE, TICK, Robot, turned
from go1exp.deploy.sim_robot.server import TRUTH, Network
from go1exp.evaluate.controller.mpc import Mpc
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller
from go1exp.evaluate.controller.types import Deployed
from go1exp.gap.robots.go1 import suspended
from go1exp.logs import recording
from go1exp.logs.audit import audit
from go1exp.logs.record.motions import played
from go1exp.logs.record.plan import make_motion
from go1exp.logs.recording import VECTORS
from go1exp.robot.go1_fields import JOINTS, MOTOR_NAMES
from go1exp.robot.messages import LowState
from tests.lockstep import BEGIN, Spoil, play
from tests.made import FakeLink, low_cmd, shaking_state
from tests.small_run import SMALL

BUSY = 5.0
"""Age of a state, s, at which a robot counts as lost where real time passes: the machine may be busy."""


def make_state(t: float = 0.0, **changes: Any) -> LowState:
    return shaking_state(abs(int(1e6 * t)), t, **{"clock": t, **changes})


# ---------------------------------------------------------------------- the simulated robot


@pytest.mark.parametrize("start", ["standing", "lying", "suspended"])
def test_a_robot_begins_at_rest(bundle: str, start: str) -> None:
    made = Robot(bundle_task(bundle, {}), sim_config({"start": start, "noise": 0.0}))
    state, true = made.sense()
    assert np.abs(state.joint_vel).max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(state.imu_acc), 9.81, rtol=0.02)
    assert (state.foot_force > 15.0).all() == (start == "standing")
    assert np.isnan(true).all() == (start == "suspended")
    height = {"standing": (0.25, 0.33), "lying": (0.04, 0.1)}.get(start)
    if height:
        assert height[0] < true[2] < height[1]


def test_a_state_is_one_instant_of_the_robot(bundle: str) -> None:
    """Torque = kp (target - q) - kd qd; a new target counts for half of its first tick. The IMU is the trunk's."""
    made = Robot(bundle_task(bundle, {}), sim_config({"noise": 0.0}))
    kp, kd, rng = np.full(12, 35.0), np.full(12, 0.7), np.random.default_rng(0)
    target = robot.NOMINAL_STANCE
    for k in range(50):
        before = target
        if k % 5 == 0:
            target = robot.NOMINAL_STANCE + 0.02 * rng.normal(size=12)
        made.apply(low_cmd(joint_target=target, kp=kp, kd=kd))
        made.step()
        state, true = made.sense()
        torque = kp * (0.5 * (target + before) - state.joint_pos) - kd * state.joint_vel
        np.testing.assert_allclose(state.joint_torque, torque, atol=1e-9)
        np.testing.assert_allclose(state.imu_quat, true[3:7], atol=1e-12)
        np.testing.assert_allclose(state.imu_gyro, true[10:13], atol=1e-12)


def test_noise_is_that_of_table_ii(bundle: str) -> None:
    loud, quiet = (Robot(bundle_task(bundle, {}), sim_config({"noise": noise})) for noise in (1.0, 0.0))
    truth = quiet.sense()[0]
    states = [loud.sense()[0] for _ in range(1000)]
    for name in ("joint_pos", "joint_vel", "imu_gyro"):
        off = np.array([getattr(state, name) for state in states]) - getattr(truth, name)
        assert np.abs(off).max() <= NOISE[name] + 1e-6
        assert np.abs(off).max() > 0.99 * NOISE[name]
        np.testing.assert_allclose(off.std(), NOISE[name] / math.sqrt(3), rtol=0.05)
    quats = np.array([state.imu_quat for state in states])
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-12)
    assert turned(np.array([1.0, 0, 0, 0]), np.array([0.02, 0, 0])) == pytest.approx([1, 0.01, 0, 0], abs=1e-4)


def test_a_network_delays_and_loses() -> None:
    way = Network(0.01, 0.0, np.random.default_rng(0))
    way.put(0.0, b"a")
    way.put(0.002, b"b")
    assert [way.take(t) for t in (0.009, 0.01, 0.011, 0.02)] == [[], [b"a"], [], [b"b"]]
    way = Network(0.0, 0.25, np.random.default_rng(0))
    for k in range(4000):
        way.put(float(k), b"")
    assert len(way.take(1e9)) == 4000 - way.lost
    assert way.lost == pytest.approx(1000, abs=100)


def test_jitter_delays_each_datagram_by_its_own_and_lets_one_overtake_another() -> None:
    way = Network(0.004, 0.0, np.random.default_rng(0), jitter=0.005)
    arrived: dict[int, float] = {}
    for tick in range(4010):
        if tick < 4000:
            way.put(TICK * tick, str(tick).encode())
        arrived |= dict.fromkeys(map(int, way.take(TICK * tick)), TICK * tick)
    late = np.array([arrived[k] - TICK * k for k in range(4000)])
    assert (late.min(), late.max()) == pytest.approx((0.006, 0.010))  # 4 to 9 ms, seen at the next tick
    assert late.mean() == pytest.approx(0.4 * 0.006 + 0.4 * 0.008 + 0.2 * 0.010, abs=2e-4)
    order = np.array(list(arrived))
    assert (np.diff(order) < 0).mean() > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": (*robot.JOINTS[3:6], *robot.JOINTS[:3], *robot.JOINTS[6:])}, "has FL_hip at place 1; the motors"),
        ({"robot": "go2"}, "is for the robot 'go2'; deploy commands a 'go1'"),
        ({"estimator": {"foot_radus": 1}}, r"estimator\.foot_radus: unknown key"),
    ],
    ids=["order", "robot", "estimator"],
)
def test_a_bundle_that_is_not_for_a_go1_never_reaches_its_motors(
    change: dict[str, Any], message: str, bundle: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = load(bundle)
    other = dataclasses.replace(whole, metadata=dataclasses.replace(whole.metadata, **change))
    monkeypatch.setattr("go1exp.deploy.runtime.bundle.load", lambda path: other)
    said: list[str] = []
    with pytest.raises((Expected, ConfigError), match=message):
        run_job(Job(bundle, "sim", Plan(), str(tmp_path / "out")), said.append)
    assert said == []
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(sys, "argv", ["go1exp", "export", "check", bundle])
    assert cli.main() != 0


def test_the_motors_of_the_packets_are_the_joints_of_the_robot() -> None:
    assert (MOTOR_NAMES, len(MOTOR_NAMES)) == (robot.JOINTS, JOINTS)


def test_a_robot_without_gains_is_refused(bundle: str, make_net: Callable[..., Path]) -> None:
    task = bundle_task(bundle, {"actuator": {"term": "net", "file": str(make_net()), "period": "exact"}})
    with pytest.raises(Exception, match=r"actuator = net: has no kp and kd, .*; use actuator=pd"):
        Robot(task, sim_config({}))


def test_a_torque_that_is_fed_forward_moves_a_joint_until_nobody_speaks(bundle: str) -> None:
    one = Robot(bundle_task(bundle, {}), sim_config({"start": "suspended", "noise": 0.0}))
    limp = low_cmd(kp=np.zeros(12), kd=np.zeros(12))
    one.apply(dataclasses.replace(limp, feedforward=np.tile([0.0, 0.0, 5.0], 4)))
    before = one.sense()[0].joint_pos
    for _ in range(20):
        one.step()
    state = one.sense()[0]
    np.testing.assert_allclose(state.joint_torque, np.tile([0.0, 0.0, 5.0], 4))
    assert (state.joint_pos - before).reshape(4, 3)[:, 2].min() > 0.02
    for _ in range(20):
        one.step()
    assert one.braking
    held = one.sense()[0]
    np.testing.assert_allclose(held.joint_torque, -2.0 * held.joint_vel, atol=0.1)
    one.apply(low_cmd())  # whoever speaks again is heard
    assert not one.braking


# ---------------------------------------------------------------------- the whole chain, at a time of its own


def test_a_model_predictive_controller_walks_in_the_runtime(bundle: str, tmp_path: Path) -> None:
    mine = parse_controller(compose("deploy", ["controller=mpc", "bundle=walk.zip"])["controller"])
    assert isinstance(mine, MpcSettings)
    about = {"mover": Deployed(Mpc(mine)), "truth": True}
    done = play(bundle, tmp_path, about=about, rate=1.0 / mine.period, seconds=2.0)
    assert done.output[-1] == "walked for 2.0 s, to the end"
    x, y, _ = done.account["velocity"]["mean"]
    assert (x, y) == (pytest.approx(0.4, abs=0.05), pytest.approx(0.0, abs=0.05))
    assert done.recording.meta.notes.endswith("feed-forward torques are not recorded")


def test_a_walk_from_the_bundle_to_the_recording(bundle: str, tmp_path: Path) -> None:
    done = play(bundle, tmp_path, about={"sim": {"noise": 0.0}, "truth": True})
    assert done.status == 0
    assert done.account["ended"] == "walked to the end"
    assert done.output[-1] == "walked for 1.0 s, to the end"
    assert done.account["walked_s"] == pytest.approx(1.0)
    phases = [PHASES[int(k)] for k in done.cycles["phase"]]
    counts = [phases.count(name) for name in PHASES]
    assert counts[:5] == [1, 10, 0, 50, 0]
    assert counts[5] in (6, 7)  # for 0.1 s, both ends included, if rounding lets them
    assert done.account["timing"]["missed"] == 0
    assert list(done.account["phases"]) == [name for name in PHASES if name not in ("handing_over", "lying_down")]

    r = done.recording
    assert (r.meta.source, r.meta.tool, r.meta.excitation, r.meta.base) == (
        *("simulated", "go1exp deploy"),
        *("policy", "floating"),
    )
    assert (r.meta.kp, r.meta.kd) == ((35.0,) * 12, (0.6875,) * 12)
    assert "torques have steps of 1/256 N m" in r.meta.notes
    assert r.meta.contact == bundle_task(bundle, {}).contact == MUJOCO_CONTACT
    assert r.meta.rate_hz == pytest.approx(500.0)
    assert len(r.t) == 500  # standing up had other gains
    np.testing.assert_allclose(np.diff(r.t), TICK, atol=1e-9)
    # What the log says was in force is what the robot had, tick by tick.
    had = {round(clock / TICK): target for clock, target, _ in done.world.targets}
    targets = np.array([had[round(t / TICK)] for t in r.t])
    assert r.joint("q_target").tobytes() == targets.tobytes()
    # The packets' steps: 1/256 N m, and 0.7 N m s/rad becomes 0.6875.
    torque = r.joint("tau_est") * 256
    np.testing.assert_allclose(torque, np.rint(torque), atol=1e-9)
    half = 0.5 * (targets[1:] + targets[:-1])
    made = 35.0 * (half - r.joint("q")[1:]) - 0.6875 * r.joint("qd")[1:]
    np.testing.assert_allclose(r.joint("tau_est")[1:], made, atol=1 / 256 + 1e-4)
    place, speed = r.block(*VECTORS["base_pos"]), r.block(*VECTORS["base_lin_vel"])
    np.testing.assert_allclose(speed[1:-1], (place[2:] - place[:-2]) / (2 * TICK), atol=1e-9)
    assert r.block("base_pos_z_w").min() > 0.2
    velocity = done.account["velocity"]
    assert np.max(velocity["estimate_rmse"]) < 0.05
    assert done.account["estimator"] == {"LATE": 0, "INVALID": 0, "RESTARTED": 0}
    assert done.account["link"]["lost"] == done.account["link"]["foreign"] == 0
    link, there = done.account["link"], done.account["simulated_robot"]
    assert there["heard"] == link["sent"] + link["repeated"] - 1  # the last one arrives after the end
    assert (there["foreign"], link["late"]) == (0, 0)
    # The drives brake at the end, and nobody says otherwise after that.
    assert done.world.robot.braking
    assert done.world.applied[-1].damping


def test_jitter_reorders_and_the_walk_goes_on(bundle: str, tmp_path: Path) -> None:
    done = play(bundle, tmp_path, about={"sim": {"jitter": 0.005, "loss": 0.01}})
    assert done.status == 0
    link, r = done.account["link"], done.recording
    assert link["overtaken"] > 80  # states are 2 ms apart, and come up to 5 ms late
    assert link["late"] <= 2  # those that the very first state had overtaken
    assert link["lost"] > 3
    # The recording has all that came, each once and in the order of the robot's clock.
    steps = np.rint(np.diff(r.t) / TICK)
    np.testing.assert_allclose(np.diff(r.t), steps * TICK, atol=1e-9)
    assert steps.min() == 1
    assert link["lost"] - 3 <= (steps - 1).sum() <= link["lost"]  # some before the first command and while it brakes
    had = {round(clock / TICK): target for clock, target, _ in done.world.targets}
    assert r.joint("q_target").tobytes() == np.array([had[round(t / TICK)] for t in r.t]).tobytes()
    packets = done.account["packets"]
    assert 0.0 <= packets["age"]["p50"] <= packets["age"]["worst"] <= 0.005 + TICK
    assert any("relative to the fastest" in line for line in done.output)


def test_the_log_is_fit_for_gap_and_says_nothing_of_what_it_does_not_know(bundle: str, tmp_path: Path) -> None:
    done = play(bundle, tmp_path, about={"sim": {"noise": 0.1}, "other": {"effect": {"coulomb": {"bound": 0.4}}}})
    assert "coulomb" not in done.recording.meta.notes
    assert not any(name.startswith("base_") for name in done.recording.channels)
    standing = suspended(bundle_task(bundle, {}).robot).suited([done.recording])
    assert standing.flaws(done.recording, audit(done.recording)) == []


def test_the_same_walk_gives_the_same_numbers(bundle: str, tmp_path: Path) -> None:
    one, two = (play(bundle, tmp_path / name, seconds=0.3, about={"sim": {"loss": 0.1}}) for name in ("a", "b"))
    for name, values in one.recording.channels.items():
        assert values.tobytes() == two.recording.channels[name].tobytes(), name
    assert one.account["link"]["lost"] > 5


@pytest.mark.parametrize("rate", [100.0, 200.0, 400.0])
def test_another_rate_is_the_policys(bundle: str, tmp_path: Path, rate: float) -> None:
    done = play(bundle, tmp_path, rate=rate, seconds=0.2)
    assert done.status == 0
    assert done.output[0] == f"note: the policy was trained at 50 Hz and runs at {rate:g} Hz"
    walking = done.cycles["phase"] == PHASES.index("walking")
    assert walking.sum() == round(0.2 * rate)
    assert len(np.unique(done.cycles["q_target"][walking], axis=0)) > 0.9 * walking.sum()


@pytest.mark.parametrize("start", ["lying", "crouched", "sitting"])
def test_a_robot_stands_up_into_the_stance_and_is_handed_over_without_a_jump(
    bundle: str, tmp_path: Path, start: str
) -> None:
    about = {"sim": {"start": start, "noise": 0.0}, "truth": True}
    done = play(bundle, tmp_path, stand_up=1.0, hand_over=0.3, seconds=0.3, about=about)
    assert done.status == 0
    rows = np.array(done.world.server.truth)
    assert rows[0, 1 + TRUTH.index("base_pos_z_w")] < 0.2
    phase = np.array(PHASES)[done.cycles["phase"].astype(int)]
    first = int(np.argmax(phase == "handing_over"))
    assert np.abs(done.cycles["q"][first] - robot.NOMINAL_STANCE).max() <= STANCE_ERROR
    np.testing.assert_allclose(done.cycles["q_target"][first], robot.NOMINAL_STANCE, atol=1e-6)
    stood = done.account["stand_up"]
    assert (stood["seconds"], stood["step"]) == (pytest.approx(1.0, abs=0.03), pytest.approx(0.1, abs=0.1))
    assert any(line.startswith("stood up in 1.0 s, ") for line in done.output)
    heights = done.recording.block("base_pos_z_w")[:, 0]  # under the gains of the recording alone
    assert (heights > 0.22).all()
    r = done.recording
    torque = 35.0 * (r.joint("q_target") - r.joint("q")) - 0.6875 * r.joint("qd")
    assert np.median(np.abs(torque - r.joint("tau_est"))) < 0.02


# ---------------------------------------------------------------------- the end of a walk


def ended(done: SimpleNamespace) -> tuple[float, float, np.ndarray]:
    """Return height in the end, the largest speed downwards since the walk's end, and the heights since braking."""
    rows = np.array(done.world.server.truth)
    place = {name: rows[:, 1 + k] for k, name in enumerate(TRUTH)}
    begins = done.account["phases"]
    since = rows[:, 0] >= begins.get("lying_down", begins["damping"]) - BEGIN
    braking = rows[:, 0] >= begins["damping"] - BEGIN
    down = -place["base_lin_vel_z_w"][since].min()
    return float(place["base_pos_z_w"][-1]), float(down), place["base_pos_z_w"][braking]


def test_a_walk_ends_with_lying_down(bundle: str, tmp_path: Path) -> None:
    sinking = play(bundle, tmp_path / "a", seconds=0.5, brake=0.5)
    lying = play(bundle, tmp_path / "b", seconds=0.5, brake=0.5, lie_down=2.0)
    assert sinking.status == lying.status == 0
    assert lying.account["ended"] == sinking.account["ended"] == DONE
    assert lying.account["walked_s"] == pytest.approx(0.5)
    assert list(lying.account["phases"]) == [name for name in PHASES if name != "handing_over"]
    assert lying.account["phases"]["damping"] - lying.account["phases"]["lying_down"] == pytest.approx(2.0, abs=0.03)
    _, fast, after = ended(sinking)
    assert after[0] > 0.2  # it falls from where it stood
    height, slow, heights = ended(lying)
    assert height < 0.1
    assert heights[0] < 0.11  # on the ground before the drives brake
    assert slow < 0.75 * fast
    # The commands are the policy's, told to stand still; then the way to the nominal stance and to the ground.
    phase, target = lying.cycles["phase"], lying.cycles["q_target"]
    down = phase == PHASES.index("lying_down")
    assert (lying.cycles["command"][down][:39] == 0.0).all()
    assert (lying.cycles["command"][phase == PHASES.index("walking")] != 0.0).any()
    np.testing.assert_allclose(target[down][60], robot.NOMINAL_STANCE, atol=1e-6)
    np.testing.assert_allclose(target[down][-1], np.tile(LYING, 4), atol=0.05)
    assert np.abs(np.diff(target[down][41:], axis=0)).max() < 0.05
    assert lying.recording.t[-1] > sinking.recording.t[-1] + 1.9  # and the recording has it


@pytest.mark.parametrize(
    ("what", "name"),
    [
        (lambda state: kill(signal.SIGINT)(state), "operator_stop"),
        (lambda state: None, "stale_state"),
        (lambda state: leaning(state), "tilt"),
    ],
)
def test_lying_down_is_no_shelter_from_faults(
    bundle: str, tmp_path: Path, what: Callable[[LowState], LowState | None], name: str
) -> None:
    done = play(bundle, tmp_path, from_(1.0, what), seconds=0.5, lie_down=2.0)
    assert done.status == STATUS[name]
    assert done.account["ended"] == name
    assert 0.99 < done.account["fault"]["t"] - BEGIN < 1.1
    begins = done.account["phases"]
    assert begins["lying_down"] - BEGIN == pytest.approx(0.72, abs=0.03)
    assert 0.99 < begins["damping"] - BEGIN < 1.1
    assert done.world.applied[-1].damping


@pytest.mark.parametrize(("keys", "lie_down", "status"), [(1, 1.0, 0), (2, 1.0, 20), (1, 0.0, 20)])
def test_a_key_ends_a_walk_in_order_and_twice_at_once(
    bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keys: int, lie_down: float, status: int
) -> None:
    ours, theirs = pty.openpty()
    left = [0.5 + 0.3 * k for k in range(keys)]

    def pressed(state: LowState) -> LowState:
        if left and state.clock >= left[0] - 1e-9:
            left.pop(0)
            os.write(ours, b"q")
        return state

    with os.fdopen(theirs, "rb", buffering=0) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        done = play(bundle, tmp_path, pressed, seconds=None, lie_down=lie_down, command=CommandConfig("keyboard"))
    os.close(ours)
    assert done.status == status
    assert ("lying_down" in done.account["phases"]) == (lie_down > 0)
    if status:
        assert done.account["ended"] == "operator_stop"
    else:
        assert done.account["ended"] == "stopped by key q"
        assert done.output[-1] == "walked for 0.3 s, stopped by key q"
        assert ended(done)[0] < 0.1


# ---------------------------------------------------------------------- faults on the way


def from_(clock: float, what: Callable[[LowState], LowState | None]) -> Spoil:
    return lambda state: state if state.clock < clock - 1e-9 else what(state)


def kill(number: int) -> Callable[[LowState], LowState]:
    def stop(state: LowState) -> LowState:
        os.kill(os.getpid(), number)
        return state

    return stop


def leaning(state: LowState) -> LowState:
    return dataclasses.replace(state, imu_quat=np.array([math.cos(0.6), math.sin(0.6), 0.0, 0.0]))


def odd(**changes: Any) -> Callable[[LowState], LowState]:
    return lambda state: dataclasses.replace(state, **changes)


FAULTY: list[tuple[str, Callable[[LowState], LowState | None], str]] = [
    ("stale_state", lambda state: None, "ms old"),
    ("stale_state", odd(joint_pos=np.full(12, np.nan)), "ms old"),  # such packets are rejected
    ("tilt", leaning, "tilt 69 deg"),
    ("torque", odd(joint_torque=np.full(12, 60.0)), "reports 60.0 N m"),
    ("operator_stop", kill(signal.SIGTERM), "requested by SIGTERM"),
    ("operator_stop", kill(signal.SIGINT), "requested by SIGINT"),
]


@pytest.mark.parametrize(("name", "what", "message"), FAULTY, ids=[f"{k} {f[0]}" for k, f in enumerate(FAULTY)])
def test_a_fault_over_the_link_makes_the_drives_brake_and_has_a_name_in_the_log(
    bundle: str, tmp_path: Path, name: str, what: Callable[[LowState], LowState | None], message: str
) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    done = play(bundle, tmp_path, from_(0.5, what), seconds=2.0)
    assert done.status == STATUS[name]
    assert done.account["ended"] == name
    assert message in done.account["fault"]["message"]
    since_start = done.account["fault"]["t"] - min(done.account["phases"].values())
    assert done.output[-1].startswith(f"fault: {name} at {since_start:.3f} s after the start: ")
    assert 0.49 < done.account["fault"]["t"] - BEGIN < 0.65
    assert done.world.robot.braking
    assert done.world.applied[-1].damping
    assert (done.cycles["damping"][done.cycles["phase"] == PHASES.index("damping")] == 1).all()
    assert done.recording.t[-1] < 0.66  # up to the fault, with what led to it
    assert handlers == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


def test_a_robot_that_never_speaks_is_waited_for_and_not_commanded(bundle: str, tmp_path: Path) -> None:
    done = play(bundle, tmp_path, lambda state: None, patience=0.3)
    assert done.status == STATUS["no_state"]
    assert done.recording is None
    assert done.account["fault"]["t"] - BEGIN == pytest.approx(0.3, abs=0.03)
    assert done.account["first_command_after_s"] is None or done.world.applied


def test_a_link_that_breaks_ends_the_walk_with_a_log(bundle: str) -> None:
    def states(cycle: int) -> list[LowState]:
        if cycle == 5:
            raise RobotError("the SDK failed")
        return [make_state(time.perf_counter(), clock=math.nan)]

    link = FakeLink(states)
    outcome = walk.walk(load(bundle), link, Plan(rate=500.0, stale=BUSY, stand_up=0.004, seconds=5.0, spin=0.0))
    assert outcome.fault is not None
    assert (outcome.fault.name, outcome.fault.message) == ("runtime", "RobotError: the SDK failed")
    assert outcome.status == STATUS["runtime"]
    assert [command.damping for command in link.sent] == [False] * 5 + [True]
    assert outcome.log.states.count == 5


def test_every_fault_has_a_status_of_its_own() -> None:
    assert list(RULES) == list(FAULTS)[: len(RULES)]
    assert len(set(STATUS.values())) == len(FAULTS)
    assert min(STATUS.values()) > walk.UNKNOWN_FAULT > 15  # those of other verbs
    conf = (data_root() / "conf/deploy.yaml").read_text()
    for name, status in STATUS.items():
        assert f"{status} {name}" in " ".join(conf.split())


# ---------------------------------------------------------------------- estimate


def test_the_filters_settings_travel_in_the_bundle(bundle: str) -> None:
    about = load(bundle).metadata
    assert settings(about.estimator) == go1() == settings({})
    assert settings(about.estimator, contact_source="height").contact_source == "height"
    changed = {**about.estimator, "gate": 9.0}
    assert settings(changed) == from_json(to_json(go1(gate=9.0)), "x")
    with pytest.raises(ValueError, match=r"estimator: .*|gaet"):
        settings({**about.estimator, "gaet": 1.0})


def test_a_filter_that_cannot_be_believed_is_a_fault() -> None:
    faults: list[tuple[str, str, float]] = []

    def made() -> KalmanEstimator:
        faults.clear()
        return KalmanEstimator(go1(), lambda *fault: faults.append(fault))

    blind = made()
    assert np.isnan(blind.update(make_state(0.0, joint_pos=np.full(12, np.nan)))).all()
    for k in range(100):
        blind.update(make_state(0.002 * k, joint_pos=np.full(12, np.nan)))
        assert bool(faults) == (0.002 * k > BLIND_S + 1e-9), k
    assert faults[0][0] == "estimator"
    assert "left out every sample" in faults[0][1]

    blinking = made()
    for k in range(200):
        blinking.update(make_state(0.002 * k, joint_pos=np.full(12, np.nan)) if k % 2 else make_state(0.002 * k))
    assert faults == []

    runs_away = made()
    for k in range(1500):  # thrown up, for all that the accelerometer says
        flying = {"foot_force": np.zeros(4), "imu_acc": np.array([0.0, 0.0, 30.0])}
        runs_away.update(make_state(0.002 * k, **flying))
    assert faults[0][:2] == ("estimator", faults[0][1])
    assert "diverged" in faults[0][1]

    made()
    late = KalmanEstimator(go1(), lambda *fault: faults.append(fault))
    for t in (0.0, 0.002, 0.002, 0.004):
        late.update(make_state(t))
    assert late.refused == {"LATE": 1, "INVALID": 0}
    assert faults == []


# ---------------------------------------------------------------------- commands

RANGES = np.array([[-0.5, 1.0], [-0.3, 0.3], [-1.0, 1.0]])


def test_a_constant_is_kept_within_the_ranges_and_cuts_are_counted() -> None:
    source = make(CommandConfig((2.0, -0.1, -3.0)), RANGES, print)
    assert source(0.0).tolist() == source(1.0).tolist() == [1.0, -0.1, -1.0]
    assert source.cut.tolist() == [2, 0, 2]
    assert range_array({"lin_vel_x": (-1.0, 2.0)}).tolist() == [[-1, 2], [-np.inf, np.inf], [-np.inf, np.inf]]
    for wrong in ((1.0, 2.0), (np.nan, 0.0, 0.0)):
        with pytest.raises(CommandError, match="must be three finite numbers"):
            make(CommandConfig(wrong), RANGES, print)
    with pytest.raises(CommandError, match="'fast': must be three numbers"):
        make(CommandConfig("fast"), RANGES, print)


def test_rows_of_a_file_are_held(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("t,x,y,yaw\n0.5,0.4,0,0\n# faster\n1.0,0.8,0.1,-0.2\n")
    source = Table(path)
    assert [source(t)[0] for t in (0.0, 0.49, 0.5, 0.99, 1.0, 50.0)] == [0.0, 0.0, 0.4, 0.4, 0.8, 0.8]
    assert source(1.5).tolist() == [0.8, 0.1, -0.2]
    for content, message in (
        ("", "no rows"),
        ("t,x\n", r"c\.csv:1: 't,x' must be"),
        ("0,1,2\n", r"c\.csv:1: must be four"),
        ("0,1,2,nan\n", r"c\.csv:1: must be four finite"),
        ("0,1,2,3\n0,1,2,3\n", r"c\.csv:2: t = 0 does not come after 0"),
        ("0,1,2,3\n1,x,2,3\n", r"c\.csv:2: '1,x,2,3' must be"),
    ):
        path.write_text(content)
        with pytest.raises(CommandError, match=message):
            Table(path)


def test_a_sinusoid_swings_as_often_and_as_far_as_it_says() -> None:
    source = Sinusoid((1.0, 0.5, -2.0), 4.0)
    np.testing.assert_allclose(source(1.0), [1.0, 0.5, -2.0])
    np.testing.assert_allclose(source(2.0), 0.0, atol=1e-12)
    np.testing.assert_allclose(source(7.0), [-1.0, -0.5, 2.0])
    with pytest.raises(CommandError, match="period 0"):
        Sinusoid((1.0, 0.0, 0.0), 0.0)


def test_keys_change_the_velocity_and_stop_the_robot() -> None:
    ours, theirs = pty.openpty()
    stops: list[str] = []
    source = make_keyboard(theirs, stops)
    try:
        for keys, expected in (
            (b"ww", [0.2, 0.0, 0.0]),
            (b"\x1b[A\x1b[D", [0.3, 0.0, 0.2]),
            (b"a\x1b[C\x1b[C", [0.3, 0.1, -0.2]),
            (b"w" * 30, [1.0, 0.1, -0.2]),
            (b"?zs", [0.9, 0.1, -0.2]),
            (b" d", [0.0, -0.1, 0.0]),
        ):
            os.write(ours, keys)
            source.poll()
            np.testing.assert_allclose(source(0.0), expected, atol=1e-9)
        assert stops == []
        for key in (b"w\x1b[A\x1b", b"q"):
            os.write(ours, key)
            source.poll()
        assert stops == ["key Esc", "key q"]
        np.testing.assert_allclose(source(0.0), [0.2, -0.1, 0.0], atol=1e-9)
    finally:
        source.close()
        os.close(ours)
        os.close(theirs)


def make_keyboard(descriptor: int, stops: list[str]) -> Keyboard:
    return Keyboard(stops.append, RANGES, descriptor)


def test_a_terminal_is_given_back_as_it_was() -> None:
    import termios

    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    source = make_keyboard(theirs, [])
    assert termios.tcgetattr(theirs) != before
    source.close()
    assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)
    with open(os.devnull) as nothing, pytest.raises(CommandError, match="no terminal"):
        make_keyboard(nothing.fileno(), [])


def test_a_gamepad_needs_its_package_and_sticks_reach_the_ranges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(CommandError, match="needs pygame"):
        make(CommandConfig("gamepad"), RANGES, print)
    np.testing.assert_allclose(stretched(np.array([1.0, -1.0, 0.05]), RANGES), [1.0, -0.3, 0.0])
    np.testing.assert_allclose(stretched(np.array([-1.0, 0.5, -0.5]), RANGES), [-0.5, 0.15, -0.5])

    buttons, stops = [0, 0], list[str]()
    pad = SimpleNamespace(
        get_numaxes=lambda: 4, get_axis=lambda k: (0.0, -0.5, 0.0, 1.0)[k], get_button=buttons.__getitem__
    )
    joystick = SimpleNamespace(get_count=lambda: 1, Joystick=lambda k: pad)
    nothing = lambda: None  # noqa: E731
    event = SimpleNamespace(get=list)
    game = SimpleNamespace(init=nothing, quit=nothing, joystick=joystick, event=event, JOYDEVICEREMOVED=1)
    monkeypatch.setitem(sys.modules, "pygame", game)
    source = make(CommandConfig("gamepad"), RANGES, stops.append)
    source.poll()
    np.testing.assert_allclose(source(0.0), [0.5, 0.0, -1.0])
    buttons[1] = 1
    source.poll()
    assert stops == ["gamepad button"]
    source.close()


def test_a_word_of_the_command_line_is_numbers_or_a_name() -> None:
    assert parsed("1,0,-0.5") == parsed("[1, 0, -0.5]") == (1.0, 0.0, -0.5)
    assert parsed("walk.csv") == "walk.csv"


# ---------------------------------------------------------------------- the log


def cycle(t: float, phase: str, fresh: list[LowState], target: float | None = 0.0) -> Cycle:
    command = None if target is None else low_cmd(joint_target=np.full(12, target), damping=phase == "damping")
    return Cycle(t, phase, fresh[-1] if fresh else None, command, np.zeros(3), np.zeros(3), None, fresh)


def test_a_robot_that_does_not_report_the_applied_command_is_taken_to_apply_the_newest(bundle: str) -> None:
    about = load(bundle).metadata
    log = Log(100.0, 1.0)
    silent = {"clock": math.nan}
    steps = [(0.0, "waiting", None), (0.01, "walking", 1.0), (0.02, "walking", 2.0), (0.03, "damping", 0.0)]
    for t, phase, target in steps:
        log.note(cycle(t, phase, [make_state(t - k, **silent) for k in (0.006, 0.002)], target))
    log.note(cycle(0.04, "damping", [make_state(0.038, **silent)]))
    result = log.recording(About(about, np.full(12, 20.0), np.full(12, 0.5), False, False, "e"))
    assert result is not None
    np.testing.assert_allclose(result.t, [0.014, 0.018, 0.024, 0.028])
    assert result.joint("q_target")[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert not any(name.startswith("foot_force") for name in result.channels)  # in no unit that anybody knows
    assert result.meta.source == "measured"
    assert "does not report the applied one" in result.meta.notes
    assert result.meta.contact is None


@pytest.mark.parametrize(
    ("config", "contact"),
    [
        ({"contact": {"time_constant": 0.005, "cone": "elliptic", "impratio": 10}}, (0.005, "elliptic", 10.0)),
        ({"robot": {}}, (0.02, "pyramidal", 1.0)),  # of a version that knew MuJoCo's own alone
        ({"contact": {"time_constant": "soft"}}, None),
        ({}, None),
    ],
)
def test_a_log_names_the_contact_that_its_policy_was_trained_with(
    bundle: str, config: dict[str, Any], contact: tuple[Any, ...] | None
) -> None:
    log = Log(100.0, 1.0)
    for t, phase in ((0.0, "walking"), (0.01, "walking"), (0.02, "damping")):
        log.note(cycle(t, phase, [make_state(t - k, clock=math.nan) for k in (0.006, 0.002)]))
    twelve = np.full(12, 20.0)
    about = About(load(bundle).metadata, twelve, twelve, simulated=False, newton=False, episode="e", trained=config)
    recording = log.recording(about)
    assert recording is not None
    assert recording.meta.contact == (None if contact is None else ContactConfig(*contact))


def test_a_long_walk_keeps_its_newest_seconds(bundle: str, tmp_path: Path) -> None:
    done = play(bundle, tmp_path, keep=0.5, seconds=0.8)
    assert done.account["log"]["overwritten"] > 100
    assert 200 <= len(done.recording.t) <= 251
    assert done.recording.t[-1] == pytest.approx(1.03, abs=0.03)
    had = {round(clock / TICK): target for clock, target, _ in done.world.targets}
    assert done.recording.joint("q_target")[0].tolist() == had[round(done.recording.t[0] / TICK)].tolist()


# ---------------------------------------------------------------------- processes


@pytest.mark.slow("go1exp/deploy/", "go1exp/deploy/sim_robot/", "go1exp/cli/", "go1exp/deploy/export/")
def test_the_verb_walks_against_another_process_in_real_time(
    bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(data_root()))
    arguments = ["deploy", bundle, "robot=sim", "command=[0.3,0,0]", "seconds=1.5", "stand_up=0.5", "brake=0.2"]
    monkeypatch.setattr(sys, "argv", ["go1exp", *arguments, f"stale={BUSY}", "effect=payload", "out=logs"])
    assert cli.main() == 0
    output = capsys.readouterr().out
    assert "walking: " in output
    assert output.splitlines()[-1] == "walked for 1.5 s, to the end"
    (kept,) = (tmp_path / "logs").glob("*.parquet")
    result = recording.read(kept)
    assert result.t[-1] - result.t[0] > 0.5  # on a machine that stands still for the rest of it
    account = json.loads(kept.with_suffix(".json").read_text())
    assert account["simulated_robot"]["what"] == "ended"
    assert account["simulated_robot"]["ticks"] > 250
    assert account["memory_mb"] > 0


def begun(folder: Path, *arguments: str) -> tuple[subprocess.Popen[str], IO[str]]:
    """Start Python in a folder, with warnings as errors; return the process and what it prints."""
    process = subprocess.Popen(
        [sys.executable, "-W", "error", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(data_root())},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    return process, process.stdout


@pytest.mark.slow("go1exp/deploy/", "go1exp/deploy/sim_robot/", "go1exp/cli/", "go1exp/deploy/export/")
def test_the_light_way_stops_at_a_signal_and_loads_nothing_heavy(bundle: str, tmp_path: Path) -> None:
    code = (
        "import sys, json\nfrom go1exp.deploy.__main__ import main\nstatus = main(sys.argv[1:])\n"
        "with open('modules.json', 'w') as file:\n"
        "    json.dump(sorted({name.split('.')[0] for name in sys.modules}), file)\nsys.exit(status)"
    )
    arguments = f"--command 0.2,0,0 --stand-up 0.2 --brake 0.2 --stale {BUSY} --out logs".split()
    process, pipe = begun(tmp_path, "-c", code, bundle, *arguments)
    lines = []
    for line in pipe:
        lines.append(line)
        if line.startswith("walking: "):
            process.send_signal(signal.SIGINT)
            break
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == STATUS["operator_stop"], (lines, rest, errors)
    assert errors == ""
    assert rest.splitlines()[-1].endswith("requested by SIGINT")
    heavy = {"torch", "stable_baselines3", "gymnasium", "mujoco", "hydra", "omegaconf", "scipy", "onnx"}
    modules = set(json.loads((tmp_path / "modules.json").read_text()))
    assert {"onnxruntime", "pyarrow"} <= modules
    assert not heavy & modules
    assert len(list((tmp_path / "logs").glob("*.parquet"))) == 1


def children(pid: int) -> list[int]:
    return [int(number) for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="children are found in Linux's /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("way", ["go1exp.deploy", "go1exp"])
@pytest.mark.parametrize("seconds", [60.0, pytest.param(2.0, marks=pytest.mark.slow("go1exp/deploy/", "go1exp/cli/"))])
def test_a_signal_while_the_robot_starts_ends_both_at_once(
    bundle: str, tmp_path: Path, seconds: float, way: str, number: signal.Signals
) -> None:
    arguments = ["deploy", bundle, "out=logs"] if way == "go1exp" else [bundle, "--out", "logs"]
    process, pipe = begun(tmp_path, "-m", way, *arguments)
    lines = [next(pipe)]
    while "starting the simulated robot" not in lines[-1]:
        lines.append(next(pipe))
    while not (robots := children(process.pid)):
        time.sleep(0.001)
    time.sleep(0.05)  # it has begun to import, which takes seconds
    process.send_signal(number)
    try:
        rest, errors = process.communicate(timeout=seconds)
    finally:
        process.kill()
        process.wait()
    assert errors == ""
    assert rest == "stopped before the walk began: nothing was commanded\n"
    assert process.returncode == STATUS["operator_stop"]
    for pid in robots:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert list(tmp_path.rglob("walk_*")) == []


def test_what_is_wrong_is_said_in_a_line(bundle: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from go1exp.deploy.__main__ import main

    assert main([str(tmp_path / "none.zip")]) == 2
    assert "No such file" in capfd.readouterr().err
    assert main([bundle, "--command", "fast", "--out", str(tmp_path)]) == 1
    assert capfd.readouterr().err.startswith("go1exp.deploy: command 'fast': must be three numbers")
    assert main([bundle, "--robot", "dog", "--out", str(tmp_path)]) == 2
    assert "robot=dog: must be sim, go1, or the port" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        main([bundle, "--rate", "-5"])
    assert "-5: must be greater than 0" in capfd.readouterr().err
    with pytest.raises(RefusedError, match=r"sim\.loss = 2"):
        run_job(Job(bundle, "sim", Plan(), str(tmp_path), sim={"loss": 2.0}), print)
    output: list[str] = []
    with pytest.raises(NotADirectoryError):  # before the robot is started, not when the log is due
        run_job(Job(bundle, "sim", Plan(), f"{bundle}/logs"), output.append)
    assert output == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow("go1exp/deploy/", "go1exp/deploy/sim_robot/", "go1exp/cli/", "go1exp/deploy/export/")
def test_the_bench_measures_the_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    from go1exp.evaluate.bench import deploy, env

    monkeypatch.setattr(deploy, "RATE", 100.0)
    monkeypatch.setenv("PYTHONPATH", str(data_root()))
    rounds: list[tuple[int, int]] = []
    figures = deploy.run(compose("train", SMALL), env.Measured(1, 1, 0.5, lambda *done: rounds.append(done)))
    assert rounds == [(1, 1)]
    assert 0 < figures["command_p50_ms"] <= figures["command_p99_ms"]
    assert figures["policy_us"] > 1
    assert 20 < figures["memory_mb"] < 400


def test_a_motion_of_a_hung_robot_becomes_a_recording_for_gap(bundle: str, tmp_path: Path) -> None:
    motion = played("chirp", 1.0, 250.0, (35.0, 0.7), 3)
    about = {"mover": motion, "motion": motion.name, "gains": motion.gains, "sim": {"start": "suspended", "noise": 0.0}}
    done = play(bundle, tmp_path, about=about, rate=motion.rate, seconds=motion.seconds)
    assert done.output[-1] == f"played chirp for {motion.seconds:.1f} s, to the end"
    meta = done.recording.meta
    assert (meta.base, meta.excitation, meta.kp[0], meta.kd[0]) == ("fixed", "chirp", 35.0, 0.6875)
    assert meta.base_quat == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-6)
    target = make_motion(Term("chirp", members("excitation")["chirp"], {}), 1.0, 250.0, 3).target
    logged, rest = done.recording.joint("q_target"), target[0]
    there = int(np.flatnonzero(np.abs(logged - rest).max(axis=1) < 1e-6)[0])  # it has stood up
    moving = [int(np.argmax(np.abs(rows - rest).max(axis=1) > 1e-4)) for rows in (logged[there:], target)]
    first = there + moving[0]
    np.testing.assert_allclose(logged[first : first + 400 : 2], target[moving[1] :][:200], atol=1e-9)  # for two states
    away = np.abs(done.recording.joint("q") - logged)
    assert away[: len(away) // 2].max() < 0.3
