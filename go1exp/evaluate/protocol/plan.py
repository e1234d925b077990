"""What robots are to do over time, commands and kicks; what they did; and their response to a sine."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from go1exp.base.tensors.rotation import rotate_inverse
from go1exp.config.schema.registry import NonNegative, Positive, Speed, Term, within
from go1exp.config.schema.settings import settings
from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.mdp.kinematics import KinematicState
from go1exp.mdp.measures.trace import Trace
from go1exp.sim.terrain import TerrainConfig

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.mdp.types import Snapshot
    from go1exp.sim.env.plant import Plant

Array = NDArray[np.float64]
Velocity = tuple[Speed, Speed, Speed]  # x and y in m/s, yaw rate in rad/s, body frame

Impulse = Annotated[float, Field(gt=0), within(0.0, 500.0, "N s")]
"""Of a kick, N s: 500 N s give a Go1 39 m/s, and ten times as much ends the simulation."""

Coordinate = Annotated[float, within(-0.5, 0.5, "m")]
Point = tuple[Coordinate, Coordinate, Coordinate]
"""Where a kick acts, from the trunk's origin in its frame, m: far off it would turn the trunk without limit."""


@settings
class Constant:
    """One velocity, from rest after ``rest``.

    Attributes:
        kind: constant, steps or sine.
        velocity: x m/s, y m/s, yaw rad/s.
        rest: time with a zero command at the start, s.
    """

    kind: Literal["constant"] = "constant"
    velocity: Velocity
    rest: NonNegative = 0.0

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        after = np.asarray(t, dtype=np.float64) >= self.rest - 1e-9
        return after[:, None] * np.asarray(self.velocity)


@settings
class Steps:
    """Velocities one after the other.

    Attributes:
        kind: constant, steps or sine.
        velocities: each as x m/s, y m/s, yaw rad/s.
        hold: time of each, s; the last one stays.
    """

    kind: Literal["steps"] = "steps"
    velocities: Annotated[tuple[Velocity, ...], Field(min_length=1)]
    hold: Positive

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        which = np.floor(np.asarray(t, dtype=np.float64) / self.hold + 1e-9).astype(int)
        return np.asarray(self.velocities)[np.clip(which, 0, len(self.velocities) - 1)]


@settings
class Sine:
    """A sine on all three axes at once.

    Attributes:
        kind: constant, steps or sine.
        amplitude: of x m/s, y m/s, yaw rad/s.
        period: s.
    """

    kind: Literal["sine"] = "sine"
    amplitude: Velocity
    period: Positive

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        wave = np.sin(2.0 * np.pi * np.asarray(t, dtype=np.float64) / self.period)
        return wave[:, None] * np.asarray(self.amplitude)


Signal = Annotated[Constant | Steps | Sine, Field(discriminator="kind")]


STEP_BYTES = 8 * (3 + 3 + 3 + 3) + 1  # of a robot's policy step in a plan (``command``) and its motion, without a trace


@dataclass(frozen=True)
class Impulses:
    """P kicks on each of N robots: F(t) = J pi / (2 T) sin(pi t / T) for T s, whose integral is J."""

    start: NDArray[np.float64]  # (N, P) times at which they begin, s; NaN for none
    size: NDArray[np.float64]  # (N, P) J, N s
    # (N, P) angle of the force from the robot's heading at that time, counter-clockwise, rad
    direction: NDArray[np.float64]
    duration: float  # T, s
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where they act, in the trunk's frame from its origin, m


NEVER = math.pi  # tilt that no robot exceeds, rad


@dataclass(frozen=True)
class Braking:
    """When motors only brake, as the runtime's do after a fault, within the peak torque."""

    tilt: float  # angle of the trunk to the vertical beyond which a robot brakes from then on, rad; NEVER for none
    kd: float  # N m s/rad
    kp: float = 0.0  # N m/rad, towards the angles at which braking began: with it the legs keep their posture


@dataclass(frozen=True)
class Plan:
    """What N robots are to do."""

    command: Array  # (T, N, 3) commanded velocity of each policy step
    impulses: Impulses | None = None  # kicks, or None
    ground: TerrainConfig = dataclasses.field(default_factory=TerrainConfig)  # what they walk on
    # range of the feet's friction on it, numbers or (N,), in place of the randomisation's; None keeps that
    friction: tuple[float | Array, float | Array] | None = None
    delay: Array | None = None  # (N,) further command delay, s; None for none
    policy_dt: float | None = None  # period of the policy, s; None keeps that of the stage
    # policy step from which contacts, torques and the like are recorded; None records none
    listen_from: int | None = None
    # turn the robots back into their lanes: yaw rate per rad of heading and per m beside the lane; None does not
    steer: tuple[float, float] | None = None
    along: float = 1.0  # direction of the lanes along the world's x; -1 for robots that walk backward
    start: Array | None = None  # (N, 19) where they start, in MuJoCo's order; None starts them as in training
    terminations: tuple[Term, ...] | None = None  # what counts as a fall; None keeps those of training
    braking: Braking | None = None  # when the motors only brake, or None
    # (S) -> (N, K): further figures at the end of each policy step, or None
    figures: Callable[[Snapshot], Tensor] | None = None
    trunk_velocity: TrunkVelocity | None = None  # what the policy sees of it; None keeps that of the stage
    # way along its lane, m, after which a robot is done: when all are, or are down, it ends; None plays all steps
    finish: float | None = None

    @property
    def robots(self) -> int:
        """N."""
        return self.command.shape[1]


@dataclass(frozen=True)
class Motion:
    """What N robots did in T policy steps; values are those at the end of a step."""

    dt: float  # period of the policy, s
    t: Array  # (T,) s since the start
    command: Array  # (T, N, 3) as it was given; x, y in m/s, yaw rate in rad/s
    velocity: Array  # (T, N, 3) of the trunk in its frame: x, y in m/s, yaw rate in rad/s
    height: Array  # (T, N) of the trunk's origin over the ground below it, m
    way: Array  # (T, N) m along the lane from the start
    alive: NDArray[np.bool_]  # (T, N) bool, not fallen and on the map so far
    fell: NDArray[np.bool_]  # (N,) bool
    left_map: NDArray[np.bool_]  # (N,) bool
    front_right: Array  # (T, N) time for which the foot FR has been on the ground, 0 in the air, s
    trace: Trace | None = None  # contacts and the like of the recorded steps, or None
    figures: Array | None = None  # (T, N, K) those of the plan, or None

    @property
    def moving_s(self) -> Array:
        """(N,) time under a command that is not zero, until a fall, s."""
        moving = self.alive & np.any(self.command != 0.0, axis=-1)
        return np.asarray(moving.sum(0) * self.dt, dtype=np.float64)

    @property
    def fingerprint(self) -> Array:
        """(N,) sums over what each robot did, which are equal to the bit only if that is."""
        did = np.abs(self.velocity).sum(-1) + self.height
        return np.asarray(np.where(self.alive, did, 0.0).sum(0), dtype=np.float64)


def heading(quat: Tensor) -> Tensor:
    """Return the yaw angle (N,) of attitudes (N, 4) w-x-y-z, rad."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class Kicker:
    """Adds the forces to whatever else acts on the trunks, in every physics step of one environment.

    It stands before the engine's ``step``, so that it needs no place in the plant, and takes its force back after it:
    what acts on the trunk beside it stays the effects' own.
    """

    def __init__(self, backend: Any, physics_dt: float, impulses: Impulses) -> None:
        """Begin to listen to the steps of ``backend``, whose clock starts now."""
        self._backend, self._dt, self.time = backend, physics_dt, 0.0
        self._inner = backend.step
        self._state = KinematicState.view(backend.qpos, backend.qvel, None)
        self.use(impulses)
        backend.step = self._step

    def use(self, impulses: Impulses) -> None:
        """Take other kicks from now on."""
        self._impulses = impulses
        self._count = max(1, round(impulses.duration / self._dt))
        shape = np.sin(np.pi * (np.arange(self._count) + 0.5) / self._count)
        self._share = shape / shape.sum() / self._dt  # their sum times the step is exactly 1
        self._angle = np.full(impulses.start.shape, np.nan)

    def _step(self, torque: Tensor) -> None:
        wrench = self._wrench()
        if wrench is None:
            self._inner(torque)
        else:
            applied = self._backend.applied()[:, :6]
            others = applied.clone()
            applied += wrench
            self._inner(torque)
            applied.copy_(others)
        self.time += self._dt

    def _wrench(self) -> Tensor | None:
        """(N, 6) force in the world and torque in the trunk's frame of this step, None if there is none."""
        impulses = self._impulses
        step = np.round((self.time - impulses.start) / self._dt)
        active = (step >= 0) & (step < self._count) & (impulses.size != 0.0)
        if not active.any():
            return None
        quat = self._state.base_quat_w
        now = heading(quat).numpy()[:, None]
        self._angle = np.where(active & np.isnan(self._angle), now + impulses.direction, self._angle)
        index = np.where(active, step, 0).astype(int)
        size = np.where(active, impulses.size * self._share[index], 0.0)
        angle = np.nan_to_num(self._angle)
        planar = np.stack([(size * np.cos(angle)).sum(1), (size * np.sin(angle)).sum(1)], 1)
        force = torch.zeros(len(quat), 3, dtype=quat.dtype)
        force[:, :2] = torch.from_numpy(planar)
        arm = torch.tensor(impulses.point, dtype=quat.dtype).expand(len(quat), 3)
        return torch.cat([force, torch.linalg.cross(arm, rotate_inverse(quat, force))], 1)


class Brake:
    """Lets motors brake and keeps what was largest: in every physics step, before the engine's ``step``.

    Attributes:
        since: (N,) time at which each robot began to brake, s; infinite before.
        torque_share: (N,) largest torque of a joint over its peak torque since then, or ever if none is to brake.
        joint_speed: (N,) largest joint velocity in that time, rad/s.
        sink: (N,) largest downward speed of the trunk in that time, m/s.
    """

    def __init__(self, plant: Plant, physics_dt: float, peak_torque: Array, braking: Braking) -> None:
        """Begin to act on the steps of ``plant``, whose clock starts now."""
        self._plant, self._dt, self._braking, self._steps = plant, physics_dt, braking, 0
        self._peak, self._least = torch.as_tensor(peak_torque), math.cos(braking.tilt)
        self._always, backend = braking.tilt >= NEVER, plant.backend
        self._inner, self._state = backend.step, KinematicState.view(backend.qpos, backend.qvel, None)
        self.since, self._angles = torch.full((len(plant.q),), math.inf, dtype=torch.float64), plant.q.clone()
        self.torque_share, self.joint_speed, self.sink = (torch.zeros_like(self.since) for _ in range(3))
        backend.step = self._step  # type: ignore[method-assign]

    def _step(self, torque: Tensor) -> None:
        quat, now = self._state.base_quat_w, self._steps * self._dt
        upright = 1.0 - 2.0 * (quat[:, 1].square() + quat[:, 2].square())
        self._angles = torch.where(self.since.isfinite().unsqueeze(1), self._angles, self._plant.q)
        self.since = torch.where(upright < self._least, self.since.clamp(max=now), self.since)
        pull = self._braking.kp * (self._angles - self._plant.q) - self._braking.kd * self._plant.qd
        braked, brakes = torch.minimum(torch.maximum(pull, -self._peak), self._peak), self.since.isfinite()
        made = torch.where(brakes.unsqueeze(1), braked, torque)
        self._plant.torque.copy_(made)
        self._inner(made)
        self._steps += 1
        for name, values in (
            ("torque_share", (made.abs() / self._peak).amax(-1)),
            ("joint_speed", self._plant.qd.abs().amax(-1)),
            ("sink", -self._state.base_lin_vel_w[:, 2]),
        ):
            counted = values.where(brakes | self._always, 0.0)
            setattr(self, name, torch.maximum(getattr(self, name), counted))


def phasors(values: ArrayLike, t: ArrayLike, period: float) -> NDArray[np.complex128]:
    """Return the amplitude and phase at ``period`` of each whole period of a signal, (P, ...) complex.

    The projection of ``values`` (T, ...) on exp(-i w t) with its mean beside it, by least squares in each period, so
    that a period need not be a whole number of samples. The first period is dropped: it has the start in it.
    """
    t, values = np.asarray(t, dtype=np.float64), np.asarray(values, dtype=np.float64)
    omega, projections = 2.0 * np.pi / period, []
    whole = int(np.floor((t[-1] + (t[1] - t[0])) / period + 1e-6)) if len(t) > 1 else 0
    for k in range(1, whole):
        rows = (t >= k * period - 1e-9) & (t < (k + 1) * period - 1e-9)
        basis = np.column_stack([np.ones(rows.sum()), np.cos(omega * t[rows]), np.sin(omega * t[rows])])
        flat = values[rows].reshape(rows.sum(), -1)
        _, real, minus_imaginary = np.linalg.lstsq(basis, flat, rcond=None)[0]
        projections.append((real - 1j * minus_imaginary).reshape(values.shape[1:]))
    return np.array(projections, dtype=complex).reshape(len(projections), *values.shape[1:])


def response(measured: ArrayLike, commanded: ArrayLike, t: ArrayLike, period: float) -> tuple[Array, Array, Array]:
    """Return gain, lag (s, positive if late) and coherence of the response to a sine, (...) each; NaN without a period.

    Gain and lag are those of the mean phasors. Coherence is |mean of M conj(C)|^2 / (mean |M|^2 mean |C|^2) over the
    periods: 1 if all responses are equal.
    """
    m, c = phasors(measured, t, period), phasors(commanded, t, period)
    if not len(m):
        nothing = np.full(np.asarray(measured).shape[1:], np.nan)
        return nothing, nothing.copy(), nothing.copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = m.mean(0) / c.mean(0)
        coherence = np.abs((m * c.conj()).mean(0)) ** 2 / ((np.abs(m) ** 2).mean(0) * (np.abs(c) ** 2).mean(0))
    return np.abs(ratio), -np.angle(ratio) * period / (2.0 * np.pi), coherence
