"""The Go1's low-level UDP protocol: commands of 614 bytes, states of 807, as the vendor's SDK 3.8.6 sends and expects.

Little-endian, packed. Layout, scales, rounding and checksum were read off the vendor's compiled client
(``unitree-legged-sdk`` 3.8.20231105) by exchanging packets with it; nothing here was tried on a robot.
A packet of another size, head, level or checksum is refused (``refusal``). No function here knows a socket.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from go1exp.deploy.messages import LowCmd, LowState

COMMAND_SIZE, STATE_SIZE = 614, 807
HEAD, LOW_LEVEL = b"\xfe\xef", 0xFF
ROBOT, ROBOT_PORT = "192.168.123.10", 8007
"""Address of the robot's motor board for low-level commands (the SDK's examples)."""

JOINTS, MOTORS, LEGS = 12, 20, 4
PERIOD = 0.002
"""Period at which the vendor's client sends, and at which the robot answers, s."""

SERVO, DAMPING = 0x0A, 0x00
"""Modes of a motor: it follows gains and targets; it brakes by itself."""

POSITION_STOP, VELOCITY_STOP = 2.146e9, 16000.0
"""Values of q and dq that switch off a motor's position and speed feedback (``comm.h``: PosStopF, VelStopF)."""

TORQUE_STEP, KP_STEP, KD_STEP, ACCELERATION_STEP = 1.0 / 256.0, 1.0 / 32.0, 1.0 / 16.0, 1.0
"""Steps of the fixed-point numbers: N m, N m/rad, N m s/rad, rad/s2. All are cut towards zero."""

TORQUE_RANGE = (-32768 * TORQUE_STEP, 32767 * TORQUE_STEP)
KP_MOST, KD_MOST = 65535 * KP_STEP, 65535 * KD_STEP


class Field(NamedTuple):
    """One field of a packet: NumPy's type, its unit (of the number times ``step``), and where that is known from."""

    name: str
    kind: str
    unit: str
    source: str
    step: float = 1.0


SDK = "comm.h of SDK 3.8.6"
TRIED = "exchanged with the vendor's client"
GUESS = "free-dog-sdk; not verified"

_BEGIN = (
    Field("head", "S2", "FE EF", TRIED),
    Field("level", "u1", "0xFF: low level", TRIED),
    Field("frame_reserve", "u1", "-", SDK),
    Field("serial", "(2,)<u4", "-; the vendor's client sends 0", TRIED),
    Field("version", "(2,)<u4", "-; the vendor's client sends 0", TRIED),
    Field("bandwidth", "<u2", "-; the vendor's client sends 0", TRIED),
)
MOTOR_COMMAND = (
    Field("mode", "u1", "SERVO or DAMPING", SDK),
    Field("q", "<f4", "rad; POSITION_STOP: no position feedback", TRIED),
    Field("dq", "<f4", "rad/s; VELOCITY_STOP: no speed feedback", TRIED),
    Field("tau", "<i2", "N m", TRIED, TORQUE_STEP),
    Field("kp", "<u2", "N m/rad", TRIED, KP_STEP),
    Field("kd", "<u2", "N m s/rad", TRIED, KD_STEP),
    Field("reserve", "(3,)<u4", "-", SDK),
)
MOTOR_STATE = (
    Field("mode", "u1", "SERVO, DAMPING or 0x08: too hot", SDK),
    Field("q", "<f4", "rad", TRIED),
    Field("dq", "<f4", "rad/s", TRIED),
    Field("ddq", "<i2", "rad/s2", TRIED, ACCELERATION_STEP),
    Field("tau", "<i2", "N m, estimated by the drive", TRIED, TORQUE_STEP),
    Field("q_raw", "<f4", "rad", TRIED),
    Field("dq_raw", "<f4", "rad/s", TRIED),
    Field("ddq_raw", "<i2", "rad/s2", TRIED, ACCELERATION_STEP),
    Field("temperature", "i1", "degrees Celsius", TRIED),
    Field("reserve", "(2,)<u4", "-", SDK),
)
IMU = (
    Field("quat", "(4,)<f4", "w-x-y-z, trunk to world", TRIED),
    Field("gyro", "(3,)<f4", "rad/s, trunk frame", TRIED),
    Field("acc", "(3,)<f4", "m/s2, specific force, trunk frame", TRIED),
    Field("rpy", "(3,)<f4", "rad: roll, pitch, yaw", TRIED),
    Field("temperature", "i1", "degrees Celsius", TRIED),
)
BATTERY = (
    Field("version", "(2,)u1", "high, low", TRIED),
    Field("status", "u1", "-", SDK),
    Field("charge", "u1", "percent", TRIED),
    Field("current", "<i4", "mA", SDK),
    Field("cycles", "<u2", "charging cycles", SDK),
    Field("cell_temperature", "(2,)i1", "degrees Celsius", SDK),
    Field("board_temperature", "(2,)i1", "degrees Celsius", SDK),
    Field("cell_voltage", "(10,)u1", "mV", GUESS, 32.0),
)
_END = (Field("remote", "(40,)u1", "the handheld controller's bytes", SDK), Field("reserve", "<u4", "-", SDK))
_CRC = (Field("crc", "<u4", "checksum of the words before it", TRIED),)


def dtype_of(fields: tuple[Field, ...], **parts: tuple[np.dtype[Any], tuple[int, ...]]) -> np.dtype[Any]:
    """Return the packed type of ``fields``, in which ``parts`` gives the type and shape of nested ones."""
    return np.dtype([(f.name, *parts[f.name]) if f.name in parts else (f.name, f.kind) for f in fields])


COMMAND = (
    *_BEGIN,
    Field("motor", "V27", "MOTOR_COMMAND, 20 of them: FR FL RR RL x hip thigh calf, then 8 that a Go1 lacks", TRIED),
    Field("battery_off", "(4,)u1", "0xA5 in the first byte switches the battery off; the rest is reserve", SDK),
    *_END,
    *_CRC,
)
STATE = (
    *_BEGIN,
    Field("imu", "V53", "IMU", TRIED),
    Field("motor", "V32", "MOTOR_STATE, 20 of them in the order of the command's", TRIED),
    Field("battery", "V24", "BATTERY", TRIED),
    Field("foot_force", "(4,)<i2", "raw counts, FR FL RR RL; each sensor has its own zero and scale", TRIED),
    Field("foot_force_est", "(4,)<i2", "typically zero", SDK),
    Field("tick", "<u4", "time; ms by 3.8.6's comment, us by an earlier one's", SDK),
    *_END,
    *_CRC,
)
COMMAND_TYPE = dtype_of(COMMAND, motor=(dtype_of(MOTOR_COMMAND), (MOTORS,)))
STATE_TYPE = dtype_of(
    STATE,
    imu=(dtype_of(IMU), ()),
    motor=(dtype_of(MOTOR_STATE), (MOTORS,)),
    battery=(dtype_of(BATTERY), ()),
)

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
    reverse = np.frombuffer(packet, "<u4", words).byteswap().tobytes().translate(_REVERSED)
    plain = zlib.crc32(reverse) ^ 0xFFFFFFFF
    return int.from_bytes(plain.to_bytes(4, "little").translate(_REVERSED), "big")


class Refusal(Enum):
    """Why a packet is refused; the value is for people."""

    SIZE = "wrong size"
    HEAD = "wrong head"
    LEVEL = "not of the low level"
    CHECKSUM = "wrong checksum"
    CONTENT = "a number that is no command"


def refusal(packet: bytes, size: int) -> Refusal | None:
    """Return why a packet that should have ``size`` bytes is refused; None if it is whole."""
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


def _blank(kind: np.dtype[Any]) -> np.ndarray:
    packet = np.zeros(1, kind)
    packet["head"], packet["level"] = HEAD, LOW_LEVEL
    return packet


def _idle() -> bytes:
    packet = _blank(COMMAND_TYPE)
    motors = packet["motor"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, POSITION_STOP, VELOCITY_STOP
    return sealed(packet)


IDLE = _idle()
"""The vendor's InitCmdData, byte by byte: asks for no torque at all. The robot answers to whoever sends it."""

_MOTORS = struct.Struct("<" + "BffhHH12x" * JOINTS)
"""MOTOR_COMMAND of the twelve joints: several times as fast as NumPy's records."""

_PLACE, _EACH = 22, 6
"""Offset of the first motor in a packet, and numbers per motor."""

_STEPS = np.array([[1.0 / TORQUE_STEP], [1.0 / KP_STEP], [1.0 / KD_STEP]])
_LEAST, _MOST = np.array([[-32768.0], [0.0], [0.0]]), np.array([[32767.0], [65535.0], [65535.0]])


def pack_command(command: LowCmd) -> bytes:
    """Return the packet of a command; gains and torques are cut to the robot's steps and ranges.

    Raises:
        ValueError: if a part has another size than a Go1's, or is not finite.
    """
    parts = np.zeros((4, JOINTS))
    try:
        parts[0], parts[2], parts[3] = command.joint_target, command.kp, command.kd
        if command.feedforward is not None:
            parts[1] = command.feedforward
    except ValueError:
        raise ValueError(f"a command's parts have the sizes {_sizes(command)}; a Go1's have {JOINTS}") from None
    if not abs(parts).max() < BEYOND:  # NaN too
        raise ValueError("a command has a part that is not finite, or beyond any Go1")
    whole = np.minimum(np.maximum(parts[1:] * _STEPS, _LEAST), _MOST).astype(np.int32).tolist()  # cuts towards zero
    numbers: list[float] = [SERVO, 0.0, 0.0, 0, 0, 0] * JOINTS
    numbers[1::_EACH] = parts[0].tolist()
    numbers[3::_EACH], numbers[4::_EACH], numbers[5::_EACH] = whole
    packet = bytearray(IDLE)
    _MOTORS.pack_into(packet, _PLACE, *numbers)
    packet[-4:] = checksum(packet).to_bytes(4, "little")
    return bytes(packet)


def gains_on_wire(kp: np.ndarray, kd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains (J,) that the robot's drives have when these are commanded: cut to whole steps."""
    return np.trunc(np.asarray(kp) / KP_STEP) * KP_STEP, np.trunc(np.asarray(kd) / KD_STEP) * KD_STEP


def _sizes(command: LowCmd) -> dict[str, int]:
    names = ("joint_target", "kp", "kd", "feedforward")
    return {name: np.size(getattr(command, name)) for name in names if getattr(command, name) is not None}


class MotorCommand(NamedTuple):
    """What a command asks of the twelve motors: torque = kp (q* - q) + kd (dq* - dq) + tau, each (12,).

    Attributes:
        q: rad; where ``kp`` is zero it means nothing.
        dq: rad/s.
        tau: N m.
        kp: N m/rad; zero where the packet has POSITION_STOP.
        kd: N m s/rad; zero where it has VELOCITY_STOP.
        damping: (12,) bool: the motor brakes by itself, whatever else is asked.
    """

    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    damping: np.ndarray

    @property
    def idle(self) -> bool:
        """Whether nothing is asked of any motor."""
        return not (self.kp.any() or self.kd.any() or self.tau.any() or self.damping.any())


FASTEST, FARTHEST, BEYOND = 1000.0, 100.0, 1e9
"""Largest |dq| and |q| that a command may ask for, rad/s and rad, and a size that no part of one has (chosen)."""


def unpack_command(packet: bytes) -> MotorCommand | Refusal:
    """Return what a packet asks for, or why it is refused."""
    if wrong := refusal(packet, COMMAND_SIZE):
        return wrong
    numbers = np.array(_MOTORS.unpack_from(packet, _PLACE), float).reshape(JOINTS, _EACH).T
    mode, q, dq, tau, kp, kd = numbers
    free, loose = q == _FREE, dq == _LOOSE
    if free.any() or loose.any():
        q[free] = kp[free] = dq[loose] = kd[loose] = 0.0
    damping = mode == DAMPING
    # written so that a NaN is refused
    if not ((abs(numbers) <= _BOUNDS).all() and (damping | (mode == SERVO)).all()):
        return Refusal.CONTENT
    numbers *= _UNITS
    return MotorCommand(q, dq, tau, kp, kd, damping)


_BOUNDS = np.array([[255.0], [FARTHEST], [FASTEST], [32768.0], [65535.0], [65535.0]])
_UNITS = np.array([[1.0], [1.0], [1.0], [TORQUE_STEP], [KP_STEP], [KD_STEP]])
_FREE, _LOOSE = float(np.float32(POSITION_STOP)), float(np.float32(VELOCITY_STOP))


# ---------------------------------------------------------------------- states

NUMBERS = 2**32
"""The tick wraps around here."""


@dataclass(frozen=True)
class Health:
    """What a state has beside the readings that the runtime uses.

    Attributes:
        charge: of the battery, percent.
        current: of the battery, A.
        cell_voltage: (10,) V (scale not verified).
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


_STATE_MOTORS = struct.Struct("<" + "BffhhffhbII" * JOINTS)
_STATE_IMU = struct.Struct("<13fb")
_STATE_BATTERY = struct.Struct("<BBBBiHbbbb10B")
_STATE_REST = struct.Struct("<4h8xI")
_PLACES = {name: STATE_TYPE.fields[name][1] for name in ("imu", "motor", "battery", "foot_force")}  # type: ignore[index]
_BLANK_STATE = sealed(_blank(STATE_TYPE))


_STATE_STEPS = np.repeat([1.0 / TORQUE_STEP, 1.0 / ACCELERATION_STEP, 1.0], [JOINTS, JOINTS, LEGS])


@lru_cache(maxsize=8)
def _cells(voltage: tuple[float, ...]) -> tuple[int, ...]:
    return tuple(round(1000.0 * volts / 32.0) for volts in voltage)


def pack_state(state: LowState, tick: int, health: Health, rpy: np.ndarray) -> bytes:
    """Return the packet of a state, as the robot would send it.

    Args:
        state: readings; ``t``, ``clock`` and ``in_force`` are not carried.
        tick: time, ms; wraps around at 2**32.
        health: everything else.
        rpy: (3,) roll, pitch and yaw, rad.
    """
    packet = bytearray(_BLANK_STATE)
    imu = np.concatenate([state.imu_quat, state.imu_gyro, state.imu_acc, rpy]).tolist()
    _STATE_IMU.pack_into(packet, _PLACES["imu"], *imu, health.imu_temperature)
    fixed = np.concatenate([state.joint_torque, health.acceleration, state.foot_force]) * _STATE_STEPS
    whole = np.minimum(np.maximum(fixed, -32768), 32767).astype(np.int32).tolist()  # cuts towards zero
    numbers: list[float] = [SERVO, 0.0, 0.0, 0, 0, 0.0, 0.0, 0, 0, 0, 0] * JOINTS
    numbers[1::11] = numbers[5::11] = state.joint_pos.tolist()
    numbers[2::11] = numbers[6::11] = state.joint_vel.tolist()
    numbers[3::11] = numbers[7::11] = whole[JOINTS : 2 * JOINTS]
    numbers[4::11], numbers[8::11] = whole[:JOINTS], health.motor_temperature
    _STATE_MOTORS.pack_into(packet, _PLACES["motor"], *numbers)
    cells = _cells(health.cell_voltage)
    battery = (0, 0, 0, health.charge, round(1000.0 * health.current), 0, 0, 0, 0, 0, *cells)
    _STATE_BATTERY.pack_into(packet, _PLACES["battery"], *battery)
    _STATE_REST.pack_into(packet, _PLACES["foot_force"], *whole[2 * JOINTS :], tick % NUMBERS)
    packet[-4:] = checksum(packet).to_bytes(4, "little")
    return bytes(packet)


def tick_of(packet: bytes) -> int:
    """Return the tick of a state's packet."""
    return int.from_bytes(packet[755:759], "little")


def unpack_state(packet: bytes, t: float, clock: float) -> LowState:
    """Return the readings in a state's packet that is not refused.

    Args:
        packet: see ``refusal``.
        t: when it arrived, on the runtime's clock, s.
        clock: its tick in s; NaN if the tick's unit is not known.
    """
    record = np.frombuffer(packet, STATE_TYPE)[0]
    motors, imu = record["motor"][:JOINTS], record["imu"]
    return LowState(
        t=t,
        joint_pos=motors["q"].astype(float),
        joint_vel=motors["dq"].astype(float),
        joint_torque=motors["tau"] * TORQUE_STEP,
        imu_quat=imu["quat"].astype(float),
        imu_gyro=imu["gyro"].astype(float),
        imu_acc=imu["acc"].astype(float),
        foot_force=record["foot_force"].astype(float),
        clock=clock,
        in_force=-1,
    )


def unpack_health(packet: bytes) -> Health:
    """Return everything else in a state's packet that is not refused."""
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
