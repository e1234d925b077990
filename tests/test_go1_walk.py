"""Walks over the Go1's own packets, at a time of their own: what goes wrong on the way, who else speaks, the check."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.cli.places import shipped_policies
from go1exp.deploy.estimation import go1
from go1exp.deploy.estimation.feet import CalibrationError, FootCalibration, calibrated, forces_by_torque, kinematics
from go1exp.deploy.export.build import build
from go1exp.deploy.runtime import go1_check, job
from go1exp.deploy.runtime import go1_wire as wire
from go1exp.deploy.runtime.bundle import load
from go1exp.deploy.runtime.commands import CommandConfig
from go1exp.deploy.runtime.estimate import BOTH, TORQUE, KalmanEstimator, settings
from go1exp.deploy.runtime.go1_check import Bounds, Observed, evaluated
from go1exp.deploy.runtime.job import Job, run_check, run_job
from go1exp.deploy.runtime.launch import RobotError
from go1exp.deploy.runtime.udp import Go1Link
from go1exp.deploy.runtime.walk import Plan
from go1exp.deploy.sim_robot.__main__ import bundle_task, sim_config
from go1exp.deploy.sim_robot.alone import Monitor
from go1exp.deploy.sim_robot.machine import SILENCE, TICK, Robot
from go1exp.deploy.sim_robot.server import GONE_S, STRANGER, TRUTH, FootSensors, Network, Server
from go1exp.logs import recording
from go1exp.robot.go1_fields import STATE_SIZE
from go1exp.robot.messages import LowState
from tests.lockstep import World, lockstep, play
from tests.made import at, low_cmd, low_state


class Spoilt(Network):
    """Loses one in a hundred, doubles, delays, damages and repeats old ones, each for one datagram in twenty."""

    def __init__(self, seed: int) -> None:
        super().__init__(0.0, 0.01, np.random.default_rng(seed))
        self._dice, self._old = np.random.default_rng(seed + 100), list[bytes]()
        self.done = dict.fromkeys(("doubled", "delayed", "damaged", "replayed"), 0)

    def put(self, now: float, data: bytes) -> None:
        what = self._dice.choice(["", *self.done], p=[0.8, 0.05, 0.05, 0.05, 0.05])
        if what:
            self.done[what] += 1
        self._old = [*self._old[-50:], data]
        super().put(now + 0.006 * (what == "delayed"), data)
        if what == "doubled":
            super().put(now, data)
        if what == "damaged":
            place = int(self._dice.integers(3, 600))
            super().put(now, data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :])
        if what == "replayed":
            super().put(now, self._old[0])


def test_a_walk_stands_a_network_that_loses_doubles_delays_damages_and_replays(bundle: str, tmp_path: Path) -> None:
    ways: list[Spoilt] = []

    def spoil(world: World) -> None:
        assert world.server is not None
        ways[:] = Spoilt(1), Spoilt(2)
        world.server._uplink, world.server._downlink = ways

    done = play(bundle, tmp_path, on_server=spoil, about={"truth": True}, hand_over=0.5)
    assert done.status == 0
    assert done.output[-1] == "walked for 1.0 s, to the end"
    up, down = (way.done for way in ways)
    assert min(*up.values(), *down.values()) >= 10
    link, there = done.account["link"], done.account["simulated_robot"]
    assert link["refused_because"] == {"wrong checksum": down["damaged"]}
    assert link["late"] + link["overtaken"] >= down["doubled"] + down["replayed"]
    # of each tick one, as the recording has
    assert link["received"] + link["late"] <= there["states"] - down["damaged"]
    assert link["lost"] > 3
    assert there["refused"] == {"wrong checksum": up["damaged"]}
    r = done.recording
    assert (np.diff(r.t) > 0).all()
    assert r.block("base_pos_z_w").min() > 0.2


# ---------------------------------------------------------------------- where contact comes from


@pytest.fixture(scope="module")
def walking(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The shipped policy as a bundle."""
    path = tmp_path_factory.mktemp("paper") / "walk.zip"
    path.write_bytes(build(shipped_policies()["robust_history"], seconds=0.2))
    return str(path)


RAW = {"feet": "raw", "seed": 5}


def of_sensors(seed: int, folder: Path) -> str:
    """The file of a calibration that is as wrong as a check's: zeros up to 5 N high, scales within a quarter."""
    sensors, rng = FootSensors(sim_config({"feet": "raw", "seed": seed})), np.random.default_rng(seed)
    zero = sensors.zero + sensors.scale * rng.uniform(0.0, 5.0, 4)
    path = folder / "feet.json"
    scale = sensors.scale * rng.uniform(0.75, 1.25, 4)
    FootCalibration(tuple(map(float, zero)), tuple(map(float, scale))).write(path)  # type: ignore[arg-type]
    return str(path)


def errors(states: list[LowState], truth: dict[str, np.ndarray], estimator: KalmanEstimator) -> float:
    """The RMSE of the velocity, three components together, m/s, from half a second on."""
    velocity = np.array([estimator.update(state) for state in states])
    k = np.searchsorted(truth["clock"], [state.clock - 1e-6 for state in states])
    quat = np.stack([truth[f"base_quat_{part}"] for part in "wxyz"], axis=1)[k]
    world = np.stack([truth[f"base_lin_vel_{axis}_w"] for axis in "xyz"], axis=1)[k]
    off = velocity - Rotation.from_quat(quat, scalar_first=True).inv().apply(world)
    return float(np.sqrt((off[250:] ** 2).sum(axis=1).mean()))


def watched(
    walking: str, out: Path, monkeypatch: pytest.MonkeyPatch, feet: str | None, seconds: float = 3.0
) -> SimpleNamespace:
    """Walk with the shipped policy and raw sensors for some seconds, and keep what its filter took and gave."""
    states, velocities, said, worlds = list[LowState](), list[np.ndarray](), list[str](), list[World]()
    update = KalmanEstimator.update

    def listening(self: KalmanEstimator, state: LowState) -> np.ndarray:
        states.append(state)
        velocities.append(update(self, state))
        return velocities[-1]

    plan = Plan(seconds=seconds, stand_up=0.3, lie_down=0.0, brake=0.05, command=CommandConfig((0.8, 0.0, 0.3)))
    with monkeypatch.context() as patch, lockstep(on_server=worlds.append) as world:
        patch.setattr(KalmanEstimator, "update", listening)
        assert run_job(Job(walking, "sim", plan, str(out), sim=RAW, feet=feet), said.append) == 0, said
        assert world.server is not None
        rows = np.array(world.server.truth)
    truth = dict(zip(("clock", *TRUTH), rows.T, strict=True))
    return SimpleNamespace(states=states, velocity=np.array(velocities), truth=truth, said=said)


def test_raw_sensors_with_a_calibration_and_torques_tell_contact_better_than_torques_alone_or_counts(
    walking: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fresh filter over the same states gives the walk's own velocities, and with another source larger errors."""
    path = of_sensors(5, tmp_path)
    done = watched(walking, tmp_path / "both", monkeypatch, path)
    assert f"foot contact: from joint torques and the foot sensors, calibrated by {path}" in done.said
    assert min(state.foot_force.min() for state in done.states) > 60.0  # counts
    about = load(walking).metadata.estimator

    def anew(feet: FootCalibration | None, **changes: Any) -> KalmanEstimator:
        return KalmanEstimator(settings(about, **changes), lambda *_: None, feet)

    feet = FootCalibration.read(Path(path))
    again = anew(feet, **BOTH)
    assert np.array([again.update(state) for state in done.states]).tobytes() == done.velocity.tobytes()
    both = errors(done.states, done.truth, anew(feet, **BOTH))
    torques = errors(done.states, done.truth, anew(None, **TORQUE))
    counts = errors(done.states, done.truth, anew(None))
    assert both < 0.02  # 0.012; torques alone 0.045, counts taken for newtons 0.146
    assert torques > 2.0 * both
    assert counts > 5.0 * both


def test_raw_sensors_without_a_calibration_leave_contact_to_the_torques(
    walking: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = watched(walking, tmp_path / "torques", monkeypatch, None, seconds=1.0)
    assert any(line.startswith("foot contact: from joint torques alone; feet=FILE") for line in done.said)
    again = KalmanEstimator(settings(load(walking).metadata.estimator, **TORQUE), lambda *_: None)
    assert np.array([again.update(state) for state in done.states]).tobytes() == done.velocity.tobytes()
    assert not any(
        name.startswith("foot_force")
        for name in recording.read(next((tmp_path / "torques").glob("*.parquet"))).channels
    )


@pytest.mark.parametrize(
    ("sim", "scaled", "message"),
    [
        ({}, True, r"feet\.json: calibrates sensors that report counts.*unless sim\.feet=raw"),
        ({"feet": "newton"}, True, r"feet\.json: calibrates sensors that report counts.*unless sim\.feet=raw"),
        ({"feet": "raw"}, False, "has no scales"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_before_anything_moves(
    bundle: str, tmp_path: Path, sim: dict[str, str], scaled: bool, message: str
) -> None:
    feet = of_sensors(0, tmp_path)
    if not scaled:
        FootCalibration((1.0, 2.0, 3.0, 4.0)).write(Path(feet))
    with pytest.raises((RobotError, CalibrationError), match=message):
        run_job(Job(bundle, "sim", Plan(seconds=1.0), str(tmp_path / "out"), sim=sim, feet=feet), print)
    assert not (tmp_path / "out").exists()


def server(bundle: str, **sim: Any) -> Server:
    config = sim_config({"noise": 0.0, **sim})
    return Server(Robot(bundle_task(bundle, {}), config), config, kept=0.1)


@contextmanager
def speakers(count: int) -> Iterator[list[socket.socket]]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
        one.settimeout(5.0)
    yield sockets
    for one in sockets:
        one.close()


def test_a_robot_answers_the_first_who_speaks_and_refuses_and_counts_the_others(bundle: str) -> None:
    made = server(bundle)
    with speakers(2) as (first, second):
        to = ("127.0.0.1", made.port)
        for wrong in (b"", b"x" * 614, wire.IDLE[:-1], wire.IDLE[:-1] + b"\0"):
            second.sendto(wrong, to)
        made.tick()
        assert made.peer is None
        assert made.counts.refused == {"wrong size": 2, "wrong head": 1, "wrong checksum": 1}
        first.sendto(wire.IDLE, to)
        second.sendto(wire.pack_command(low_cmd(joint_target=robot.NOMINAL_STANCE + 0.5)), to)
        made.tick()
        assert made.peer == first.getsockname()
        assert made.counts.refused[STRANGER] == 1
        assert (made.counts.commands, made.robot.commanded) == (0, False)
        packet = first.recv(1000)
        assert wire.refusal(packet, STATE_SIZE) is None
        for _ in range(round(GONE_S / TICK) + 2):
            made.tick()
        second.sendto(wire.pack_command(low_cmd()), to)
        made.tick()
        assert made.peer == second.getsockname()  # the first has been silent for a second
        assert made.counts.commands == 1
    made.close()


def test_a_robot_holds_its_pose_until_a_command_and_brakes_when_nobody_speaks(bundle: str) -> None:
    made = server(bundle, start="standing")
    with speakers(1) as (client,):
        to = ("127.0.0.1", made.port)
        for _ in range(200):
            client.sendto(wire.IDLE, to)
            made.tick()
        assert len(made.truth) == len(made.applied) == 51  # the newest 0.1 s
        assert made.truth[-1][0] == made.applied[-1][0] == pytest.approx(made.robot.clock - TICK)
        assert made.robot.truth[2] > 0.25  # it stands, as by its maker's own controller
        client.sendto(wire.pack_command(low_cmd()), to)
        made.tick()
        for tick in range(round(SILENCE / TICK) + 3):
            assert made.robot.braking == (tick * TICK > SILENCE + 1e-9), tick
            made.tick()
        client.sendto(wire.IDLE, to)  # asks for nothing, and now that is what the drives do
        for _ in range(10):
            made.tick()
        np.testing.assert_allclose(made.robot.sense()[0].joint_torque, 0.0, atol=1e-9)
    made.close()


def test_raw_foot_sensors_have_a_zero_and_a_scale_each(bundle: str) -> None:
    counts = {}
    for start in ("suspended", "standing"):
        made = server(bundle, start=start, feet="raw", seed=3)
        with speakers(1) as (client,):
            client.sendto(wire.IDLE, ("127.0.0.1", made.port))
            made.tick()
            counts[start] = wire.unpack_state(client.recv(1000), 0.0, 0.0).foot_force
        force = made.robot.sense()[0].foot_force
        made.close()
    assert ((counts["suspended"] >= 100) & (counts["suspended"] < 130)).all()
    scale = (counts["standing"] - counts["suspended"]) / force
    assert ((scale > 0.45) & (scale < 1.55)).all()
    assert np.ptp(scale) > 0.1


def test_the_robot_alone_says_who_speaks_and_what_it_refuses(bundle: str) -> None:
    made, lines = server(bundle), list[str]()
    account = Monitor(made, lines.append, _at=0.0)
    with speakers(2) as (first, second):
        to = ("127.0.0.1", made.port)
        account.look(1.1)
        for k in range(100):
            first.sendto(wire.IDLE, to)
            if k in (50, 60):
                second.sendto(wire.IDLE, to)
            made.tick()
        account.look(1.5)
        second.sendto(wire.IDLE, to)
        made.tick()
        account.look(2.1)
        account.look(3.2)
        account.look(4.3)
    made.close()
    name = "{}:{}".format(*made.peer)  # type: ignore[misc]
    assert lines[0] == "no client"
    assert lines[1].startswith(f"client {name}; others are rejected")
    assert lines[2] == f"rejected for the first time: {STRANGER}"
    assert lines[3].startswith(f"{name}: 100 packets/s in, 101 out; holding its pose, trunk at 0.")
    assert lines[3].endswith(f"rejected 1 x {STRANGER}; 0 ms behind real time")
    assert lines[4:] == ["no client"]


# ---------------------------------------------------------------------- the check


@contextmanager
def living(made: Server) -> Iterator[list[bytes]]:
    """Let a robot tick in another thread; yields every packet that it gets."""
    heard: list[bytes] = []
    ended = threading.Event()
    made.on_heard = lambda arrived, packet: heard.append(packet)
    thread = threading.Thread(target=made.serve, args=(lambda: not ended.is_set(),))
    thread.start()
    while not made.counts.ticks and thread.is_alive():
        time.sleep(0.001)
    try:
        yield heard
    finally:
        ended.set()
        thread.join(10.0)
        made.close()


LOOSE = Bounds(rate=20.0, gap=2.0)
"""For a machine that is busy."""


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(go1_check, "SECONDS", 0.3)
    monkeypatch.setattr(job, "check", partial(go1_check.check, bounds=LOOSE))


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(("unloaded", "zero_atol"), [("lying", 8.0), ("suspended", 1.0)])
def test_a_check_asks_for_no_torque_and_calibrates_feet_from_unloaded_and_standing(
    bundle: str, tmp_path: Path, unloaded: str, zero_atol: float
) -> None:
    feet, said = tmp_path / "feet.json", list[str]()
    for start in ("standing", unloaded, "standing"):
        made = server(bundle, start=start, feet="raw", seed=3, noise=0.1)
        with living(made) as heard:
            look = robot.JOINTS, robot.JOINT_POS_LIMITS, feet, f"127.0.0.1:{made.port}"
            assert run_check(*look, said.append) == 0, said[-4:]
        assert len(heard) > 5
        assert set(heard) == {wire.IDLE}
        assert not made.robot.commanded
    learnt = [line for line in said if line.startswith("calibration")]
    assert ["zeros are unknown" in learnt[0], "zeros, from" in learnt[1], "scales, from" in learnt[2]] == [True] * 3
    known = FootCalibration.read(feet)
    sensors = made.packets.feet
    np.testing.assert_allclose(known.zero, sensors.zero, atol=zero_atol)  # a lying robot's calves rest on its feet
    assert known.scale is not None
    np.testing.assert_allclose(known.scale, sensors.scale, rtol=0.3)
    np.testing.assert_allclose(known.forces(sensors.counts(np.full(4, 30.0))), 30.0, rtol=0.3)
    assert any("battery: 80 %" in line for line in said)


@pytest.mark.usefixtures("patient")
def test_a_walk_begins_only_after_the_check_has_passed(
    bundle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan(seconds=0.2, stand_up=0.1, lie_down=0.0, brake=0.1, stale=5.0)
    monkeypatch.setattr(go1_check.Observed, "tick_s", 0.001)  # by the clock, which a busy machine disturbs
    made = server(bundle, start="standing")
    made.packets.health = wire.Health(charge=7)
    there = f"127.0.0.1:{made.port}"
    with living(made) as heard:
        with pytest.raises(RobotError, match=r"does not pass its check.*battery: 7 %; at least 20 % are needed"):
            run_job(Job(bundle, "go1", plan, str(tmp_path / "a"), address=there), print)
        assert set(heard) == {wire.IDLE}
        made.packets.health = wire.Health()
        until = made.counts.ticks + round(GONE_S / TICK) + 5
        while made.counts.ticks < until:
            time.sleep(0.01)
        began = time.monotonic()
        assert run_job(Job(bundle, "go1", plan, str(tmp_path / "b"), address=there), print) == 0
        took = time.monotonic() - began
        assert set(heard) != {wire.IDLE}
    walked = recording.read(next((tmp_path / "b").glob("*.parquet")))
    assert walked.meta.source == "measured"
    assert not any(name.startswith("foot_force") for name in walked.channels)
    # Rows are by the robot's own tick, whose unit the check has found, and not by times of arrival.
    np.testing.assert_allclose(np.diff(walked.t) / TICK, np.rint(np.diff(walked.t) / TICK), atol=1e-6)
    account = json.loads(next((tmp_path / "b").glob("*.json")).read_text())
    delay = account["packets"]["delay"]  # relative to the fastest packet, which is but one
    assert 0.0 < delay["p50"] <= delay["p99"] <= delay["worst"] < took


def test_nobody_there_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(go1_check, "SECONDS", 0.05)
    said: list[str] = []
    with speakers(1) as (silent,):
        address = "{}:{}".format(*silent.getsockname())
        assert run_check(robot.JOINTS, robot.JOINT_POS_LIMITS, tmp_path / "f", address, said.append) == 1
    assert said[1].startswith("problem: no robot: 0 states in 0.1 s; nothing arrived")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RobotError, match=r"address=here: must be HOST:PORT, such as 192\.168\.123\.10:8007"):
        run_check(robot.JOINTS, robot.JOINT_POS_LIMITS, tmp_path / "f", "here", said.append)


def heard_of(**changes: Any) -> Observed:
    """What a good robot says for a second, with changes."""
    health = changes.pop("health", wire.Health())
    period = changes.pop("period", 0.002)
    states = [low_state(period * k, **{"foot_force": np.full(4, 115.0), **changes}) for k in range(500)]
    return Observed(1.0, states, [(2 * k, 0.002 * k) for k in range(500)], health)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, None),
        ({"period": 0.005}, "packets: 200 per second; at least 400"),
        ({"health": wire.Health(charge=19)}, "battery: 19 %; at least 20 %"),
        ({"health": wire.Health(motor_temperature=(30,) * 5 + (66,) + (30,) * 6)}, "temperature: FL_calf has 66 °C"),
        ({"joint_pos": at(robot.NOMINAL_STANCE, 3, 1.0)}, "joints: FL_hip is at 1.000 rad; its range is -0.863"),
        ({"joint_pos": at(robot.NOMINAL_STANCE, 3, np.nan)}, "joints: FL_hip is at nan rad"),
        ({"joint_vel": at(np.zeros(12), 2, 1.5)}, "joints: FR_calf moves at 1.50 rad/s"),
        ({"imu_quat": np.zeros(4)}, "attitude quaternion's length is 0.000"),
        ({"imu_acc": np.array([0.0, 0.0, 5.0])}, "accelerometer reports 5.00 m/s2"),
        ({"imu_quat": np.array([np.cos(0.4), np.sin(0.4), 0, 0])}, "tilt 46 deg"),
    ],
)
def test_each_finding_of_the_check_keeps_a_walk_from_beginning(changes: dict[str, Any], problem: str | None) -> None:
    link = Go1Link("127.0.0.1", 9)
    report = evaluated(heard_of(**changes), link, robot.JOINTS, robot.JOINT_POS_LIMITS, go1(), Bounds())
    link.close()
    assert bool(report.problems) == (problem is not None), report.problems
    assert problem is None or any(problem in line for line in report.problems)
    assert report.tick_s == 0.001


def test_the_ticks_unit_is_measured() -> None:
    for unit, per_packet in ((0.001, 2), (0.000001, 2000), (0.002, 1)):
        heard = Observed(ticks=[(per_packet * k + 2**32 - 50, 0.002 * k + 0.0001 * (k % 3)) for k in range(300)])
        assert heard.tick_s == unit
    assert np.isnan(Observed(ticks=[(7 * k, 0.002 * k) for k in range(300)]).tick_s)
    assert np.isnan(Observed().tick_s)


def test_a_calibration_that_is_none_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "feet.json"
    for content in ("[]", '{"zero": [1, 2, 3, 4]}'):
        path.write_text(content)
        with pytest.raises(CalibrationError, match="must be a mapping with the keys zero and scale"):
            FootCalibration.read(path)
    for content in ("{", "{}", '{"zero": [1, 2, 3], "scale": null}', '{"zero": [1,2,3,4], "scale": [1,1,1,0]}'):
        path.write_text(content)
        with pytest.raises(CalibrationError, match=r"feet\.json: is no calibration"):
            FootCalibration.read(path)
    zeros = FootCalibration((1.0, 2.0, 3.0, 4.0))
    zeros.write(path)
    assert FootCalibration.read(path) == zeros
    with pytest.raises(CalibrationError, match="has no scales"):
        zeros.forces(np.zeros(4))


def test_feet_are_not_calibrated_by_a_robot_that_neither_lies_nor_stands() -> None:
    zeros = FootCalibration((100.0,) * 4)
    for forces in ([10.0] * 4, [-30.0] * 4, [60.0, 60.0, 5.0, 5.0]):
        after, learnt = calibrated(np.full(4, 130.0), np.array(forces), zeros)
        assert after is zeros
        assert learnt.startswith("unchanged: ")
    after, learnt = calibrated(np.array([90.0, 130, 130, 130]), np.full(4, 30.0), zeros)
    assert (after, "the counts of FR do not grow" in learnt) == (zeros, True)
    after, _ = calibrated(np.full(4, 130.0), np.full(4, 30.0), zeros)
    assert after == FootCalibration((100.0,) * 4, (1.0,) * 4)


def test_forces_that_balance_the_torques_are_those_under_the_feet(bundle: str) -> None:
    made = server(bundle, start="standing")
    for _ in range(100):
        made.tick()
    state = made.robot.sense()[0]
    made.close()
    forces = forces_by_torque(state.joint_pos, state.joint_torque, np.array([0.0, 0.0, 1.0]), kinematics(go1()))
    # The legs' own weight is not in the torques of a foot: 7.5 kg of the robot's 12.7 are legs.
    np.testing.assert_allclose(forces, state.foot_force, rtol=0.25)
