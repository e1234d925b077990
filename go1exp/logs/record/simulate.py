"""Moves simulated robots and returns their recordings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from go1exp import __version__, robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.physics import MUJOCO_CONTACT, BackendConfig, ContactConfig
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.logs.record.plan import Episode
from go1exp.logs.record.sensors import SensorConfig, log
from go1exp.logs.recording import Meta, Quaternion, Recording
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.base import Measured
from go1exp.sim.effects.rules import has_gains, nested_actuators, on_mount
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import make_backend
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, time_rules
from go1exp.sim.terrain import TerrainConfig, build_terrain

SETTLE_S = 1.0  # time for which the first target is held before the recording begins, s (not before a drop)

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Rig:
    """The robots of a recording: model, actuators, effects, ground, engine, and the physics step, s.

    ``contact`` is that of the feet. None is MuJoCo's own for motions, and for a policy the one that it was trained on.
    """

    robot: RobotConfig
    actuator: Term
    effect: tuple[Term, ...]
    terrain: TerrainConfig
    backend: BackendConfig
    physics_dt: float
    contact: ContactConfig | None = None


class Tape:
    """Observes a plant; keeps one of every ``every`` steps: noiseless readings, with effects that change them."""

    def __init__(self, plant: Plant, every: int, rows: int) -> None:
        """Start to observe: keep ``rows`` samples, one for each ``every`` steps, from the next step on."""
        self._plant, self._every, self._rows, self._step = plant, every, rows, 0
        self._kept: dict[str, np.ndarray] = {}
        self.enabled = torch.ones(len(plant.q), dtype=torch.bool)
        plant.observer = self._listen

    def stop(self) -> None:
        """Stop observing."""
        self._plant.observer = None

    def true(self, env: int) -> dict[str, np.ndarray]:
        """Return the samples of one environment by name, ``(rows, ...)``."""
        return {name: values[:, env] for name, values in self._kept.items()}

    def _listen(self, target: Tensor) -> None:
        """Take a sample before a step; ``target`` is in force from this step on."""
        row, rest = divmod(self._step, self._every)
        if rest == 0 and row < self._rows:
            for name, value in (sample(self._plant, target) | {"torque_enable": self.enabled}).items():
                now = value.cpu().numpy()
                if name not in self._kept:
                    self._kept[name] = np.zeros((self._rows, *now.shape), now.dtype)
                self._kept[name][row] = now
        self._step += 1


def sample(plant: Plant, target: Tensor) -> dict[str, Tensor]:
    """Return N robots' noiseless readings, the truth (``base_...`` of a free trunk), the target (N, J) from now on."""
    blocks, readings = plant.backend.sensors, plant.backend.sensordata
    quat = readings[:, blocks.imu_quat]
    measured = plant.effects.measure(
        Measured(plant.q, plant.speed(), gyro=readings[:, blocks.imu_gyro], acc=readings[:, blocks.imu_acc], quat=quat)
    )
    assert measured.gyro is not None
    assert measured.acc is not None
    assert measured.quat is not None
    # Of the four values of a contact sensor the first is the number of contacts, the others are the force.
    contact = readings[:, blocks.foot_contact].unflatten(1, (robot.NUM_LEGS, 4))
    values = {
        "q": measured.joint_pos,
        "qd": measured.joint_vel,
        "q_target": target,
        "tau_est": plant.reported_torque(),
        "gyro": measured.gyro,
        "acc": measured.acc,
        "quat": measured.quat,
        "foot_force": contact[..., 1:].norm(dim=-1),
    }
    qpos, qvel = plant.backend.qpos, plant.backend.qvel
    if qpos.shape[1] != qvel.shape[1]:  # a free trunk, which has a quaternion
        values |= {
            "base_pos": qpos[:, :3],
            "base_quat": qpos[:, 3:7],
            "base_lin_vel": qvel[:, :3],
            "base_ang_vel": qvel[:, 3:6],
        }
    return values


def held_quat(hang: tuple[float, float]) -> tuple[float, float, float, float]:
    """Return the attitude w-x-y-z of a trunk held at this roll and pitch, rad (about x, then about y)."""
    w, x, y, z = Rotation.from_euler("xyz", [*hang, 0.0]).as_quat(scalar_first=True)
    return float(w), float(x), float(y), float(z)


def play(rig: Rig, episodes: Sequence[Episode], sensors: SensorConfig, seed: int, on_step: Progress) -> list[Recording]:
    """Simulate episodes side by side and return their recordings, in the same order.

    All must be of equal length. Episodes with the same base (held at the same attitude, standing, or dropped) are
    simulated as one batch. ``on_step`` is called with the progress.
    """
    recordings: dict[str, Recording] = {}
    # (attitude of the trunk, dropped or not): episodes of one kind run as one batch
    places = list(dict.fromkeys((e.hang, e.motion.height > 0) for e in episodes))
    for k, place in enumerate(places):
        group = [e for e in episodes if (e.hang, e.motion.height > 0) == place]

        def part(done: int, total: int, k: int = k) -> None:
            on_step(k * total + done, len(places) * total)

        recordings |= {r.meta.episode: r for r in _play_together(rig, group, sensors, seed, part)}
    return [recordings[e.name] for e in episodes]


def _play_together(
    rig: Rig, episodes: Sequence[Episode], sensors: SensorConfig, seed: int, on_step: Progress
) -> list[Recording]:
    plant = _build_plant(rig, episodes, seed)
    _put_down(plant, episodes, rig.physics_dt)
    per_sample = round(1.0 / (sensors.rate_hz * rig.physics_dt))
    tape = Tape(plant, per_sample, len(episodes[0].motion.target))
    _follow_motions(plant, tape, episodes, sensors.rate_hz, per_sample, on_step)
    tape.stop()
    recordings = []
    for k, e in enumerate(episodes):
        about = {"contact": rig.contact or MUJOCO_CONTACT, "excitation": e.excitation, "episode": e.name}
        about |= {"kp": (e.kp,) * robot.NUM_JOINTS, "kd": (e.kd,) * robot.NUM_JOINTS, "repeat_of": e.repeat_of}
        held = None if e.hang is None else held_quat(e.hang)
        recordings.append(_recording(rig, sensors, tape.true(k), e.seed, held, **about))
    return recordings


def _build_plant(rig: Rig, episodes: Sequence[Episode], seed: int) -> Plant:
    n, hang = len(episodes), episodes[0].hang
    model, blocks = build_model(
        rig.robot,
        build_terrain(rig.terrain),
        rig.physics_dt,
        contact=rig.contact or MUJOCO_CONTACT,
        imu=True,
        held=None if hang is None else held_quat(hang),
        mounted=on_mount(rig.effect),
    )
    backend = make_backend(rig.backend, model, blocks, n)
    random = EnvRandom(seed, n, device=backend.qpos.device, shared=True)  # one robot, in all its recordings
    plant = Plant(backend, actuator_setup(rig.robot, rig.physics_dt, backend, random), rig.actuator, rig.effect)
    if has_gains(rig.actuator):
        # (n, 1) each, then the same gain for all joints: (n, 12)
        kp, kd = (torch.tensor([[getattr(e, g)] for e in episodes], dtype=plant.q.dtype) for g in ("kp", "kd"))
        plant.set_gains(kp.expand_as(plant.q), kd.expand_as(plant.q))
    plant.startup()
    return plant


def _put_down(plant: Plant, episodes: Sequence[Episode], physics_dt: float) -> None:
    """Reset every robot to the first angles of its motion and, unless it is to fall, let it settle there."""
    backend = plant.backend
    everyone = torch.ones(len(episodes), dtype=torch.bool)
    qpos, qvel = torch.zeros_like(backend.qpos), torch.zeros_like(backend.qvel)
    qpos[:, -robot.NUM_JOINTS :] = torch.as_tensor(np.stack([e.motion.start for e in episodes]))
    if episodes[0].hang is None:  # a free trunk has seven coordinates before the joints: position, then quaternion
        qpos[:, 2] = robot.NOMINAL_HEIGHT + torch.tensor([e.motion.height for e in episodes])
        qpos[:, 3] = 1.0
    backend.reset(everyone, qpos, qvel)
    start = qpos[:, -robot.NUM_JOINTS :].clone()
    plant.reset(everyone, start)
    if episodes[0].motion.height == 0:
        for _ in range(round(SETTLE_S / physics_dt)):
            plant.step(start)
        plant.effects.reset(everyone)  # an effect that drifts within an episode starts with the recording


def _follow_motions(
    plant: Plant, tape: Tape, episodes: Sequence[Episode], rate_hz: float, per_sample: int, on_step: Progress
) -> None:
    """Send every robot the targets of its motion, one each ``per_sample`` physics steps, while ``tape`` records.

    When actuators come back on, the target moves from the measured angle to the commanded one within ``soft_start``: a
    sudden pull would hit the joint's torque limit.
    """
    targets = torch.as_tensor(np.stack([e.motion.target for e in episodes], axis=1), dtype=plant.q.dtype)  # (T, n, 12)
    enabled = torch.as_tensor(np.stack([e.motion.torque_enable for e in episodes], axis=1))  # (T, n)
    rows = len(targets)
    soft = torch.tensor([[e.motion.soft_start] for e in episodes], dtype=plant.q.dtype)
    # s since the actuators came back on; infinite at the start, where nothing is blended
    since, origin = torch.full_like(soft, torch.inf), targets[0].clone()
    plant.enabled = enabled[0]
    for row in range(rows):
        back_on = (enabled[row] & ~plant.enabled).unsqueeze(1)
        since = torch.where(back_on, 0.0, since + 1.0 / rate_hz)
        origin = torch.where(back_on, plant.q, origin)
        share = (since / soft.clamp(min=1e-9)).clamp(max=1.0)
        target = torch.lerp(origin, targets[row], share)
        plant.enabled = tape.enabled = enabled[row]
        for _ in range(per_sample):
            plant.step(target)
        if row % 100 == 99 or row + 1 == rows:
            on_step(row + 1, rows)


def _recording(
    rig: Rig,
    sensors: SensorConfig,
    true: Mapping[str, np.ndarray],
    seed: int | Sequence[int],
    held: Quaternion | None,
    **about: Any,
) -> Recording:
    base: dict[str, Any] = {"base": "floating" if held is None else "fixed", "base_quat": held}
    return Recording(meta(rig.robot, sensors, **base, **about), log(true, sensors, np.random.default_rng(seed)))


def meta(config: RobotConfig, sensors: SensorConfig, **changes: Any) -> Meta:
    """Return the metadata of a simulated Go1's recording; they do not reveal which effects the robot has."""
    limit = tuple(float(v) for v in robot.per_joint(config.effort_limit))
    usual: dict[str, Any] = {"robot": "go1", "joints": robot.JOINTS, "rate_hz": sensors.rate_hz, "tau_limit": limit}
    about: dict[str, Any] = {"source": "simulated", "tool": "go1exp record", "notes": ""}
    versions = {"go1exp": __version__, "mujoco": version("mujoco-core")}
    return Meta(**usual, **about, versions=versions, **changes)


def policy_task(rig: Rig, trained: TaskConfig, seconds: float) -> TaskConfig:
    """Return a policy's task: the rig's robot, training's commands, flat ground; ConfigError if periods do not fit."""
    period = trained.sim.policy_dt
    # Two periods more than recorded, so that no time limit ends an episode.
    sim = dataclasses.replace(
        trained.sim, physics_dt=rig.physics_dt, episode_s=(round(seconds / period) + 2) * period, spread_starts=False
    )
    if problems := time_rules(sim):
        raise ConfigError(problems)
    parts = {f.name: getattr(rig, f.name) for f in dataclasses.fields(rig) if f.name != "physics_dt"}
    parts["contact"] = rig.contact or trained.contact
    return dataclasses.replace(trained, sim=sim, rand=(), event=(), curriculum=(), **parts)


@dataclass(frozen=True)
class Walk:
    """A policy to record."""

    trained: TaskConfig  # the task that it was trained in
    policy: Callable[[Tensor], Tensor] | None  # observations (N, O) -> actions (N, 12); or None, and ``drive``
    names: Sequence[str]  # names of the episodes, one robot each
    seconds: float  # length of each, s
    # roll and pitch of a held trunk, rad, if the feet are to be in the air; None on the ground
    hang: tuple[float, float] | None
    # lets controllers move the robots of an environment, and returns what is called in place of the policy
    drive: Callable[[Go1Core], Callable[[Tensor], Tensor]] | None = None
    excitation: str = "policy"  # what the recordings call it


def play_policy(rig: Rig, walk: Walk, sensors: SensorConfig, seed: int, on_step: Progress) -> list[Recording]:
    """Move robots by a policy under random commands, and return the recordings, each up to a fall if any."""
    held = None if walk.hang is None else held_quat(walk.hang)
    core = Go1Core(
        policy_task(rig, walk.trained, walk.seconds), len(walk.names), seed, imu=True, held=held, shared_dynamics=True
    )
    observation = core.reset()
    policy = walk.policy if walk.drive is None else walk.drive(core)
    assert policy is not None
    per_sample = round(1.0 / (sensors.rate_hz * rig.physics_dt))
    samples_per_step = round(core.task.sim.policy_dt * sensors.rate_hz)
    if not math.isclose(samples_per_step, core.task.sim.policy_dt * sensors.rate_hz, rel_tol=1e-6):
        period = core.task.sim.policy_dt
        raise ConfigError(
            [f"sensors.rate_hz = {sensors.rate_hz:g}: must sample the policy's {period:g} s a whole number of times"]
        )
    steps = round(walk.seconds / core.task.sim.policy_dt)
    tape = Tape(core.plant, per_sample, steps * samples_per_step)
    rows = np.full(len(walk.names), steps * samples_per_step)
    walking = torch.ones(len(walk.names), dtype=torch.bool)
    for step in range(steps):
        result = core.step(policy(observation))
        observation = result.observation
        fell = walking & (result.terminated | result.truncated)
        rows[fell.numpy()] = (step + 1) * samples_per_step
        walking &= ~fell
        on_step(step + 1, steps)
    tape.stop()
    recordings = []
    for k, name in enumerate(walk.names):
        true = {key: values[: rows[k]] for key, values in tape.true(k).items()}
        about = {"contact": core.task.contact, "excitation": walk.excitation, "episode": name, "repeat_of": None}
        about |= {gain: configured(rig.actuator, gain) for gain in ("kp", "kd")}
        recordings.append(_recording(rig, sensors, true, [seed, k], held, **about))
    return recordings


def configured(actuator: Term, gain: str) -> tuple[float, ...] | None:
    """Return a gain as configured, per joint, without the effects on it; None if the actuator has no gains."""
    value = next((term.parameters[gain] for term, _ in nested_actuators(actuator) if gain in term.parameters), None)
    return None if value is None else tuple(float(v) for v in spread(value, robot.JOINTS))
