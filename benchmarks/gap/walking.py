"""The hidden robot standing: the drives of ``simulate.py``, a free trunk, flat ground; by a policy or by targets.

MuJoCo moves the links and computes the contacts of the feet; friction, drives and gears are the generator's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.spatial.transform import Rotation

from benchmarks.gap.logger import Logger, log
from benchmarks.gap.motions import RATE
from benchmarks.gap.simulate import Drive, Samples, compiled
from benchmarks.gap.truth import Truth
from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.logs.recording import VECTORS, Meta, Recording

PERIOD = 0.02
"""Period of a policy, s."""

KP, KD = 20.0, 0.5
"""Gains of the drives under a policy, N m/rad and N m s/rad: those of the paper."""

SETTLE = 0.6
"""Time for which a robot stands before its log begins, s."""

FALLEN = (0.14, 1.0)
"""A robot whose trunk is lower than this, m, or tilts by more, rad, has fallen."""

LOAD_AT = (0.0, 0.0, 0.1)
"""Where the payload sits, m from the trunk's origin: on top."""

NOISE = {"joint_pos": 5e-4, "joint_vel": 0.04, "imu_gyro": 0.01, "attitude": 0.004, "base_lin_vel_b": 0.02}
"""Standard deviations of what the robot reads: rad, rad/s, rad/s, rad, m/s."""

ACC_NOISE, LOGGED_ATTITUDE = 0.1, 0.001
"""Standard deviations of the accelerometer, m/s2, and of the attitude in a log, rad."""

Policy = Callable[[Mapping[str, np.ndarray]], Mapping[str, np.ndarray]]
"""Readings (N, size) float32 by name -> ``joint_target`` and ``action`` (N, J): what a bundle's policy is."""


@dataclass(frozen=True)
class Ground:
    """What the robot stands on.

    Attributes:
        time_constant: of the spring-damper under a foot, s; MuJoCo's own is 0.02.
        friction: of a foot.
    """

    time_constant: float = 0.02
    friction: float = 0.8


@dataclass(frozen=True)
class Rows:
    """What N robots did, at the R rows of their logs.

    Attributes:
        target: (R, N, J) what was asked, rad.
        samples: what the encoders and motors did.
        gyro: (R, N, 3) rad/s.
        acc: (R, N, 3) specific force at the IMU, m/s2.
        quat: (R, N, 4) attitude, w-x-y-z.
    """

    target: np.ndarray
    samples: Samples
    gyro: np.ndarray
    acc: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True)
class Walked:
    """A walk of N robots over T policy periods.

    Attributes:
        velocity: (T, N, 3) of the trunk, in its own frame: x and y m/s, yaw rate rad/s.
        fell: (N,) the period in which the robot fell; T if it did not.
        rows: for logs, if they were asked for.
    """

    velocity: np.ndarray
    fell: np.ndarray
    rows: Rows | None


def build(truth: Truth, ground: Ground, dt: float) -> mujoco.MjModel:
    """Compile the robot on flat ground, with its payload and an accelerometer."""
    spec = mujoco.MjSpec.from_file(str(data_root() / "assets/go1/go1.xml"))
    for geom in list(spec.geoms):
        if not geom.conaffinity and not geom.contype:  # for the eye only
            spec.delete(geom)
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05], contype=1, conaffinity=0, condim=3
    )
    for leg in robot.LEGS:
        foot = spec.geom(f"{leg}_foot")
        foot.solref[0], foot.friction[0] = ground.time_constant, ground.friction
    if truth.payload:
        load = spec.body("trunk").add_body(name="payload", pos=LOAD_AT)
        load.explicitinertial, load.ipos = True, [0.0] * 3
        load.mass, load.inertia = truth.payload, [1e-9] * 3
    spec.add_sensor(
        name="acc", type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu"
    )
    return compiled(spec, truth, dt)


class _Robots:
    """N robots that stand, and then follow commands."""

    def __init__(
        self,
        truth: Truth,
        ground: Ground,
        gains: tuple[np.ndarray, np.ndarray],
        dt: float,
        rng: np.random.Generator,
        on: np.ndarray,
        stance: np.ndarray,
    ) -> None:
        self.dt, self.n = dt, len(stance)
        self.per = round(1.0 / (RATE * dt))
        batch = self._batch = Batch(build(truth, ground, dt), self.n, nthread=1)
        self.qpos, self.qvel, self._ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self._acc = batch.bind("sensordata")
        self._drive = Drive(truth, *gains, dt, rng, on)
        self._on = np.ones((self.n, 1), dtype=bool)
        self.qpos[:] = 0.0
        self.qpos[:, 2], self.qpos[:, 3] = robot.NOMINAL_HEIGHT, 1.0
        self.qpos[:, 7:] = stance - truth.offset
        batch.forward()
        for _ in range(round(SETTLE * RATE)):
            self.row(-1.0, stance)
        self._drive.begin()

    def row(self, t: float, target: np.ndarray) -> tuple[np.ndarray, ...]:
        """Advance by a row of the log; return angle, speed, torque, gyro, acceleration and attitude at its instant."""
        for sub in range(self.per):
            self._ctrl[:] = self._drive.step(t + sub * self.dt, target, self._on, self.qpos[:, 7:], self.qvel[:, 6:])
            if sub == 0:
                drive, half = self._drive, self.qvel.copy()
                read, quat = (drive.angle.copy(), drive.speed.copy(), drive.made.copy()), self.qpos[:, 3:7].copy()
            self._batch.step()
            if sub == 0:  # speeds of Euler's belong half a step earlier; forces are those of the row's instant
                moved = drive.rotor_speed(self.qpos[:, 7:], self.qvel[:, 6:])
                speed = 0.5 * (read[1] + moved)
                gyro, acc = 0.5 * (half[:, 3:6] + self.qvel[:, 3:6]), self._acc.copy()
        return read[0], speed, read[2], gyro, acc, quat

    def sensed(self, rng: np.random.Generator, offset: np.ndarray) -> dict[str, np.ndarray]:
        """Return what the robots read now, with noise; the velocity is what a good estimate would be."""

        def noisy(name: str, true: np.ndarray) -> np.ndarray:
            return np.asarray(true + NOISE[name] * rng.standard_normal(true.shape))

        attitude = Rotation.from_quat(self.qpos[:, 3:7], scalar_first=True)
        off = Rotation.from_rotvec(NOISE["attitude"] * rng.standard_normal((self.n, 3)))
        return {
            "joint_pos": noisy("joint_pos", self.qpos[:, 7:] + offset),
            "joint_vel": noisy("joint_vel", self.qvel[:, 6:]),
            "imu_gyro": noisy("imu_gyro", self.qvel[:, 3:6]),
            "imu_quat": (attitude * off).as_quat(scalar_first=True),
            "base_lin_vel_b": noisy("base_lin_vel_b", attitude.apply(self.qvel[:, :3], inverse=True)),
        }

    def velocity(self) -> np.ndarray:
        """Return the true velocity of the trunk in its own frame (N, 3): x, y, yaw rate."""
        attitude = Rotation.from_quat(self.qpos[:, 3:7], scalar_first=True)
        v = attitude.apply(self.qvel[:, :3], inverse=True)
        return np.column_stack([v[:, :2], self.qvel[:, 5]])

    def down(self) -> np.ndarray:
        """Return which robots lie (N,) bool."""
        upright = Rotation.from_quat(self.qpos[:, 3:7], scalar_first=True).as_matrix()[:, 2, 2]
        return np.asarray((self.qpos[:, 2] < FALLEN[0]) | (upright < np.cos(FALLEN[1])))


def walk(
    truth: Truth,
    ground: Ground,
    policy: Policy,
    command: np.ndarray,
    seconds: float,
    dt: float,
    rng: np.random.Generator,
    on: np.ndarray,
    keep: bool = False,
) -> Walked:
    """Let N robots walk by a policy; one that falls is held in its stance from there on and does not count.

    Args:
        truth: the robot.
        ground: under it.
        policy: what a bundle holds.
        command: (N, 3) x and y m/s, yaw rate rad/s; constant.
        seconds: how long.
        dt: step, s; divides the period of the log.
        rng: of first poses, noise and world.
        on: (J,) joints on which effects beyond the library act.
        keep: return the rows of logs.
    """
    n, rows = len(command), round(PERIOD * RATE)
    stance = robot.NOMINAL_STANCE + rng.uniform(-0.05, 0.05, (n, robot.NUM_JOINTS))
    robots = _Robots(truth, ground, (np.full((n, 1), KP), np.full((n, 1), KD)), dt, rng, on, stance)
    steps = round(seconds / PERIOD)
    fell, velocity, target = np.full(n, steps), np.zeros((steps, n, 3)), stance.copy()
    action = np.zeros((n, robot.NUM_JOINTS))
    tape: list[tuple[np.ndarray, ...]] = []
    for step in range(steps):
        lying = fell < steps
        given = robots.sensed(rng, truth.offset) | {
            "command": command,
            "previous_action": action,
            "joint_target": target,
            "walked": np.full((n, 1), step * PERIOD),
        }
        asked = policy({name: np.asarray(values, np.float32) for name, values in given.items()})
        action = asked["action"]
        target = np.where(lying[:, None], robot.NOMINAL_STANCE, asked["joint_target"])
        for row in range(rows):
            read = robots.row(step * PERIOD + row / RATE, target)
            if keep:
                tape.append((target, *read))
        velocity[step] = robots.velocity()
        fell = np.where((fell == steps) & robots.down(), step, fell)
    return Walked(velocity, fell, _rows(tape) if keep else None)


def follow(
    truth: Truth,
    ground: Ground,
    targets: np.ndarray,
    gains: Sequence[tuple[float, float]],
    dt: float,
    rng: np.random.Generator,
    on: np.ndarray,
) -> Rows:
    """Let N robots follow targets (R, N, J), rad, row by row, with ``gains`` (kp, kd) of their own."""
    kp, kd = np.array(gains).T[:, :, None]
    robots = _Robots(truth, ground, (kp, kd), dt, rng, on, targets[0])
    return _rows([(target, *robots.row(k / RATE, target)) for k, target in enumerate(targets)])


def _rows(tape: Sequence[tuple[np.ndarray, ...]]) -> Rows:
    target, q, qd, torque, gyro, acc, quat = (np.stack(each) for each in zip(*tape, strict=True))
    return Rows(target, Samples(q, qd, torque), gyro, acc, quat)


def squat(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return targets (T, J), rad: the trunk goes down and up, each leg a little differently, so that it also tilts."""
    bend = np.array([0.0, 0.5, -1.0])  # a foot stays below its hip
    hz = rng.uniform(0.5, 1.3, 2)
    depth = 0.35 * (1.0 - np.cos(2 * np.pi * hz[0] * t)) * rng.uniform(0.7, 1.0)
    sway = 0.15 * np.sin(2 * np.pi * hz[1] * t)
    sides = rng.choice((-1.0, 1.0), 4)
    legs = depth[:, None] + np.clip(depth, 0.0, 0.15)[:, None] * sides + 0.5 * sway[:, None] * sides
    stance = robot.NOMINAL_STANCE.reshape(4, 3)
    return np.asarray((stance + legs[:, :, None] * bend).reshape(len(t), -1))


def recorded(rows: Rows, k: int, end: int, logger: Logger, about: Meta, rng: np.random.Generator) -> Recording:
    """Return what the logger writes of robot ``k`` up to row ``end``: encoders, motors and the IMU."""
    samples = Samples(*(part[:end] for part in (rows.samples.q, rows.samples.qd, rows.samples.torque)))
    off = Rotation.from_rotvec(LOGGED_ATTITUDE * rng.standard_normal((end, 3)))
    attitude = Rotation.from_quat(rows.quat[:end, k], scalar_first=True) * off
    imu = {
        "imu_gyro": rows.gyro[:end, k] + NOISE["imu_gyro"] * rng.standard_normal((end, 3)),
        "imu_acc": rows.acc[:end, k] + ACC_NOISE * rng.standard_normal((end, 3)),
        "imu_quat": attitude.as_quat(canonical=True, scalar_first=True),
    }
    beside = {name: values for key, block in imu.items() for name, values in zip(VECTORS[key], block.T, strict=True)}
    channels = log(logger, samples, k, rows.target[:end, k], np.ones(end, dtype=bool), rng, beside)
    return Recording(about, channels)
