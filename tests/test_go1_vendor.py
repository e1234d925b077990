"""The vendor's own client (unitree-legged-sdk 3.8.20231105, a compiled module) against ours, over real sockets.

``make test-vendor`` installs it; without it these tests are skipped.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp import robot
from go1exp.cli.runs import shipped_policies
from go1exp.deploy.export.build import build
from go1exp.deploy.runtime import go1_sdk, job
from go1exp.deploy.runtime import go1_wire as wire
from go1exp.deploy.runtime.commands import Wish
from go1exp.deploy.runtime.go1_check import Bounds, check
from go1exp.deploy.runtime.job import Job, run_job
from go1exp.deploy.runtime.launch import RobotError, SimulatedRobot
from go1exp.deploy.runtime.walk import Plan
from go1exp.logs import recording
from go1exp.robot.messages import LowCmd, LowState

try:
    SDK: Any = go1_sdk._module()
except RobotError:
    SDK = None

pytestmark = pytest.mark.slow("go1exp/deploy/", "go1exp/deploy/sim_robot/")
LOCAL = 8080


@pytest.fixture(autouse=True, scope="module")
def _needs() -> None:
    if SDK is None and os.environ.get("GO1EXP_TEST_VENDOR"):
        pytest.fail("the vendor's module cannot be imported: it needs Python 3.11 on x86-64")
    elif SDK is None:
        pytest.skip("the vendor's module is not installed: make test-vendor")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The shipped policy as a bundle."""
    path = tmp_path_factory.mktemp("vendor") / "walk.zip"
    path.write_bytes(build(shipped_policies()["paper"], seconds=0.2))
    return str(path)


def test_the_vendors_client_walks_the_shipped_policy_for_ten_seconds(
    walk: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the check, with its PositionLimit and PowerProtect, and one packet in a hundred lost each way."""
    monkeypatch.setattr(job, "check", partial(check, bounds=Bounds(rate=20.0, gap=2.0)))  # the machine may be busy
    with SimulatedRobot(walk, {"noise": 0.3, "loss": 0.01}, {}) as there:
        plan = Plan(seconds=10.0, stale=5.0, wish=Wish((0.6, 0.0, 0.2)))
        said: list[str] = []
        given = Job(walk, "go1_sdk", plan, str(tmp_path), address=f"127.0.0.1:{there.port}")
        assert run_job(given, said.append) == 0, said
    assert any(line.startswith("battery: 80 %, -2.00 A, cells 3.84 to 3.84 V") for line in said), said[:12]
    print("\n".join(said[-5:]))
    print({name: value for name, value in there.report.items() if name != "timing"})
    assert said[-1] == "walked for 10.0 s, to the end"
    assert there.report["refused"] == {}
    assert there.report["commands"] > 1000
    clock, height = there.truth["clock"], there.truth["base_pos_z_w"]
    assert there.obeyed is not None
    obeying = there.obeyed[:, 1] > 0
    # It sinks while the runtime brakes first, then stands up; at the end it lies down.
    upright = obeying & (clock > clock[obeying][0] + 3.0) & (clock < clock[obeying][-1] - 2.5)
    assert height[upright].min() > 0.25
    # By the robot's clock, which falls behind on a busy machine; the middle half has no standing up or lying down.
    begin, end = np.quantile(clock[obeying], [0.25, 0.75])
    forward = _forward_speed(there.truth)[(clock >= begin) & (clock <= end)]
    print(f"{forward.mean():.2f} m/s forward in the middle {end - begin:.1f} s of the robot's time")
    assert abs(forward.mean() - 0.6) < 0.2  # 0.54 and 0.47 where the robot lost 4 and 9 s of 18
    kept = recording.read(next(tmp_path.glob("*.parquet")))
    assert (kept.meta.source, "does not tell what it obeys" in kept.meta.notes) == ("measured", True)
    torque = kept.joint("tau_est") * 256
    np.testing.assert_allclose(torque, np.rint(torque), atol=1e-6)


def _forward_speed(truth: dict[str, np.ndarray]) -> np.ndarray:
    """Return the trunk's speed along its heading, m/s."""
    w, x, y, z = (truth[f"base_quat_{part}"] for part in "wxyz")
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    forward: np.ndarray = truth["base_lin_vel_x_w"] * np.cos(heading) + truth["base_lin_vel_y_w"] * np.sin(heading)
    return forward


@pytest.fixture
def client() -> Iterator[SimpleNamespace]:
    """The vendor's client, and a socket at the robot's end to which it has spoken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", 0))
        there.settimeout(5.0)
        udp, asked, told = SDK.UDP(0xFF, LOCAL, *there.getsockname()), SDK.LowCmd(), SDK.LowState()
        udp.InitCmdData(asked)

        def exchange(packet: bytes | None = None) -> bytes:
            udp.SetSend(asked)
            udp.Send()
            sent, address = there.recvfrom(2000)
            if packet is not None:
                there.sendto(packet, address)
                time.sleep(0.05)
                udp.Recv()
                udp.GetRecv(told)
            return sent

        yield SimpleNamespace(udp=udp, asked=asked, told=told, exchange=exchange)


def test_our_commands_are_its_commands_byte_by_byte(client: SimpleNamespace) -> None:
    assert client.exchange() == wire.IDLE
    rng = np.random.default_rng(0)
    for _ in range(50):
        q, kp, kd = rng.uniform(-3, 3, 12), rng.uniform(0, 300, 12), rng.uniform(0, 20, 12)
        tau = rng.uniform(-40, 40, 12)
        for k in range(12):
            motor = client.asked.motorCmd[k]
            motor.mode, motor.q, motor.dq = 0x0A, float(q[k]), 0.0
            motor.Kp, motor.Kd, motor.tau = float(kp[k]), float(kd[k]), float(tau[k])
        assert client.exchange() == wire.pack_command(LowCmd(q, kp, kd, feedforward=tau))


def test_it_reads_every_state_as_our_runtime_does(client: SimpleNamespace) -> None:
    """The vendor's module packs no states; so it and our runtime read the same stream of ours."""
    rng = np.random.default_rng(1)
    for k in range(1, 30):
        quat = rng.normal(size=4)
        state = LowState(
            0.0,
            rng.normal(size=12),
            10.0 * rng.normal(size=12),
            15.0 * rng.normal(size=12),
            quat / np.linalg.norm(quat),
            rng.normal(size=3),
            9.81 * rng.normal(size=3),
            rng.uniform(0, 300, 4),
        )
        health = wire.Health(int(rng.integers(100)), 0.5, (3.84,) * 10, tuple(range(12)), 41)
        packet = wire.pack_state(state, 2 * k, health, rng.normal(size=3))
        client.exchange(packet)
        ours, told = wire.unpack_state(packet, 0.0, 0.0), client.told
        assert told.tick == 2 * k
        motors = told.motorState
        np.testing.assert_array_equal([motors[j].q for j in range(12)], ours.joint_pos)
        np.testing.assert_array_equal([motors[j].dq for j in range(12)], ours.joint_vel)
        np.testing.assert_array_equal([motors[j].tauEst for j in range(12)], ours.joint_torque)
        np.testing.assert_array_equal([motors[j].temperature for j in range(12)], health.motor_temperature)
        np.testing.assert_array_equal(told.imu.quaternion, ours.imu_quat)
        np.testing.assert_array_equal(told.imu.gyroscope, ours.imu_gyro)
        np.testing.assert_array_equal(told.imu.accelerometer, ours.imu_acc)
        np.testing.assert_array_equal([told.footForce[leg] for leg in range(4)], ours.foot_force)
        assert (told.bms.SOC, told.bms.current, told.bms.cell_vol[0]) == (health.charge, 500, 3840)


def test_it_too_refuses_a_wrong_checksum(client: SimpleNamespace) -> None:
    state = LowState(
        0.0, np.zeros(12), np.zeros(12), np.zeros(12), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3), np.zeros(4)
    )
    good = wire.pack_state(state, 10, wire.Health(), np.zeros(3))
    client.exchange(good)
    assert client.told.tick == 10
    bad = bytearray(wire.pack_state(state, 12, wire.Health(), np.zeros(3)))
    bad[90] ^= 1
    client.exchange(bytes(bad))
    assert client.told.tick == 10
    client.exchange(wire.pack_state(state, 14, wire.Health(), np.zeros(3)))
    assert client.told.tick == 14


def test_its_position_limit_is_the_range_to_which_our_targets_are_limited(client: SimpleNamespace) -> None:
    from go1exp.deploy.runtime.safety import sdk_range

    guard = SDK.Safety(SDK.LeggedType.Go1)
    for far, side in ((-9.0, 0), (9.0, 1)):
        for k in range(12):
            motor = client.asked.motorCmd[k]
            motor.mode, motor.q, motor.dq, motor.Kp, motor.Kd, motor.tau = 0x0A, far, 0.0, 20.0, 0.5, 0.0
        guard.PositionLimit(client.asked)
        limited = [client.asked.motorCmd[k].q for k in range(12)]
        np.testing.assert_allclose(limited, sdk_range(robot.JOINTS)[:, side], atol=1e-5)
