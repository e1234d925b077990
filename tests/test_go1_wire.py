"""The Go1's packets: layout, rounding, checksum, refusals; bytes that the vendor's binary sent and accepted."""

from __future__ import annotations

import math
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from go1exp.deploy.runtime import go1_wire as wire
from go1exp.deploy.runtime.udp import Go1Link
from go1exp.deploy.sim_robot import SimConfig
from go1exp.deploy.sim_robot.machine import Robot
from go1exp.deploy.sim_robot.server import Packets, Server, roll_pitch_yaw
from go1exp.robot import go1_fields as fields
from go1exp.robot.messages import LowCmd, LowState

# Bytes of unitree-legged-sdk 3.8.20231105, received on a socket: InitCmdData, then twelve motors set to
# q = linspace(-1, 1, 12), dq = 0, tau = 0.37 k - 2, Kp = 20 + 0.37 k, Kd = 0.5 + 0.07 k.
BEGIN = "feefff00" + 18 * "00"
STOPPED = "0ab9d2ff4e00007a46" + 18 * "00"
END = 44 * "00" + "00000000"
VENDOR_IDLE = bytes.fromhex(BEGIN + 20 * STOPPED + END + "e2f07f34")
VENDOR_MOTORS = (
    *("0a000080bf0000000000fe80020800", "0a5d7451bf000000005ffe8b020900", "0abae822bf00000000befe97020a00"),
    *("0a2fbae8be000000001dffa3020b00", "0ae9a28bbe000000007bffaf020c00", "0a8c2ebabd00000000daffbb020d00"),
    *("0a8c2eba3d000000003800c7020e00", "0ae9a28b3e000000009700d2020f00", "0a2fbae83e00000000f500de021000"),
    *("0abae8223f000000005401ea021200", "0a5d74513f00000000b301f6021300", "0a0000803f00000000110202031400"),
)
VENDOR_COMMAND = bytes.fromhex(
    BEGIN + "".join(motor + 24 * "0" for motor in VENDOR_MOTORS) + 8 * STOPPED + END + "432758d6"
)

Q = np.linspace(-1.0, 1.0, 12)


def command(**changes: Any) -> LowCmd:
    k = np.arange(12)
    usual = {"joint_target": Q, "kp": 20 + 0.37 * k, "kd": 0.5 + 0.07 * k, "feedforward": 0.37 * k - 2.0}
    return LowCmd(**{**usual, **changes})


def state(**changes: Any) -> LowState:
    usual: dict[str, Any] = {
        "joint_pos": Q,
        "joint_vel": 10.0 * Q,
        "joint_torque": 30.0 * Q,
        "imu_quat": np.array([0.5, 0.5, -0.5, 0.5]),
        "imu_gyro": np.array([0.1, 0.2, 0.3]),
        "imu_acc": np.array([1.0, 2.0, 9.8]),
        "foot_force": np.array([100.0, -3.0, 200.0, 30000.0]),
    }
    return LowState(0.0, **{**usual, **changes})


HEALTH = wire.Health(55, -1.234, (3.84,) * 10, tuple(range(30, 42)), 50, tuple(map(float, range(-6, 6))))
GOOD = wire.pack_state(state(), 123456789, HEALTH, np.array([0.1, 0.2, 0.3]))


def resealed(packet: bytes, place: int, content: bytes) -> bytes:
    """The packet with other content and the checksum that belongs to it."""
    changed = packet[:place] + content + packet[place + len(content) :]
    return changed[:-4] + wire.checksum(changed).to_bytes(4, "little")


def slow_checksum(packet: bytes) -> int:
    """The checksum bit by bit, as the SDK's documentation has it."""
    crc = 0xFFFFFFFF
    for k in range((len(packet) - 4) // 4):
        (word,) = struct.unpack_from("<I", packet, 4 * k)
        for bit in range(31, -1, -1):
            top = crc >> 31
            crc = (crc << 1) & 0xFFFFFFFF
            crc ^= 0x04C11DB7 * (top ^ (word >> bit & 1))
    return crc


# ---------------------------------------------------------------------- bytes


def test_commands_are_the_vendors_byte_by_byte() -> None:
    assert (wire.IDLE, wire.pack_command(command())) == (VENDOR_IDLE, VENDOR_COMMAND)


def test_the_checksum_is_that_of_the_vendor_and_of_its_definition() -> None:
    for packet in (VENDOR_IDLE, VENDOR_COMMAND, GOOD):
        assert wire.checksum(packet) == slow_checksum(packet) == int.from_bytes(packet[-4:], "little")
    assert [(len(packet) - 4) // 4 for packet in (VENDOR_IDLE, GOOD)] == [152, 200]


def test_every_field_has_its_unit_and_source() -> None:
    """Its offset: ``test_every_field_comes_there_and_back``."""
    assert (fields.COMMAND_TYPE.itemsize, fields.STATE_TYPE.itemsize) == (614, 807)
    for packet in (fields.COMMAND, fields.STATE, fields.MOTOR_COMMAND, fields.MOTOR_STATE, fields.IMU, fields.BATTERY):
        assert all(field.unit and field.source for field in packet)


BEGINNING = "2sBB2I2IH"
LAYOUT = {
    "command": (fields.COMMAND_TYPE, BEGINNING + 20 * "BffhHH3I" + "4B" + "40B" + "II"),
    "state": (fields.STATE_TYPE, BEGINNING + "4f3f3f3fb" + 20 * "BffhhffhbII" + "4BiH2b2b10B" + "4h4hI" + "40B" + "II"),
}
"""The packets as ``struct`` writes them, after the SDK's headers and nothing of ours."""

RANGES = {"B": (0, 2**8), "b": (-(2**7), 2**7), "H": (0, 2**16), "h": (-(2**15), 2**15), "I": (0, 2**32)}
RANGES["i"] = (-(2**31), 2**31)


def leaves(record: Any, kind: np.dtype[Any]) -> Iterator[tuple[Any, str]]:
    """The innermost fields of a record, in order: what holds them, and their name."""
    for name in kind.names or ():
        inner = kind[name].base
        if inner.names is None:
            yield record, name
        else:
            for part in np.atleast_1d(record[name]):
                yield from leaves(part, inner)


@pytest.mark.parametrize("which", LAYOUT)
def test_every_field_comes_there_and_back(which: str) -> None:
    """Random values in all fields, used or not: serial, version, bandwidth, remote, reserves, the estimated forces."""
    kind, layout = LAYOUT[which]
    codes = "".join(
        code * int(count or 1) for count, code in re.findall(r"(\d*)([BbHhIif])", layout.replace("2s", "", 1))
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        floats = (float(np.float32(value)) for value in rng.normal(scale=1e3, size=len(codes)))
        values = [next(floats) if code == "f" else int(rng.integers(*RANGES[code])) for code in codes]
        packet = struct.pack("<" + layout, b"\xfe\xef", *values)
        there, back = np.frombuffer(packet, kind)[0], np.zeros(1, kind)
        read = [there[name] if record is there else record[name] for record, name in leaves(there, kind)]
        assert read[0] == b"\xfe\xef"
        assert np.concatenate([np.ravel(value) for value in read[1:]]).tolist() == values
        for (record, name), value in zip(leaves(back[0], kind), read, strict=True):
            record[name] = value
        assert back.tobytes() == packet


def test_a_state_written_by_hand_is_read_as_the_vendors_client_read_it() -> None:
    """The client accepted this packet and gave these values."""
    by_hand = bytearray(807)
    by_hand[:3] = b"\xfe\xef\xff"
    struct.pack_into("<13fb", by_hand, 22, 0.5, 0.5, -0.5, 0.5, 0.1, 0.2, 0.3, 1.0, 2.0, 9.8, 0.1, 0.2, 0.3, 50)
    for k in range(12):
        tau = int(30.0 * Q[k] * 256)
        motor = (10, Q[k], 10.0 * Q[k], k - 6, tau, Q[k], 10.0 * Q[k], k - 6, 30 + k)
        struct.pack_into("<Bffhhffhb", by_hand, 75 + 32 * k, *motor)
    struct.pack_into("<BBBBiH4b10B", by_hand, 715, 0, 0, 0, 55, -1234, 0, 0, 0, 0, 0, *[120] * 10)
    struct.pack_into("<4h", by_hand, 739, 100, -3, 200, 30000)
    struct.pack_into("<I", by_hand, 755, 123456789)
    by_hand[-4:] = slow_checksum(bytes(by_hand)).to_bytes(4, "little")
    assert bytes(by_hand) == GOOD
    assert wire.tick_of(GOOD) == 123456789
    read = wire.unpack_state(GOOD, 7.0, 1.5)
    assert (read.t, read.clock) == (7.0, 1.5)
    assert read.joint_torque[3] == -13.6328125  # -13.6363 cut towards zero
    for name in ("joint_pos", "joint_vel", "imu_quat", "imu_gyro", "imu_acc", "foot_force"):
        np.testing.assert_allclose(getattr(read, name), getattr(state(), name), rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(read.joint_torque, 30.0 * Q, atol=1 / 256)
    assert wire.unpack_health(GOOD) == HEALTH


# ---------------------------------------------------------------------- rounding


@pytest.mark.parametrize(
    ("name", "given_", "had"),
    [
        ("feedforward", -2.35, -2.34765625),
        ("feedforward", 2.35, 2.34765625),
        ("feedforward", -0.003, 0.0),
        ("feedforward", 200.0, 127.99609375),
        ("feedforward", -200.0, -128.0),
        ("kp", 35.3, 35.28125),
        ("kp", 3000.0, 2047.96875),
        ("kp", -1.0, 0.0),
        ("kd", 1.2, 1.1875),
        ("kd", 0.5, 0.5),
        ("kd", 0.3, 0.25),
    ],
)
def test_gains_and_torques_are_cut_to_the_robots_steps_and_kept_in_its_range(
    name: str, given_: float, had: float
) -> None:
    """Beyond the range the vendor's client wraps around, 200 N m to -56: ours stops at the largest."""
    asked = wire.unpack_command(wire.pack_command(command(**{name: np.full(12, given_)})))
    assert isinstance(asked, wire.MotorCommand)
    assert set(getattr(asked, {"feedforward": "tau"}.get(name, name))) == {had}
    assert not asked.idle


finite = st.floats(-3.0, 3.0)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(finite, min_size=12, max_size=12),
    st.lists(st.floats(0, 100), min_size=12, max_size=12),
    st.lists(st.floats(-40, 40), min_size=12, max_size=12),
)
def test_a_command_comes_through_within_its_steps(q: list[float], gains: list[float], torque: list[float]) -> None:
    sent = LowCmd(np.array(q), np.array(gains), np.array(gains) / 10, feedforward=np.array(torque))
    asked = wire.unpack_command(wire.pack_command(sent))
    assert isinstance(asked, wire.MotorCommand)
    np.testing.assert_allclose(asked.q, q, rtol=1e-7, atol=1e-30)
    for got, wanted, step in ((asked.kp, gains, 1 / 32), (asked.kd, sent.kd, 1 / 16), (asked.tau, torque, 1 / 256)):
        off = np.abs(np.array(wanted)) - np.abs(got)
        assert (off >= 0).all()
        assert (off < step).all()
        assert (got * np.array(wanted) >= 0).all()
    assert not asked.dq.any()


def test_what_is_no_command_is_refused_before_it_is_sent() -> None:
    with pytest.raises(ValueError, match=r"sizes \{'joint_target': 12, 'kp': 3, 'kd': 12, 'feedforward': 12\}"):
        wire.pack_command(command(kp=np.zeros(3)))
    for name in ("joint_target", "kp", "kd", "feedforward"):
        for wrong in (math.nan, math.inf, 1e12):
            values = np.zeros(12)
            values[5] = wrong
            with pytest.raises(ValueError, match="not finite"):
                wire.pack_command(command(**{name: values}))


def test_stop_values_switch_feedback_off() -> None:
    asked = wire.unpack_command(VENDOR_IDLE)
    assert isinstance(asked, wire.MotorCommand)
    assert asked.idle
    # Gains beside a stop value mean nothing.
    packet = resealed(VENDOR_IDLE, 22, bytes.fromhex("0ab9d2ff4e00007a46" + "0000" + "8002" + "0800"))
    asked = wire.unpack_command(packet)
    assert isinstance(asked, wire.MotorCommand)
    assert (asked.kp[0], asked.kd[0], asked.idle) == (0.0, 0.0, True)
    braking = wire.unpack_command(resealed(VENDOR_COMMAND, 22, b"\0"))
    assert isinstance(braking, wire.MotorCommand)
    assert braking.damping.tolist() == [True] + [False] * 11


# ---------------------------------------------------------------------- refusals


WRONG_COMMANDS = [
    *((packet, "SIZE") for packet in (VENDOR_COMMAND[:-1], VENDOR_COMMAND + b"\0", b"", GOOD)),
    (b"\xfe\xee" + VENDOR_COMMAND[2:], "HEAD"),
    (VENDOR_COMMAND[:2] + b"\xee" + VENDOR_COMMAND[3:], "LEVEL"),
    (VENDOR_COMMAND[:-1] + b"\0", "CHECKSUM"),
    (VENDOR_COMMAND[:300] + b"\1" + VENDOR_COMMAND[301:], "CHECKSUM"),
    (resealed(VENDOR_COMMAND, 23, struct.pack("<f", math.nan)), "CONTENT"),
    (resealed(VENDOR_COMMAND, 27, struct.pack("<f", math.inf)), "CONTENT"),
    (resealed(VENDOR_COMMAND, 23, b"\1\0\x80\x7f"), "CONTENT"),  # a signalling NaN
    (resealed(VENDOR_COMMAND, 23, struct.pack("<f", 1e6)), "CONTENT"),
    (resealed(VENDOR_COMMAND, 22, b"\7"), "CONTENT"),
]
PLACES = (22, 22 + 16, 22 + 28, 75 + 1, 75 + 11 * 32 + 5)
WRONG_STATES = [
    *((packet, "SIZE") for packet in (GOOD[:-1], VENDOR_COMMAND)),
    (b"x" + GOOD[1:], "HEAD"),
    (GOOD[:2] + b"\xee" + GOOD[3:], "LEVEL"),
    (GOOD[:100] + b"\7" + GOOD[101:], "CHECKSUM"),
    *((resealed(GOOD, k, struct.pack("<f", x)), "CONTENT") for k in PLACES for x in (math.nan, math.inf, -1e10)),
]


WRONG: list[tuple[Callable[[bytes], Any], bytes, str]] = [(wire.unpack_command, *case) for case in WRONG_COMMANDS]
WRONG += [(wire.state_refusal, *case) for case in WRONG_STATES]


@pytest.mark.parametrize(("read", "packet", "why"), WRONG)
def test_a_packet_that_is_wrong_is_refused_by_name(read: Callable[[bytes], Any], packet: bytes, why: str) -> None:
    assert read(packet) is wire.Refusal[why]
    assert wire.state_refusal(GOOD) is None


LISTENER = Packets(SimConfig())


def mutated(packet: bytes) -> st.SearchStrategy[tuple[bytes, bool]]:
    """The packet with bytes changed, cut, doubled, moved or replaced, never the packet itself; and whether it is whole.

    Half of those of the right size have a checksum of their own, so that what is in them is looked at.
    """
    place = st.integers(0, len(packet) - 1)
    changed = st.dictionaries(place, st.integers(1, 255), min_size=1, max_size=8).map(
        lambda edits: bytes(b ^ edits.get(k, 0) for k, b in enumerate(packet))
    )
    cut = place.map(lambda k: packet[:k])
    longer = st.binary(min_size=1, max_size=40).map(lambda more: packet + more)
    moved = place.map(lambda k: packet[k:] + packet[:k])
    odd = st.tuples(
        st.integers(22, len(packet) - 8), st.sampled_from([math.nan, math.inf, -math.inf, 3e38, -2e9, 101.0])
    )
    spoilt = odd.map(lambda one: packet[: one[0]] + struct.pack("<f", one[1]) + packet[one[0] + 4 :])
    anything = st.one_of(st.binary(max_size=900), st.binary(min_size=len(packet), max_size=len(packet)))
    data = st.one_of(changed, cut, longer, moved, spoilt, anything).filter(lambda data: data != packet)

    def perhaps_sealed(drawn: tuple[bytes, bool]) -> tuple[bytes, bool]:
        data, seal = drawn
        if seal and len(data) == len(packet):
            return resealed(data, 0, b"\xfe\xef\xff"), True
        return data, covers_nothing(data, packet)

    return st.tuples(data, st.booleans()).map(perhaps_sealed)


def covers_nothing(packet: bytes, original: bytes) -> bool:
    """Whether it differs only in the bytes that no checksum covers, the last two or three of ``reserve``."""
    covered = (len(original) - 4) // 4 * 4
    return packet[:covered] == original[:covered] and packet[-4:] == original[-4:] and len(packet) == len(original)


class Statue:
    """Stands for a robot: keeps what it obeys, and never moves."""

    clock = 0.0

    def __init__(self) -> None:
        self.applied_commands: list[LowCmd] = []

    def apply(self, asked: LowCmd) -> None:
        self.applied_commands.append(asked)

    def release(self) -> None:
        self.applied_commands.append(LowCmd(np.zeros(12), np.zeros(12), np.zeros(12)))

    def step(self) -> None:
        self.clock += fields.PERIOD

    def sense(self) -> tuple[LowState, np.ndarray]:
        return state(), np.zeros(13)

    def applied(self) -> np.ndarray:
        return np.zeros(13)


End = tuple[Any, socket.socket, Any]
Linked = tuple[Go1Link, socket.socket, tuple[str, int]]


@pytest.fixture(scope="module")
def listening() -> Iterator[End]:
    """A simulated robot's server, a socket that speaks to it, and where to."""
    server = Server(cast("Robot", Statue()), SimConfig())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        yield server, client, server.address
    server.close()


def meet_command(end: End, packet: bytes, whole: bool) -> None:
    """Send a packet to the robot; what it obeys is within every bound, and of what is not whole it obeys nothing."""
    server, client, to = end
    client.sendto(packet, to)
    before, server.robot.applied_commands[:] = server.counts.foreign, []
    with np.errstate(all="raise"):
        server.tick()
    obeyed = server.robot.applied_commands
    assert len(obeyed) + server.counts.foreign - before == 1  # obeyed, or refused and counted
    assert whole or not obeyed
    most = {"joint_target": wire.FARTHEST, "kp": 2048.0, "kd": 4096.0, "feedforward": 128.0 + 4096.0 * wire.FASTEST}
    for name, bound in most.items():
        values = [getattr(one, name) for one in obeyed if getattr(one, name) is not None]
        assert (np.abs(values) <= bound).all(), name  # NaN is not


@contextmanager
def linked(tick_s: float = 0.001) -> Iterator[Linked]:
    """A link, the socket of a robot to which it has spoken, and where to."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        other.settimeout(5.0)
        link = Go1Link("127.0.0.1", other.getsockname()[1], tick_s)
        assert link.receive() == []
        data, address = other.recvfrom(1000)
        assert data == wire.IDLE  # asks for nothing until there is a command
        yield link, other, address
        link.close()


@pytest.fixture(scope="module")
def looking() -> Iterator[Linked]:
    with linked() as end:
        yield end


def meet_state(end: End, packet: bytes, whole: bool) -> None:
    """Send a packet to the runtime; what it reads is finite, and of what is not whole it believes nothing."""
    link, other, to = end
    link.tick, before = None, link.traffic.foreign  # no tick is late
    other.sendto(packet, to)
    with np.errstate(all="raise"):
        states = link.receive()
    assert len(states) + link.traffic.foreign - before == 1
    assert whole or not states
    for one in states:
        parts = (getattr(one, name) for name in ("joint_pos", "joint_vel", "imu_quat", "imu_gyro", "imu_acc"))
        assert (np.abs(np.concatenate([*parts])) <= wire.BEYOND).all()
        assert (np.abs(one.joint_torque) <= 128.0).all()
        assert (np.abs(one.foot_force) <= 2.0**15).all()
        assert math.isfinite(one.clock + one.t)
        health = wire.unpack_health(link.newest)
        assert np.isfinite([health.current, *health.cell_voltage, *health.acceleration]).all()


MANY = settings(max_examples=10_000, deadline=None, suppress_health_check=[HealthCheck.too_slow])
FEW = settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.slow("go1exp/deploy/runtime/go1_wire.py", "go1exp/deploy/sim_robot/server.py")
@MANY
@given(mutated(VENDOR_COMMAND))
def test_of_ten_thousand_mutated_commands_none_is_obeyed(listening: End, packet: tuple[bytes, bool]) -> None:
    meet_command(listening, *packet)


@pytest.mark.slow("go1exp/deploy/runtime/go1_wire.py", "go1exp/deploy/runtime/udp.py")
@MANY
@given(mutated(GOOD))
def test_of_ten_thousand_mutated_states_none_is_believed(looking: End, packet: tuple[bytes, bool]) -> None:
    meet_state(looking, *packet)


@FEW
@given(mutated(VENDOR_COMMAND))
def test_a_mutated_command_raises_nothing_and_is_not_obeyed(listening: End, packet: tuple[bytes, bool]) -> None:
    meet_command(listening, *packet)


@FEW
@given(mutated(GOOD))
def test_a_mutated_state_raises_nothing_and_is_not_believed(looking: End, packet: tuple[bytes, bool]) -> None:
    meet_state(looking, *packet)


def test_what_is_not_mutated_is_obeyed_and_believed(listening: End, looking: End) -> None:
    """The ways that the mutated ones take do let the good ones through."""
    meet_command(listening, VENDOR_COMMAND, True)
    assert [one.kp[0] for one in listening[0].robot.applied_commands] == [20.0]
    received = looking[0].traffic.received
    meet_state(looking, GOOD, True)
    assert looking[0].traffic.received == received + 1


# ---------------------------------------------------------------------- the link


@pytest.fixture
def pair() -> Iterator[Linked]:
    with linked() as end:
        yield end


def sent(tick: int) -> bytes:
    return wire.pack_state(state(), tick, HEALTH, np.zeros(3))


def test_a_link_leaves_out_what_is_old_doubled_or_damaged_and_counts_it(pair: Linked) -> None:
    link, other, address = pair
    for data in (GOOD[:-1], VENDOR_COMMAND, GOOD[:80] + b"\7" + GOOD[81:], b""):
        other.sendto(data, address)
    for tick in (10, 12, 12, 8, 18, 16, 10, 16):
        other.sendto(sent(tick), address)
    assert [round(1e3 * one.clock) for one in link.receive()] == [10, 12, 18, 16]  # 16 was overtaken
    traffic = link.traffic
    assert (traffic.received, traffic.overtaken, traffic.late, traffic.lost, traffic.foreign) == (4, 1, 4, 1, 4)
    for tick in (38, 26, 28):  # 12 and 10 ms older than the newest: the first is of no use any more
        other.sendto(sent(tick), address)
    assert [round(1e3 * one.clock) for one in link.receive()] == [38, 28]
    assert (traffic.received, traffic.overtaken, traffic.late, traffic.lost) == (6, 2, 5, 9)
    assert traffic.refused_because == {"wrong size": 3, "wrong checksum": 1}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(sent(20), address)
    assert link.receive() == []  # the kernel lets nobody else through
    assert link.traffic.foreign == 4


def test_a_link_reports_when_a_state_arrived_not_when_it_was_read(pair: Linked) -> None:
    link, other, address = pair
    other.sendto(sent(2), address)
    time.sleep(0.05)
    before = time.perf_counter()
    (one,) = link.receive()
    assert before - one.t >= 0.045 or before <= one.t  # or the kernel gives no stamps
    assert one.t <= time.perf_counter()


def test_a_robot_that_is_gone_is_no_error_of_the_link() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        port = gone.getsockname()[1]
    link = Go1Link("127.0.0.1", port)
    for _ in range(5):
        link.send(command())
        assert link.receive() == []
    assert link.traffic.sent == 5
    link.close()


def test_a_tick_wraps_around(pair: Linked) -> None:
    link, other, address = pair
    for tick in (2**32 - 4, 0, 2**32 - 2, 2):
        other.sendto(sent(tick), address)
    clocks = [one.clock for one in link.receive()]
    np.testing.assert_allclose(np.diff(clocks), [0.004, -0.002, 0.004], atol=1e-9)
    assert link.traffic.late == 0


def test_the_clock_of_a_state_is_its_tick_however_many_came_before(pair: Linked) -> None:
    """After weeks, where a sum of periods would have drifted the most in so few states."""
    link, other, address = pair
    first, clocks = 2**32 - 500, []
    for k in range(500):
        other.sendto(sent((first + 2 * k) % 2**32), address)
        clocks += [one.clock for one in link.receive()]
    np.testing.assert_allclose(clocks, 0.001 * (first + 2.0 * np.arange(500)), rtol=0.0, atol=1e-9)


def test_a_command_is_sent_again_between_two_cycles(pair: Linked) -> None:
    link, other, _ = pair
    link.send(command())
    link.repeat()  # at once: it has just been sent
    time.sleep(0.003)
    link.repeat()
    other.setblocking(False)
    packets = [other.recv(1000) for _ in range(2)]
    assert packets == [VENDOR_COMMAND, VENDOR_COMMAND]
    with pytest.raises(BlockingIOError):
        other.recv(1000)


def test_without_the_ticks_unit_a_state_has_no_clock() -> None:
    with linked(math.nan) as (link, other, address):
        for tick in (2, 4, 3):
            other.sendto(sent(tick), address)
        assert [math.isnan(one.clock) for one in link.receive()] == [True, True]
        assert (link.traffic.late, link.traffic.lost) == (1, 0)
        # The check before a walk measures the unit on this link: from then on states have a clock.
        link.tick_s = 0.001
        for tick in (6, 12, 10, 14):
            other.sendto(sent(tick), address)
        assert [round(1e3 * one.clock) for one in link.receive()] == [6, 12, 10, 14]
        assert (link.traffic.overtaken, link.traffic.late, link.traffic.lost) == (1, 1, 1)


# ---------------------------------------------------------------------- the simulated robot's side


def test_a_damping_motor_and_a_wanted_speed_reach_the_drives() -> None:
    packet = resealed(VENDOR_COMMAND, 22, b"\0")  # the first motor brakes by itself
    packet = resealed(packet, 22 + 27 + 5, struct.pack("<f", 2.0))  # the second is to turn at 2 rad/s
    told = LISTENER.read(packet)
    assert isinstance(told, LowCmd)
    assert told.feedforward is not None
    assert (told.kp[0], told.kd[0], told.feedforward[0], told.damping) == (0.0, 2.0, 0.0, False)
    assert told.feedforward[1] == pytest.approx(-1.62890625 + 2.0 * 0.5625)
    assert LISTENER.read(VENDOR_IDLE) is None


def test_roll_pitch_and_yaw_are_those_of_scipy() -> None:
    from scipy.spatial.transform import Rotation

    for turn in Rotation.random(50, rng=0):
        yaw, pitch, roll = turn.as_euler("ZYX")
        np.testing.assert_allclose(roll_pitch_yaw(turn.as_quat(scalar_first=True)), [roll, pitch, yaw], atol=1e-7)
