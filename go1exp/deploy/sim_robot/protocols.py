"""What the simulated robot hears and says: the Go1's own protocol, or one that carries everything exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from go1exp.deploy.runtime import go1_wire, wire
from go1exp.deploy.runtime.safety import DEFAULT_KD
from go1exp.deploy.sim_robot.settings import SimConfig
from go1exp.robot.messages import LowCmd, LowState

TICK_MS = 2
"""What a tick of 2 ms adds to the tick that the simulated robot reports: the unit of SDK 3.8.6's comment."""

FOREIGN = "no message of this protocol"
OLD = "older than one before"


@dataclass(frozen=True)
class Heard:
    """A datagram that is not refused.

    Attributes:
        command: None for one that asks for nothing.
        number: of the command, counted by its sender; 0 if the protocol has none.
    """

    command: LowCmd | None
    number: int = 0


class Language(Protocol):
    """How datagrams are read and written."""

    size: int
    """Largest size of a datagram to the robot, in bytes."""

    def refusal(self, data: bytes) -> str | None:
        """Return why a datagram is refused before anybody looks into it; None if it is not."""

    def read(self, data: bytes) -> Heard | str:
        """Return what a datagram that was not refused asks for, or why it is refused all the same."""

    def written(self, state: LowState, ticks: int) -> bytes:
        """Return the datagram of a state; ``ticks`` of 2 ms have passed since the robot began."""


class Exact:
    """The protocol of ``go1exp.deploy.runtime.wire``: double precision, numbered, with the command in force."""

    size = wire.COMMAND_SIZE

    def __init__(self) -> None:
        self._last = 0

    def refusal(self, data: bytes) -> str | None:
        """Return why a datagram is refused."""
        about = wire.head(data)
        return FOREIGN if about is None or about.kind == wire.STATE else None

    def read(self, data: bytes) -> Heard | str:
        """Return a datagram's command; an older one than the last is refused."""
        about = wire.head(data)
        assert about is not None  # it was not refused
        if about.kind != wire.COMMAND:
            return Heard(None)
        if wire.newer(about.number, self._last) <= 0:
            return OLD
        command = wire.unpack_command(data, about)
        if not all(np.isfinite(getattr(command, name)).all() for name, _ in wire.COMMAND_PARTS):
            return FOREIGN
        self._last = about.number
        return Heard(command, about.number)

    def written(self, state: LowState, ticks: int) -> bytes:
        """Return the datagram of a state."""
        return wire.pack_state(state, ticks)


class Go1:
    """The Go1's low-level protocol (``go1exp.deploy.runtime.go1_wire``), rounded and cut as the robot does.

    Battery and temperatures are not simulated: they are constants. Commands have no number on this wire: they take
    force in the order of their arrival, as far as anybody knows also on the robot.
    """

    size = go1_wire.COMMAND_SIZE

    def __init__(self, config: SimConfig) -> None:
        """Draw the zeros and scales of the feet's sensors."""
        self._feet = FootSensors(config)
        self._speed: np.ndarray | None = None
        self._health = go1_wire.Health()

    def refusal(self, data: bytes) -> str | None:
        """Return why a packet is refused."""
        wrong = go1_wire.refusal(data, go1_wire.COMMAND_SIZE)
        return None if wrong is None else wrong.value

    def read(self, data: bytes) -> Heard | str:
        """Return a packet's command: the speed that it asks for becomes a torque, kd dq, in what the plant gets."""
        asked = go1_wire.unpack_command(data)
        if isinstance(asked, go1_wire.Refusal):
            return asked.value
        if asked.idle:
            return Heard(None)
        brakes = asked.damping
        kp, kd = np.where(brakes, 0.0, asked.kp), np.where(brakes, DEFAULT_KD, asked.kd)
        fed = np.where(brakes, 0.0, asked.tau + asked.kd * asked.dq)
        only_brakes = not (kp.any() or fed.any())
        return Heard(LowCmd(asked.q, kp, kd, damping=only_brakes, feedforward=fed if fed.any() else None))

    def written(self, state: LowState, ticks: int) -> bytes:
        """Return the packet of a state."""
        before = state.joint_vel if self._speed is None else self._speed
        self._speed = state.joint_vel
        turning = (state.joint_vel - before) / go1_wire.PERIOD
        health = replace(self._health, acceleration=tuple(turning))
        state = replace(state, foot_force=self._feet.counts(state.foot_force))
        return go1_wire.pack_state(state, TICK_MS * ticks, health, roll_pitch_yaw(state.imu_quat))


ZERO, SCALE = (100.0, 130.0), (0.5, 1.5)
"""Ranges from which ``sim.feet=raw`` draws zeros (counts; 114 to 125 were seen on one robot) and scales (chosen)."""


class FootSensors:
    """The feet's sensors: newtons, or counts of which each sensor has its own zero and scale.

    Attributes:
        zero: (4,) counts without load.
        scale: (4,) counts per newton.
    """

    def __init__(self, config: SimConfig) -> None:
        rng = np.random.default_rng([config.seed, 2])
        raw = config.feet == "raw"
        self.zero = rng.uniform(*ZERO, go1_wire.LEGS) if raw else np.zeros(go1_wire.LEGS)
        self.scale = rng.uniform(*SCALE, go1_wire.LEGS) if raw else np.ones(go1_wire.LEGS)

    def counts(self, force: np.ndarray) -> np.ndarray:
        """Return what the sensors say under forces (4,), N."""
        return self.zero + self.scale * force


def roll_pitch_yaw(quat: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw, rad, of an attitude w-x-y-z of unit length."""
    w, x, y, z = map(float, quat)
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return np.array([roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))])


def language(config: SimConfig) -> Language:
    """Return what ``config.protocol`` names."""
    return Exact() if config.protocol == "exact" else Go1(config)
