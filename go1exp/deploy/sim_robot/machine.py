"""The simulated Go1: body, motors and sensors, one tick of 2 ms at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.deploy.runtime.controller import LYING
from go1exp.deploy.runtime.safety import DEFAULT_KD
from go1exp.deploy.sim_robot import SimConfig
from go1exp.robot.config import RobotConfig
from go1exp.robot.messages import LowCmd, LowState
from go1exp.sim.effects.base import Measured
from go1exp.sim.effects.rules import has_gains
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import HELD_HEIGHT, build_model
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import Terrain, TerrainConfig, build_terrain

TICK = 0.002
"""Period of the motors and of the states, s: 500 Hz in the vendor's SDK."""

SILENCE = 0.05
"""Time without a command after which the motors brake, s."""

NOISE = {"joint_pos": 0.05, "joint_vel": 0.1, "imu_gyro": 0.01, "attitude": 0.05}
"""Half-widths of the paper's Table II: rad, rad/s, rad/s, and of projected gravity, taken as a rotation in rad."""

OWN_NOISE = {"imu_acc": 0.1, "foot_force": 2.0}
"""Standard deviations of noises that are not in Table II, m/s2 and N, as in ``conf/record.yaml``."""

RISING: dict[str, tuple[tuple[float, ...], float, float]] = {
    "lying": (LYING * 4, 0.12, 0.0),
    "crouched": ((0.0, 1.2, -2.2) * 4, 0.22, 0.0),
    "sitting": ((0.0, 0.7, -1.4) * 2 + (0.0, 1.9, -2.65) * 2, 0.3, -0.45),
}
"""Joints, rad, height of the trunk, m, and its pitch, rad, from which a robot settles before it stands up."""

SPREAD = 0.1
"""Half-width of the differences of a crouched or sitting robot's joints from these, rad, drawn by the seed."""

SETTLE_S = 1.0
"""Settling time before the first command, s."""


@dataclass(frozen=True)
class Body:
    """A robot and its ground, without a training.

    Attributes:
        robot: masses and limits.
        actuator: its term.
        effect: further effects.
        contact: of its feet.
        terrain: the ground.
        tile: row and column of its initial tile.
    """

    robot: RobotConfig
    actuator: Term
    effect: tuple[Term, ...]
    contact: ContactConfig
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    tile: tuple[int, int] = (0, 0)


class Robot:
    """One Go1 with its sensors.

    Attributes:
        clock: time of the robot, s.
        braking: whether its motors only brake: no command for too long, or a damping command.
        backend: the physics.
        readings: at the instant at which the last step began, without noise, by name: ``tau_est`` (12,), N m, ...
        truth: (13,) position, attitude and velocities of the trunk then, in the columns of ``TRUTH``; NaN if suspended.
    """

    def __init__(self, task: TaskConfig | Body, config: SimConfig) -> None:
        """Build the task's robot, with actuator and effects, at rest in the pose of ``config.start``.

        The robot of a training stands on flat ground, a ``Body`` on its own.

        Raises:
            ConfigError: if its actuator has no gains, since commands set gains; if there is no such tile.
        """
        if not has_gains(task.actuator):
            name = task.actuator.entry.name
            raise ConfigError([f"actuator = {name}: has no kp and kd, which every command sets; use actuator=pd"])
        self._config, self._rng = config, np.random.default_rng(config.seed)
        held = (1.0, 0.0, 0.0, 0.0) if config.start == "suspended" else None
        terrain = build_terrain(task.terrain if isinstance(task, Body) else TerrainConfig())
        self._origin = _origin(terrain, task.tile if isinstance(task, Body) else (0, 0))
        model, blocks = build_model(task.robot, terrain, TICK, contact=task.contact, imu=True, held=held)
        self.backend = backend = MujocoCpu(model, blocks, 1, threads=1)
        random = EnvRandom(config.seed, 1, device=backend.qpos.device)
        self._plant = Plant(backend, actuator_setup(task.robot, TICK, backend, random), task.actuator, task.effect)
        self._plant.startup()
        actuator = self._plant.actuator
        self._default_gains = tuple(getattr(actuator, name).numpy().ravel().copy() for name in ("kp", "kd"))
        self.clock, self.braking = 0.0, False
        self._commanded, self._measured = -np.inf, 0.0
        self._fed: torch.Tensor | None = None  # from the first feed-forward torque on
        self._place()

    def restart(self) -> None:
        """Reset the robot to its initial state without a command; its clock continues."""
        self._commanded, self.braking = -np.inf, False
        if self._fed is not None:
            self._fed = torch.zeros_like(self._fed)
        self._place()

    def take_over(self, old: Robot) -> None:
        """Continue from ``old``: pose, velocities, clock, noise and command; actuator and effects are reset."""
        self.clock, self.braking, self._rng = old.clock, old.braking, old._rng
        self._commanded, self._measured = old._commanded, old._measured
        self._target: torch.Tensor = old._target.clone()
        self.readings: dict[str, np.ndarray] = old.readings
        self.truth: np.ndarray = old.truth
        self._fed = None if old._fed is None else old._fed.clone()
        plant, everyone = self._plant, torch.ones(1, dtype=torch.bool)
        plant.backend.reset(everyone, old.backend.qpos.clone(), old.backend.qvel.clone())
        plant.reset(everyone, self._target)
        kp, kd = old._gains
        self._set_gains(kp, kd)
        plant.effects.reset(everyone)

    def _place(self) -> None:
        """Reset the robot and let it settle; default gains hold it until a command arrives."""
        plant, start = self._plant, self._config.start
        joints, height, pitch = RISING.get(start, (robot.NOMINAL_STANCE, robot.NOMINAL_HEIGHT, 0.0))
        if start in ("crouched", "sitting"):
            away = np.random.default_rng(self._config.seed).uniform(-SPREAD, SPREAD, robot.NUM_JOINTS)
            joints = np.clip(joints + away, *robot.JOINT_POS_LIMITS.T)
        qpos, qvel = torch.zeros_like(plant.backend.qpos), torch.zeros_like(plant.backend.qvel)
        qpos[:, -robot.NUM_JOINTS :] = torch.as_tensor(joints)
        if start != "suspended":
            qpos[:, :3] = torch.as_tensor(self._origin)
            qpos[:, 2] += height
            qpos[:, 3], qpos[:, 5] = np.cos(pitch / 2), np.sin(pitch / 2)
        everyone = torch.ones(1, dtype=torch.bool)
        plant.backend.reset(everyone, qpos, qvel)
        self._target = qpos[:, -robot.NUM_JOINTS :].clone()
        plant.reset(everyone, self._target)
        self._gains = self._default_gains
        self._set_gains(*((np.zeros(robot.NUM_JOINTS), self._braking_kd) if start == "lying" else self._default_gains))
        for _ in range(round(SETTLE_S / TICK) - 1):
            plant.step(self._target)
        self._advance()
        plant.effects.reset(everyone)  # a drifting effect starts now

    _braking_kd = np.full(robot.NUM_JOINTS, DEFAULT_KD)

    def _set_gains(self, kp: np.ndarray, kd: np.ndarray) -> None:
        """Set the gains, unless they are the present ones."""
        if all(np.array_equal(present, new) for present, new in zip(self._gains, (kp, kd), strict=True)):
            return
        self._gains = (np.array(kp), np.array(kd))
        rows = (torch.as_tensor(values).unsqueeze(0) for values in self._gains)
        self._plant.set_gains(*(row.to(self._plant.q.dtype) for row in rows))

    def apply(self, command: LowCmd) -> None:
        """Apply a command from the next step on."""
        self._commanded, self.braking = self.clock, command.damping
        self._target = torch.tensor(command.joint_target, dtype=self._plant.q.dtype).unsqueeze(0)
        if self._fed is not None or (command.feedforward is not None and command.feedforward.any()):
            fed = np.zeros(robot.NUM_JOINTS) if command.feedforward is None else command.feedforward
            self._fed = torch.tensor(fed, dtype=self._plant.q.dtype).unsqueeze(0)
        self._set_gains(command.kp, command.kd)

    def release(self) -> None:
        """Apply a command without torque: the joints are free, unless no command has been applied yet."""
        if self.commanded:
            nothing = np.zeros(robot.NUM_JOINTS)
            self.apply(LowCmd(self._target[0].numpy().astype(float), nothing, nothing))

    def applied(self) -> np.ndarray:
        """Return whether a command applied in the last step, 1 or 0, its targets, rad, and largest gains: (15,)."""
        gains = [float(values.max()) for values in self._gains]
        return np.concatenate([[self.commanded and not self.braking], self._target[0].numpy(), gains])

    def step(self) -> None:
        """Advance by a tick; without a command for ``SILENCE`` the motors brake."""
        if np.isfinite(self._commanded) and self.clock - self._commanded > SILENCE + 1e-9:
            self.braking = True
            self._set_gains(np.zeros(robot.NUM_JOINTS), self._braking_kd)
            if self._fed is not None:
                self._fed = torch.zeros_like(self._fed)
        self._measured = self.clock
        self._advance()
        self.clock = round(self.clock / TICK + 1) * TICK  # a whole number of ticks: no rounding adds up

    def _advance(self) -> None:
        """Make a step, and keep the readings of its beginning.

        The engine computes forces and IMU readings of that instant during the step, and velocities half a step before
        and after it. Read before the step, they would be one to three milliseconds old.
        """
        plant, backend = self._plant, self._plant.backend
        joints = plant.effects.measure(Measured(plant.q, plant.speed()))
        pose, q, qd = backend.qpos.clone(), joints.joint_pos.clone(), joints.joint_vel.clone()
        half = backend.qvel.clone()
        blocks, readings = backend.sensors, backend.sensordata
        # Foot forces are one tick old: the estimator's ``settle`` was chosen with such readings.
        feet = readings[:, blocks.foot_contact].unflatten(1, (robot.NUM_LEGS, 4))[..., 1:].norm(dim=-1)
        plant.step(self._target, self._fed)
        speed = 0.5 * (half + backend.qvel)
        floats = pose.shape[1] > robot.NUM_JOINTS
        rate = speed[:, 3:6] if floats else readings[:, blocks.imu_gyro]
        about = {"acc": readings[:, blocks.imu_acc], "quat": readings[:, blocks.imu_quat]}
        imu = plant.effects.measure(Measured(plant.q, plant.speed(), gyro=rate, **about))
        present = {"q": q, "qd": qd, "gyro": imu.gyro, "acc": imu.acc, "quat": imu.quat}
        present |= {"tau_est": plant.reported_torque(), "foot_force": feet}
        self.readings = {name: values[0].numpy().copy() for name, values in present.items() if values is not None}
        trunk = torch.cat([pose[:, :7], speed[:, :6]], dim=1)[0].numpy() if floats else np.full(13, np.nan)
        self.truth = np.array(trunk)

    @property
    def commanded(self) -> bool:
        """Whether a command has been applied."""
        return bool(np.isfinite(self._commanded))

    def pose(self) -> np.ndarray:
        """Return position, attitude and joint angles (19,) after the last step."""
        qpos: np.ndarray = self.backend.qpos[0].numpy().copy()
        held = (0.0, 0.0, HELD_HEIGHT, 1.0, 0.0, 0.0, 0.0)
        return qpos if len(qpos) > robot.NUM_JOINTS else np.concatenate([held, qpos])

    def sense(self) -> tuple[LowState, np.ndarray]:
        """Return the sensors' readings, with noise, and the truth (13,), of the beginning of the last step."""
        readings = noisy(self.readings, self._config.noise, self._rng)
        state = LowState(
            t=self._measured,
            clock=self._measured,
            joint_pos=readings["q"],
            joint_vel=readings["qd"],
            joint_torque=self.readings["tau_est"],
            imu_quat=readings["quat"],
            imu_gyro=readings["gyro"],
            imu_acc=readings["acc"],
            foot_force=readings["foot_force"],
        )
        return state, self.truth


def _origin(terrain: Terrain, tile: tuple[int, int]) -> np.ndarray:
    """Return the centre of a tile on the ground, (3,), m; raise ConfigError if there is no such tile."""
    rows, columns = terrain.tile_origins.shape[:2]
    if tile[0] >= rows or tile[1] >= columns:
        raise ConfigError([f"tile = {list(tile)}: the ground has {rows} rows and {columns} columns, counted from 0"])
    return terrain.tile_origins[tile]


def noisy(true: Mapping[str, np.ndarray], share: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the truth, values (..., size) by name, with ``share`` times the noises above."""

    def even(name: str, like: np.ndarray) -> np.ndarray:
        return rng.uniform(-1.0, 1.0, like.shape) * share * NOISE[name]

    def normal(name: str, like: np.ndarray) -> np.ndarray:
        return rng.standard_normal(like.shape) * share * OWN_NOISE[name]

    return {
        "q": true["q"] + even("joint_pos", true["q"]),
        "qd": true["qd"] + even("joint_vel", true["qd"]),
        "quat": turned(true["quat"], even("attitude", true["gyro"])),
        "gyro": true["gyro"] + even("imu_gyro", true["gyro"]),
        "acc": true["acc"] + normal("imu_acc", true["acc"]),
        "foot_force": np.maximum(true["foot_force"] + normal("foot_force", true["foot_force"]), 0.0),
    }


def turned(quat: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Return attitudes (..., 4), w-x-y-z, rotated by small rotation vectors (..., 3), rad, in the body's axes."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    a, b, c = np.moveaxis(0.5 * by, -1, 0)
    # Quaternion product with (1, a, b, c), the small rotation to first order; normalised below.
    parts = (w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a)
    new = np.stack(parts, axis=-1)
    return new / np.linalg.norm(new, axis=-1, keepdims=True)
