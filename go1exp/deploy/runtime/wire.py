"""States and commands as datagrams of fixed size, between the runtime and the simulated robot.

Little-endian, no padding. A head (magic, version, kind, number, clock), then plain numbers. A datagram of another size,
magic, version or kind is refused, and the reader counts it.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

import numpy as np

from go1exp.robot.messages import LowCmd, LowState

MAGIC, VERSION = b"G1XP", 2
STATE, COMMAND, HELLO = 1, 2, 3
"""Kinds. A hello tells the robot the address to which it sends its states."""

HEAD = struct.Struct("<4sBBHId")
"""Magic, version, kind, flags, number, sender's clock in s."""

JOINTS, LEGS = 12, 4
STATE_PARTS = (
    ("joint_pos", JOINTS),
    ("joint_vel", JOINTS),
    ("joint_torque", JOINTS),
    ("imu_quat", 4),
    ("imu_gyro", 3),
    ("imu_acc", 3),
    ("foot_force", LEGS),
)
COMMAND_PARTS = (("joint_target", JOINTS), ("kp", JOINTS), ("kd", JOINTS), ("feedforward", JOINTS))
NO_TORQUE = np.zeros(JOINTS)
_IN_FORCE = struct.Struct("<q")

STATE_NUMBERS = sum(size for _, size in STATE_PARTS)
STATE_SIZE = HEAD.size + _IN_FORCE.size + 8 * STATE_NUMBERS
COMMAND_SIZE = HEAD.size + 8 * sum(size for _, size in COMMAND_PARTS)
HELLO_SIZE = HEAD.size
SIZES = {STATE: STATE_SIZE, COMMAND: COMMAND_SIZE, HELLO: HELLO_SIZE}

DAMPING = 1
"""Flag of a command."""

NUMBERS = 2**32
"""Numbers of datagrams wrap around here: after 99 days at 500 Hz."""


@dataclass(frozen=True)
class Head:
    """Head of a datagram: its kind, its sender's count and clock (s), and flags."""

    kind: int
    number: int
    clock: float
    flags: int


def head(data: bytes) -> Head | None:
    """Read a datagram's head; None if it is not a message of this version, or has a wrong length."""
    if len(data) < HEAD.size:
        return None
    magic, version, kind, flags, number, clock = HEAD.unpack_from(data)
    if magic != MAGIC or version != VERSION or SIZES.get(kind) != len(data) or not math.isfinite(clock):
        return None
    return Head(kind, number, clock, flags)


def hello(number: int, clock: float) -> bytes:
    """Return the datagram that asks a robot for its states."""
    return HEAD.pack(MAGIC, VERSION, HELLO, 0, number % NUMBERS, clock)


def pack_state(state: LowState, number: int) -> bytes:
    """Return a state's datagram; ``state.clock`` is the sender's, ``state.t`` is left out.

    Raises:
        ValueError: if a part does not have the size of a Go1's.
    """
    begin = HEAD.pack(MAGIC, VERSION, STATE, 0, number % NUMBERS, state.clock)
    return begin + _IN_FORCE.pack(state.in_force) + _packed(state, STATE_PARTS)


def unpack_state(data: bytes, about: Head, t: float) -> LowState:
    """Return the state of a datagram whose head has been read, which arrived at ``t``, s."""
    (in_force,) = _IN_FORCE.unpack_from(data, HEAD.size)
    parts = _unpacked(data, HEAD.size + _IN_FORCE.size, STATE_PARTS)
    return LowState(t=t, clock=about.clock, in_force=in_force, **parts)


def pack_command(command: LowCmd, number: int, clock: float) -> bytes:
    """Return a command's datagram.

    Raises:
        ValueError: if a part has another size than a Go1's.
    """
    begin = HEAD.pack(MAGIC, VERSION, COMMAND, DAMPING if command.damping else 0, number % NUMBERS, clock)
    if command.feedforward is None:
        command = replace(command, feedforward=NO_TORQUE)
    return begin + _packed(command, COMMAND_PARTS)


def unpack_command(data: bytes, about: Head) -> LowCmd:
    """Return the command of a datagram whose head has been read."""
    return LowCmd(damping=bool(about.flags & DAMPING), **_unpacked(data, HEAD.size, COMMAND_PARTS))


def _packed(message: LowState | LowCmd, parts: tuple[tuple[str, int], ...]) -> bytes:
    values = [np.asarray(getattr(message, name), dtype="<f8") for name, _ in parts]
    for (name, size), value in zip(parts, values, strict=True):
        if value.shape != (size,):
            raise ValueError(f"{name}: has shape {value.shape}; a Go1's is ({size},)")
    return np.concatenate(values).tobytes()


def _unpacked(data: bytes, start: int, parts: tuple[tuple[str, int], ...]) -> dict[str, np.ndarray]:
    numbers = np.frombuffer(data, dtype="<f8", offset=start)  # read only, and no copy
    arrays, place = {}, 0
    for name, size in parts:
        arrays[name] = numbers[place : place + size]
        place += size
    return arrays


def newer(number: int, than: int) -> int:
    """Return by how much a datagram's number is ahead of another's; negative if it is older. Wrap-around is handled."""
    return (number - than + NUMBERS // 2) % NUMBERS - NUMBERS // 2
