"""Fields of the Go1's low-level packets: names, types, units, and where each is known from. Little-endian, packed.

Layout, scales and rounding were read off the vendor's compiled client (``unitree-legged-sdk`` 3.8.20231105) by
exchanging packets with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

COMMAND_SIZE, STATE_SIZE = 614, 807
HEAD, LOW_LEVEL = b"\xfe\xef", 0xFF
ROBOT, ROBOT_PORT = "192.168.123.10", 8007
"""Address of the robot's motor board for low-level commands (the SDK's examples)."""

JOINTS, MOTORS, LEGS = 12, 20, 4
MOTOR_NAMES = tuple(f"{leg}_{kind}" for leg in ("FR", "FL", "RR", "RL") for kind in ("hip", "thigh", "calf"))
"""Joints of the motors, in the order of the packets."""

PERIOD = 0.002
"""Period at which the vendor's client sends, and at which the robot answers, s."""

SERVO, DAMPING = 0x0A, 0x00
"""Modes of a motor: it follows gains and targets; it brakes by itself."""

POSITION_STOP, VELOCITY_STOP = 2.146e9, 16000.0
"""Values of q and dq that switch off a motor's position and speed feedback (``comm.h``: PosStopF, VelStopF)."""

TORQUE_STEP, KP_STEP, KD_STEP, ACCELERATION_STEP = 1.0 / 256.0, 1.0 / 32.0, 1.0 / 16.0, 1.0
"""Steps of the fixed-point numbers: N m, N m/rad, N m s/rad, rad/s2. All are cut towards zero."""


TORQUE_NOTE = f"torques have steps of 1/{1.0 / TORQUE_STEP:g} N m"
"""Note of a recording whose torques are those of the packets."""


def in_torque_steps(torque: np.ndarray) -> bool:
    """Return whether torques, N m, of any shape, are those of the packets: whole steps, to a tenth as in decimal text.

    False for fewer than ten finite torques that are not zero, and for coarser steps.
    """
    steps = torque[np.isfinite(torque) & (torque != 0.0)] / TORQUE_STEP
    whole = np.rint(steps)
    return len(steps) >= 10 and bool((np.abs(steps - whole) < 0.1).all() and np.gcd.reduce(whole.astype(int)) == 1)


class Field(NamedTuple):
    """One field of a packet: NumPy's type, unit (of the number times ``step``), and source."""

    name: str
    kind: str
    unit: str
    source: str
    step: float = 1.0


SDK = "comm.h of SDK 3.8.6"
TRIED = "exchanged with the vendor's client"

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
    Field("tau", "<i2", "N m, estimated by the motor", TRIED, TORQUE_STEP),
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
    Field("current", "<i4", "mA", TRIED),
    Field("cycles", "<u2", "charging cycles", SDK),
    Field("cell_temperature", "(2,)i1", "degrees Celsius", SDK),
    Field("board_temperature", "(2,)i1", "degrees Celsius", SDK),
    Field("cell_voltage", "(10,)u1", "mV", TRIED, 32.0),
)
_END = (Field("remote", "(40,)u1", "the handheld controller's bytes", SDK), Field("reserve", "<u4", "-", SDK))
_CRC = (Field("crc", "<u4", "checksum of the words before it", TRIED),)


def dtype_of(fields: tuple[Field, ...], **parts: tuple[np.dtype[np.void], tuple[int, ...]]) -> np.dtype[np.void]:
    """Return the packed type of ``fields``, in which ``parts`` gives the type and shape of nested ones."""
    return np.dtype([(f.name, *parts[f.name]) if f.name in parts else (f.name, f.kind) for f in fields])


COMMAND = (
    *_BEGIN,
    Field("motor", "V27", "MOTOR_COMMAND, 20 of them: FR FL RR RL x hip thigh calf, then 8 unused", TRIED),
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
    STATE, imu=(dtype_of(IMU), ()), motor=(dtype_of(MOTOR_STATE), (MOTORS,)), battery=(dtype_of(BATTERY), ())
)
