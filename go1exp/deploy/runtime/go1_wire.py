"""The Go1's low-level UDP protocol: commands of 614 bytes, states of 807, as the vendor's SDK 3.8.6 sends and expects.

Fields, scales and units are in ``go1_fields``. Never tried on a robot. A packet of another size, head, level or
checksum is rejected (``refusal``).
"""

from __future__ import annotations

import math
import zlib
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from go1exp.robot.go1_fields import (
    ACCELERATION_STEP,
    COMMAND_SIZE,
    COMMAND_TYPE,
    DAMPING,
    HEAD,
    JOINTS,
    KD_STEP,
    KP_STEP,
    LOW_LEVEL,
    POSITION_STOP,
    SERVO,
    STATE_SIZE,
    STATE_TYPE,
    TORQUE_STEP,
    VELOCITY_STOP,
)
from go1exp.robot.messages import LowCmd, LowState

# ---------------------------------------------------------------------- checksum and refusals

_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
"""Each byte with its bits in reverse order."""


def checksum(packet: bytes | bytearray) -> int:
    """Return the CRC of all whole 32-bit words before the last four bytes of a packet.

    It is CRC-32/MPEG-2 (polynomial 0x04C11DB7, start 0xFFFFFFFF) over the words' most significant bits first. zlib's
    CRC-32 is the same division with every bit order reversed, so words are reversed on the way in and the result on
    the way out.
    """
    words = (len(packet) - 4) // 4
    whole = array("I", bytes(packet[: 4 * words]))
    whole.byteswap()
    plain = zlib.crc32(whole.tobytes().translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(plain.to_bytes(4, "little").translate(_REVERSED), "big")


class Refusal(Enum):
    """Reason of the rejection of a packet; the value is its text."""

    SIZE = "wrong size"
    HEAD = "wrong head"
    LEVEL = "not of the low level"
    CHECKSUM = "wrong checksum"
    CONTENT = "impossible number"


def refusal(packet: bytes, size: int) -> Refusal | None:
    """Return the reason to reject a packet that should have ``size`` bytes; None if it is valid."""
    if len(packet) != size:
        return Refusal.SIZE
    if packet[:2] != HEAD:
        return Refusal.HEAD
    if packet[2] != LOW_LEVEL:
        return Refusal.LEVEL
    if int.from_bytes(packet[-4:], "little") != checksum(packet):
        return Refusal.CHECKSUM
    return None


def sealed(packet: np.ndarray) -> bytes:
    """Return a packet's bytes with its checksum."""
    data: bytes = packet.tobytes()
    return data[:-4] + checksum(data).to_bytes(4, "little")


# ---------------------------------------------------------------------- commands


def _blank(kind: np.dtype[np.void]) -> np.ndarray:
    packet = np.zeros(1, kind)
    packet["head"], packet["level"] = HEAD, LOW_LEVEL
    return packet


def _idle() -> bytes:
    packet = _blank(COMMAND_TYPE)
    motors = packet["motor"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, POSITION_STOP, VELOCITY_STOP
    return sealed(packet)


IDLE = _idle()
"""The vendor's InitCmdData, byte by byte: a command without any torque, to which the robot answers."""


def _bytes_of(kind: np.dtype[np.void], *paths: tuple[str, ...]) -> np.ndarray:
    """Return the byte offsets of fields in a packet, of the twelve motors in order: (bytes,).

    Indexing bytes by these offsets is several times as fast as NumPy's records.
    """
    places = []
    for path in paths:
        part, offsets = kind, np.arange(kind.itemsize, dtype=np.intp).reshape(1, -1)
        for name in path:
            assert part.fields is not None
            inner, offset = part.fields[name][:2]
            part, offsets = inner.base, offsets[:, offset : offset + inner.itemsize].reshape(-1, inner.base.itemsize)
            offsets = offsets[:JOINTS] if name == "motor" else offsets
        places.append(offsets.ravel())
    return np.concatenate(places)


_U1, _F4, _I2, _U2 = (np.dtype(kind) for kind in ("u1", "<f4", "<i2", "<u2"))

_REACH = {kind: (int(np.iinfo(kind).min), int(np.iinfo(kind).max)) for kind in (_I2, _U2)}


def _whole(values: Sequence[float], step: float, kind: np.dtype[np.integer]) -> list[int]:
    """Return values in whole steps, cut towards zero and to a type's range; lists of a dozen are faster than NumPy."""
    low, high = _REACH[kind]
    whole = [int(value / step) for value in values]  # exact: a step is a power of two
    return whole if low <= min(whole) and max(whole) <= high else [min(max(n, low), high) for n in whole]


def _motors(packet: bytearray, kind: np.dtype[np.void]) -> np.ndarray:
    """Return the twelve motors in a packet, to be written."""
    motors: np.ndarray = np.frombuffer(packet, kind)["motor"][0]
    return motors[:JOINTS]


def _checked(numbers: Sequence[float]) -> Sequence[float]:
    """Return numbers of a command; raise ValueError if one is beyond any Go1."""
    if not _within(numbers, BEYOND):
        raise ValueError("a command has a part that is not finite, or impossible")
    return numbers


def _within(values: Sequence[float], bound: float) -> bool:
    """Return whether no value is beyond ``bound`` in either direction, or NaN. Of a dozen, faster than NumPy."""
    return max(values) <= bound and min(values) >= -bound and not math.isnan(sum(values))


@lru_cache(maxsize=8)
def _with_gains(kp: bytes, kd: bytes) -> bytes:
    """Return the packet of a command with these gains, double-precision numbers, and targets of zero."""
    packet = bytearray(IDLE)
    motors = _motors(packet, COMMAND_TYPE)
    motors["q"] = motors["dq"] = 0.0
    for name, gains, step in (("kp", kp, KP_STEP), ("kd", kd, KD_STEP)):
        motors[name] = _whole(_checked(array("d", gains).tolist()), step, _U2)
    return bytes(packet)


def pack_command(command: LowCmd) -> bytes:
    """Return the packet of a command; gains and torques are cut to the robot's steps and ranges.

    Raises:
        ValueError: if a part has another size than a Go1's, or is not finite.
    """
    given = (command.joint_target, command.kp, command.kd, command.feedforward)
    q, kp, kd, *rest = (np.asarray(part, float) for part in given if part is not None)
    if any(part.shape != (JOINTS,) for part in (q, kp, kd, *rest)):
        raise ValueError(f"a command's parts have the sizes {_sizes(command)}; a Go1's have {JOINTS}")
    packet = bytearray(_with_gains(kp.tobytes(), kd.tobytes()))  # gains seldom change
    motors = _motors(packet, COMMAND_TYPE)
    motors["q"] = _checked(q.tolist())
    for tau in rest:
        motors["tau"] = _whole(_checked(tau.tolist()), TORQUE_STEP, _I2)
    packet[-4:] = checksum(packet).to_bytes(4, "little")
    return bytes(packet)


def gains_on_wire(kp: np.ndarray, kd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains (J,) that a packet carries: cut to whole steps."""
    return np.trunc(np.asarray(kp) / KP_STEP) * KP_STEP, np.trunc(np.asarray(kd) / KD_STEP) * KD_STEP


def _sizes(command: LowCmd) -> dict[str, int]:
    names = ("joint_target", "kp", "kd", "feedforward")
    return {name: np.size(getattr(command, name)) for name in names if getattr(command, name) is not None}


class MotorCommand(NamedTuple):
    """Command of the twelve motors: torque = kp (q* - q) + kd (dq* - dq) + tau, each (12,).

    Attributes:
        q: rad; without meaning where ``kp`` is zero.
        dq: rad/s.
        tau: N m.
        kp: N m/rad; zero where the packet has POSITION_STOP.
        kd: N m s/rad; zero where it has VELOCITY_STOP.
        damping: (12,) bool: the motor brakes, whatever else is commanded.
    """

    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    damping: np.ndarray

    @property
    def idle(self) -> bool:
        """Whether no motor gets any torque."""
        return not (self.kp.any() or self.kd.any() or self.tau.any() or self.damping.any())


FASTEST, FARTHEST, BEYOND = 1000.0, 100.0, 1e9
"""Largest commanded |dq| and |q|, rad/s and rad, and bound of every other number (chosen)."""


def unpack_command(packet: bytes) -> MotorCommand | Refusal:
    """Return the command of a packet, or the reason of its rejection."""
    if wrong := refusal(packet, COMMAND_SIZE):
        return wrong
    data = np.frombuffer(packet, _U1)
    listed = data[_TARGETS].view(_F4).tolist()
    floats, gains = np.array(listed), data[_GAINS].view(_U2) * _GAIN_STEPS  # NumPy's cast warns of a signalling NaN
    q, dq, kp, kd = floats[:JOINTS], floats[JOINTS:], gains[:JOINTS], gains[JOINTS:]
    if _FREE in listed or _LOOSE in listed:
        free, loose = q == _FREE, dq == _LOOSE
        q[free] = kp[free] = dq[loose] = kd[loose] = 0.0
        listed = floats.tolist()
    modes = data[_MODES]
    known = modes.tobytes() == _ALL_SERVO or {*modes.tolist()} <= {SERVO, DAMPING}
    if not (known and _within(listed[:JOINTS], FARTHEST) and _within(listed[JOINTS:], FASTEST)):
        return Refusal.CONTENT
    return MotorCommand(q, dq, data[_TORQUES].view(_I2) * TORQUE_STEP, kp, kd, modes == DAMPING)


_TARGETS, _TORQUES = _bytes_of(COMMAND_TYPE, ("motor", "q"), ("motor", "dq")), _bytes_of(COMMAND_TYPE, ("motor", "tau"))
_GAINS, _GAIN_STEPS = _bytes_of(COMMAND_TYPE, ("motor", "kp"), ("motor", "kd")), np.repeat([KP_STEP, KD_STEP], JOINTS)
_MODES, _ALL_SERVO = _bytes_of(COMMAND_TYPE, ("motor", "mode")), bytes([SERVO]) * JOINTS
_FREE, _LOOSE = float(np.float32(POSITION_STOP)), float(np.float32(VELOCITY_STOP))


# ---------------------------------------------------------------------- states

NUMBERS = 2**32
"""The tick wraps around here."""


@dataclass(frozen=True)
class Health:
    """Part of a state that the runtime does not control by.

    Attributes:
        charge: of the battery, percent.
        current: of the battery, A.
        cell_voltage: (10,) V.
        motor_temperature: (12,) degrees Celsius.
        imu_temperature: degrees Celsius.
        acceleration: (12,) of the joints, rad/s2.
    """

    charge: int = 80
    current: float = -2.0
    cell_voltage: tuple[float, ...] = (3.84,) * 8 + (0.0, 0.0)
    motor_temperature: tuple[int, ...] = (30,) * JOINTS
    imu_temperature: int = 40
    acceleration: tuple[float, ...] = (0.0,) * JOINTS


@lru_cache(maxsize=8)
def _with_health(health: Health) -> bytes:
    """Return the packet of a state without readings."""
    packet = bytearray(sealed(_blank(STATE_TYPE)))
    record, motors = np.frombuffer(packet, STATE_TYPE)[0], _motors(packet, STATE_TYPE)
    record["imu"]["temperature"], battery = health.imu_temperature, record["battery"]
    battery["charge"], battery["current"] = health.charge, round(1000.0 * health.current)
    battery["cell_voltage"] = [round(1000.0 * volts / 32.0) for volts in health.cell_voltage]
    motors["mode"], motors["temperature"] = SERVO, health.motor_temperature
    motors["ddq"] = motors["ddq_raw"] = _whole(health.acceleration, ACCELERATION_STEP, _I2)
    return bytes(packet)


_READ = (("motor", "q"), ("motor", "dq"), ("imu", "quat"), ("imu", "gyro"), ("imu", "acc"))
_READINGS = _bytes_of(STATE_TYPE, *_READ)
_WRITTEN = _bytes_of(STATE_TYPE, *_READ, ("motor", "q_raw"), ("motor", "dq_raw"), ("imu", "rpy"))
_STATE_WHOLE = _bytes_of(STATE_TYPE, ("motor", "tau"), ("foot_force",))
_TICK = _bytes_of(STATE_TYPE, ("tick",))


def pack_state(state: LowState, tick: int, health: Health, rpy: np.ndarray) -> bytes:
    """Return the packet of a state, as the robot would send it.

    Args:
        state: readings; ``t`` and ``clock`` are not carried.
        tick: time, ms; wraps around at 2**32.
        health: everything else.
        rpy: (3,) roll, pitch and yaw, rad.
    """
    packet = bytearray(_with_health(health))  # changes seldom
    data, q, qd = np.frombuffer(packet, _U1), state.joint_pos, state.joint_vel
    floats = np.concatenate([q, qd, state.imu_quat, state.imu_gyro, state.imu_acc, q, qd, rpy])
    data[_WRITTEN] = floats.astype(_F4).view(_U1)
    whole = _whole(state.joint_torque.tolist(), TORQUE_STEP, _I2) + _whole(state.foot_force.tolist(), 1.0, _I2)
    data[_STATE_WHOLE] = np.array(whole, _I2).view(_U1)
    data[_TICK] = np.frombuffer((tick % NUMBERS).to_bytes(4, "little"), _U1)
    packet[-4:] = checksum(packet).to_bytes(4, "little")
    return bytes(packet)


def state_refusal(packet: bytes) -> Refusal | None:
    """Return the reason to reject a state's packet; also for a reading that is not finite, or impossible."""
    if wrong := refusal(packet, STATE_SIZE):
        return wrong
    readings = np.frombuffer(packet, _U1)[_READINGS].view(_F4).tolist()
    return None if _within(readings, BEYOND) else Refusal.CONTENT


def tick_of(packet: bytes) -> int:
    """Return the tick of a state's packet."""
    return int.from_bytes(packet[755:759], "little")


def unpack_state(packet: bytes, t: float, clock: float) -> LowState:
    """Return the readings in a valid packet of a state.

    Args:
        packet: see ``state_refusal``.
        t: when it arrived, on the runtime's clock, s.
        clock: its tick in s; NaN if the tick's unit is not known.
    """
    data = np.frombuffer(packet, _U1)
    floats, whole = data[_READINGS].view(_F4).astype(float), data[_STATE_WHOLE].view(_I2)
    return LowState(
        t=t,
        joint_pos=floats[:JOINTS],
        joint_vel=floats[JOINTS : 2 * JOINTS],
        joint_torque=whole[:JOINTS] * TORQUE_STEP,
        imu_quat=floats[24:28],
        imu_gyro=floats[28:31],
        imu_acc=floats[31:],
        foot_force=whole[JOINTS:].astype(float),
        clock=clock,
    )


def unpack_health(packet: bytes) -> Health:
    """Return everything else in a valid packet of a state."""
    record = np.frombuffer(packet, STATE_TYPE)[0]
    motors, battery = record["motor"][:JOINTS], record["battery"]
    return Health(
        charge=int(battery["charge"]),
        current=1e-3 * int(battery["current"]),
        cell_voltage=tuple(0.032 * float(value) for value in battery["cell_voltage"]),
        motor_temperature=tuple(map(int, motors["temperature"])),
        imu_temperature=int(record["imu"]["temperature"]),
        acceleration=tuple(map(float, motors["ddq"] * ACCELERATION_STEP)),
    )


def newer(tick: int, than: int) -> int:
    """Return by how much a tick is ahead of another; negative if it is older. Wrap-around is handled."""
    return (tick - than + NUMBERS // 2) % NUMBERS - NUMBERS // 2
