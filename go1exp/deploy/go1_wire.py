"""The Go1's low-level UDP protocol: commands of 614 bytes, states of 807, as the vendor's SDK 3.8.6 sends and expects.

Fields, scales and units are in ``go1_fields``. Nothing here was tried on a robot. A packet of another size, head,
level or checksum is refused (``refusal``). No function here knows a socket.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from go1exp.deploy.go1_fields import ACCELERATION_STEP as ACCELERATION_STEP
from go1exp.deploy.go1_fields import BATTERY as BATTERY
from go1exp.deploy.go1_fields import COMMAND as COMMAND
from go1exp.deploy.go1_fields import COMMAND_SIZE as COMMAND_SIZE
from go1exp.deploy.go1_fields import COMMAND_TYPE as COMMAND_TYPE
from go1exp.deploy.go1_fields import DAMPING as DAMPING
from go1exp.deploy.go1_fields import HEAD as HEAD
from go1exp.deploy.go1_fields import IMU as IMU
from go1exp.deploy.go1_fields import JOINTS as JOINTS
from go1exp.deploy.go1_fields import KD_STEP as KD_STEP
from go1exp.deploy.go1_fields import KP_STEP as KP_STEP
from go1exp.deploy.go1_fields import LEGS as LEGS
from go1exp.deploy.go1_fields import LOW_LEVEL as LOW_LEVEL
from go1exp.deploy.go1_fields import MOTOR_COMMAND as MOTOR_COMMAND
from go1exp.deploy.go1_fields import MOTOR_STATE as MOTOR_STATE
from go1exp.deploy.go1_fields import PERIOD as PERIOD
from go1exp.deploy.go1_fields import POSITION_STOP as POSITION_STOP
from go1exp.deploy.go1_fields import ROBOT as ROBOT
from go1exp.deploy.go1_fields import ROBOT_PORT as ROBOT_PORT
from go1exp.deploy.go1_fields import SERVO as SERVO
from go1exp.deploy.go1_fields import STATE as STATE
from go1exp.deploy.go1_fields import STATE_SIZE as STATE_SIZE
from go1exp.deploy.go1_fields import STATE_TYPE as STATE_TYPE
from go1exp.deploy.go1_fields import TORQUE_STEP as TORQUE_STEP
from go1exp.deploy.go1_fields import VELOCITY_STOP as VELOCITY_STOP
from go1exp.deploy.go1_fields import dtype_of as dtype_of
from go1exp.deploy.messages import LowCmd, LowState

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
