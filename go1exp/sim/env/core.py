"""The batched environment step.

N environments always. Nothing in ``step`` branches on data, changes a shape or waits for the device: resets, pushes,
command changes and curriculum moves are masks. On a GPU that lets the whole step be one captured graph; on the CPU it
makes environment i of a batch compute exactly what it would compute alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from math import inf
from typing import Any

import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.memory import Memory
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.base.tensors.rotation import projected_gravity, rotate_inverse
from go1exp.config.schema.training import Value
from go1exp.mdp.commands import UniformVelocity
from go1exp.mdp.curricula import TrackedPath
from go1exp.mdp.derived import joint_target, limited, of_shape
from go1exp.mdp.feet import Feet
from go1exp.mdp.ground import GroundHeight, Surroundings
from go1exp.mdp.kinematics import KinematicState, lift
from go1exp.mdp.types import Snapshot, StepResult
from go1exp.sim.effects.rules import on_mount
from go1exp.sim.env.engine import CapturedStep, Restarts, make_backend
from go1exp.sim.env.faults import Evidence, accuse
from go1exp.sim.env.metrics import GaitLog, TaskLog
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.env.terms import StepTerms, reading, watched
from go1exp.sim.physics.scene import build_model
from go1exp.sim.schedule import CONTACT_TIME, DELAY, DRAWN, FEET_CONTACT_FIELD
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import build_terrain

THIGHS, CALVES, TRUNK = slice(0, 4), slice(4, 8), slice(8, 13)
"""Columns of the link contact block (``sim/physics/scene.py``); the trunk's are trunk with head, and the four hips."""

MAP_MARGIN = 1.0
"""Distance from the edge of a height field at which an episode ends, m."""


class Go1Core:
    """N Go1 robots, from configuration to step.

    Args:
        task: what to build.
        num_envs: N.
        seed: of everything random in the environment.
        first_env: number of the first environment, so that one of a batch can be replayed alone.
        noise: add the observation noise (off in evaluation).
        spread_starts: let first episodes begin at random times (training only).
        imu: simulate the IMU's sensors too, for a logger.
        held: attitude w-x-y-z in which the trunks are held in the air; None lets them go.
        shared_dynamics: draw effects and actuators once, for all robots (for a logger).
        critic: append what only the critic sees to the observations (training only).
        changing: keys of the settings that ``change`` may write (training only).
    """

    driver: Callable[[], None] | None = None
    """Makes each physics step in place of ``plant.step``, which it calls; actions are then ignored."""

    def __init__(
        self,
        task: TaskConfig,
        num_envs: int,
        seed: int = 0,
        *,
        first_env: int = 0,
        noise: bool = True,
        spread_starts: bool = False,
        imu: bool = False,
        held: tuple[float, float, float, float] | None = None,
        shared_dynamics: bool = False,
        critic: bool = False,
        changing: Collection[str] = (),
    ) -> None:
        self.task, self.num_envs, self.noise, self._spread_starts = task, num_envs, noise, spread_starts
        self.terrain, time = build_terrain(task.terrain), task.sim
        scene = partial(build_model, contact=task.contact, imu=imu, held=held, mounted=on_mount(task.effect))
        model, sensors = scene(task.robot, self.terrain, time.physics_dt)
        self.backend = make_backend(task.backend, model, sensors, num_envs)
        self.device = self.backend.qpos.device
        self.random = EnvRandom(seed, num_envs, first_env, self.device, units=self.backend.units)
        self._held, self._state = held, KinematicState.view(self.backend.qpos, self.backend.qvel, held)
        self._build_ground(first_env)
        actuators = self.random
        if shared_dynamics:
            actuators = EnvRandom(seed, num_envs, first_env, self.device, shared=True)
        self.terms = StepTerms(task, num_envs, self.device, critic, changing)
        self._build_terms(actuators)
        self._restarts = Restarts(self._restart, (self.random, actuators))
        zeros = partial(torch.zeros, num_envs, dtype=torch.float32, device=self.device)
        joint_values = (zeros(robot.NUM_JOINTS) for _ in range(5))
        self.action, self.previous_action, self._last_action, self.target, self.joint_acc = joint_values
        self.steps, self._first_step, self.episode_return = *(zeros(dtype=torch.int64) for _ in range(2)), zeros()
        self._last_qpos, self._last_qvel = torch.zeros_like(self.backend.qpos), torch.zeros_like(self.backend.qvel)
        self.reward_sums, self.spawn, self.path = self.terms.sums, zeros(3), TrackedPath(num_envs, self.device)
        self.feet, self.task_log = Feet(num_envs, time.physics_dt, self.device), TaskLog(time.policy_dt, self.device)
        self.gait_log = GaitLog(num_envs, time.policy_dt, self.device)
        self._touched, self._calf_touched = map(torch.zeros_like, (self._link_contacts, self._foot_contact[..., 0]))
        self._nominal = torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float32, device=self.device)
        self._started, self._evidence, self.captures = False, Evidence(), task.backend.captures
        self._deferred = self.device.type == "cuda"  # where to look at a value is to wait for it
        self._captured: CapturedStep | None = None

    def _build_ground(self, first_env: int) -> None:
        t, to_device = self.terrain, partial(torch.as_tensor, dtype=torch.float32, device=self.device)
        self._ground = GroundHeight(to_device(t.heights), t.x0, t.y0, t.resolution)
        self._origins = to_device(t.tile_origins)
        rows, cols = t.tile_origins.shape[:2]
        env = torch.arange(first_env, first_env + self.num_envs, device=self.device)
        self.tile_column, self.level = env % cols, torch.zeros_like(env)
        self._max_level, self._bounded = rows - 1, t.config.kind != "flat"
        self._grade = to_device(t.difficulty_per_level)[self.tile_column]
        extent = to_device(t.extent if self._bounded else (-inf, inf, -inf, inf))
        self._map = extent[[0, 2]] + MAP_MARGIN, extent[[1, 3]] - MAP_MARGIN
        self._curriculum = [reading("curriculum", t, t()) for t in self.task.curriculum]
        start = min([self._max_level, *(getattr(rule, "start_level_max", inf) for rule in self._curriculum[:1])])
        self._start_levels = int(start) + 1

    def _build_terms(self, actuators: EnvRandom) -> None:
        """Turn the configured terms into callables, and make per-environment the model fields that will vary."""
        task = self.task
        setup = actuator_setup(task.robot, task.sim.physics_dt, self.backend, actuators)
        self.plant = Plant(self.backend, setup, task.actuator, task.effect)
        self.command = watched("command", task.command, task.command(self.random.stream("command")))
        if isinstance(self.command, UniformVelocity):
            self.command.ground = self.level, self._grade
        self.events = {t.key: watched("event", t, t(self.random.stream(f"event.{t.key}"))) for t in task.event}
        self.observation_size = self.terms.observation_size
        ground = self._ground if self._bounded else None
        self._around = Surroundings(ground, self.device, self.terms.read)
        self._model_terms = [t for t in task.rand if t.entry.traits["kind"] == "model"]
        self._state_terms = [t for t in task.rand if t.entry.traits["kind"] == "state"]
        for term in self._model_terms:
            for name in term.entry.traits["fields"]:
                self.backend.field(name)
        blocks, readings = self.backend.sensors, self.backend.sensordata
        self._foot_contact = readings[:, blocks.foot_contact].unflatten(1, (robot.NUM_LEGS, 4))
        self._link_contacts = readings[:, blocks.link_contacts]
        self._foot_pos_w = readings[:, blocks.foot_pos_w].unflatten(1, (robot.NUM_LEGS, 3))
        self._foot_vel_w = readings[:, blocks.foot_vel_w].unflatten(1, (robot.NUM_LEGS, 3))

    def change(self, path: str, value: Value) -> None:
        """Change a setting of a running environment (``sim/schedule.py``), in place: a captured step sees it too.

        A delay counts from a robot's next episode on, ranges and shares from its next command, all else at once.
        """
        if path == DELAY:
            self.plant.actuator.set_range(*value)  # type: ignore[attr-defined, misc]  # checked with the schedule
        elif path == CONTACT_TIME:
            self.backend.field(FEET_CONTACT_FIELD)[:, self.backend.ids("geom", robot.FEET), 0] = value  # type: ignore[assignment]
        elif path in DRAWN:
            self.command.change(path.removeprefix("command."), value)
        else:
            self.terms.change(path, value)  # type: ignore[arg-type]

    def reset(self) -> Tensor:
        """Start all episodes anew and return the first observations (N, O)."""
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if not self._started:
            self.level.copy_(self.random.stream("level").integers(self._start_levels, 1).squeeze(1))
            self.plant.startup()
            self._randomize_model("startup", everyone)
        self._restarts(everyone)
        if self._spread_starts and not self._started:
            self._first_step.copy_(self.random.stream("spread").integers(self.task.sim.episode_steps, 1).squeeze(1))
            self.steps.copy_(self._first_step)
        self._started = True
        self._advance_world(everyone)
        return self.terms.frames.begun(*self._frame(self.snapshot()), everyone)

    def reseed(self, seed: int) -> None:
        """Make the next ``reset`` the first one of an environment built with ``seed``."""
        self.random.reseed(seed)
        for part in (self.command, *self.events.values()):
            if isinstance(part, Memory):
                part.renew()
        self._started = False

    def _randomize_model(self, when: str, mask: Tensor) -> None:
        due = [t for t in self._model_terms if t.slots["when"] == when]
        for term in due:
            term(self.backend, self.random.stream(f"rand.{term.key}"), mask)
        if any(t.entry.traits.get("derived") for t in due):
            self.backend.derive_constants(mask)

    def _restart(self, mask: Tensor) -> None:
        self._randomize_model("reset", mask)
        rows = mask.unsqueeze(1)
        self.spawn.copy_(torch.where(rows, self._origins[self.level, self.tile_column], self.spawn))
        qpos, qvel = torch.zeros_like(self.backend.qpos), torch.zeros_like(self.backend.qvel)
        fresh = KinematicState.view(qpos, qvel, self._held)
        fresh.base_pos_w.copy_(self.spawn)
        fresh.base_pos_w[:, 2] += robot.NOMINAL_HEIGHT
        fresh.base_quat_w[:, 0] = 1.0
        fresh.joint_pos.copy_(self._nominal)
        for term in self._state_terms:
            term(fresh, self.random.stream(f"rand.{term.key}"))
        if self._held is None:
            lift(fresh, self._ground if self._bounded else None)
        self.backend.reset(mask, qpos, qvel)
        if self._curriculum:
            self.path.begin(mask, fresh.base_pos_w.float(), fresh.base_quat_w.float())
        for part in (self.feet, self.gait_log, self.terms):
            part.reset(mask)
        for tensor in (self.action, self.previous_action, self.joint_acc):
            tensor.masked_fill_(rows, 0.0)  # and not a product: zero times NaN is NaN
        self.target.copy_(torch.where(rows, self._nominal, self.target))
        self.plant.reset(mask, self.target.to(self.backend.qpos.dtype))
        for tensor in (self.steps, self._first_step, self.episode_return):
            tensor.masked_fill_(mask, 0)

    def step(self, action: Tensor) -> StepResult:
        """Apply actions (N, 12) for one policy period.

        Order: physics, failure and time limit, reward, last observation, resets of ended episodes, new commands,
        pushes, first observation. A push and a new command are therefore seen before they are answered.
        """
        if not self._deferred and of_shape(action, self.action.shape).isnan().any():  # an infinite one is clipped
            accuse({"action": action, "qpos": self.backend.qpos}, self.steps + 1)
        if not self.captures:
            return self.step_by_call(action)
        if self._captured is None:
            self._captured = CapturedStep(self, action)
        return self._captured(action)

    def step_by_call(self, action: Tensor) -> StepResult:
        """Do what ``step`` says, call by call: for what is to be part of a larger graph."""
        self._advance_physics(action)
        self.steps += 1
        s = self.snapshot()
        self.gait_log.add(s)
        if self._curriculum:
            self.path.advance(self.task.sim.policy_dt, s.command, self._state.base_pos_w.float(), s.base_quat_w)
        terminated = self.terms.terminated(s)
        xy, (low, high) = self._state.base_pos_w[:, :2], self._map
        cut = self.terms.cut_short(((xy < low) | (xy > high)).any(-1), s)
        truncated = ((self.steps >= self.task.sim.episode_steps) | cut) & ~terminated
        reward = self.terms.reward(s)
        self.episode_return += reward
        episode_return, episode_length = self.episode_return.clone(), self.steps - self._first_step
        self.task_log.add(s, (terminated, truncated & ~cut, truncated & cut), (episode_return, episode_length))
        final_observation = self.terms.frames.ended(*self._frame(s, advance=True))
        self._last_qpos.copy_(self.backend.qpos)
        self._last_qvel.copy_(self.backend.qvel)
        if self._deferred:
            self._evidence.note(self._suspects(final_observation), episode_length)

        ended = terminated | truncated
        self._move_levels(ended, terminated)
        self._restarts(ended)
        self._advance_world(ended)
        observation = self.terms.frames.begun(*self._frame(self.snapshot()), ended)
        return StepResult(observation, reward, terminated, truncated, final_observation, episode_return, episode_length)

    def _advance_physics(self, action: Tensor) -> None:
        self.previous_action.copy_(self.action)
        self.action.copy_(limited(of_shape(action, self.action.shape), self.previous_action, *self.task.action.limits))
        self._last_action.copy_(self.action)
        self.target.copy_(joint_target(self.action, self._nominal, self.task.action.scale))
        target = self.target.to(self.backend.qpos.dtype)
        self.feet.begin_step()
        self._touched.zero_()
        self._calf_touched.zero_()
        for _ in range(self.task.sim.decimation):
            self.plant.step(target) if self.driver is None else self.driver()
            self.feet.update(self._foot_contact[..., 1:], self._foot_vel_w)
            # Counts, largest over the substeps; a calf's contacts without those of its foot.
            torch.maximum(self._touched, self._link_contacts, out=self._touched)
            calves = self._link_contacts[:, CALVES] - self._foot_contact[..., 0]
            torch.maximum(self._calf_touched, calves, out=self._calf_touched)
        self.joint_acc.copy_(self.plant.joint_acceleration())

    def _advance_world(self, restart: Tensor) -> None:
        """Let the policy period pass for commands and events; ``restart`` (N,) begins anew."""
        self.command.advance(self.task.sim.policy_dt, restart)
        for happening in self.events.values():
            happening.advance(self._state, self.task.sim.policy_dt, restart)

    def _move_levels(self, ended: Tensor, fallen: Tensor) -> None:
        for rule in self._curriculum:
            tracked, commanded = self.path.lengths().unbind(1)
            whole = (self.task.sim.episode_steps - self._first_step) / (self.steps - self._first_step)
            commanded = torch.where(fallen, commanded * whole, commanded)
            anywhere = self.random.stream("relevel").integers(self._max_level + 1, 1).squeeze(1)
            after = rule(self.level, tracked, commanded, self.task.terrain.tile_size, self._max_level, anywhere)
            self.level.copy_(torch.where(ended, after, self.level))

    def ground_height(self, xy: Tensor) -> Tensor | float:
        """Height of the ground at world positions (..., 2), (...), m; of flat ground the number 0."""
        return self._ground(xy) if self._bounded else 0.0

    def snapshot(self) -> Snapshot:
        """Return the present moment as the MDP sees it; staleness of sensors as in ``sim/physics/backend.py``."""
        state = self._state
        quat, foot_pos = state.base_quat_w.float(), self._foot_pos_w.float()
        return Snapshot(
            base_pos_w=state.base_pos_w.float(),
            base_quat_w=quat,
            base_lin_vel_b=rotate_inverse(quat, state.base_lin_vel_w.float()),
            base_ang_vel_b=state.base_ang_vel_b.float(),
            projected_gravity_b=projected_gravity(quat),
            joint_pos=state.joint_pos.float(),
            joint_vel=state.joint_vel.float(),
            joint_acc=self.joint_acc,
            joint_torque=self.plant.torque.float(),
            joint_target=self.target,
            action=self.action,
            previous_action=self.previous_action,
            command=self.command.value,
            foot_height=foot_pos[..., 2] - self.ground_height(foot_pos[..., :2]),
            foot_vel_w=self._foot_vel_w.float(),
            foot_force=self._foot_contact[..., 1:].norm(dim=-1).float(),
            **self.feet.snapshot_fields(),
            thigh_contact=self._touched[:, THIGHS] > 0,
            calf_contact=self._calf_touched > 0,
            trunk_contact=(self._touched[:, TRUNK] > 0).any(-1),
            episode_time=self.steps * self.task.sim.policy_dt,
            **self._around(state.base_pos_w.float(), quat, foot_pos[..., :2], self.command.value),
        )

    def _frame(self, s: Snapshot, *, advance: bool = False) -> tuple[Tensor, Tensor | None]:
        """(N, F) each: the observed values of a snapshot, and what to make noise of; ``advance`` once a step."""
        sensed = self.plant.sense(s) if self.plant.effects.senses else s
        if advance:
            self.terms.advance(sensed, s)
        frames = self.terms.frames.size
        return self.terms.observation(sensed, s), (
            self.random.stream("noise").uniform(frames, low=-1.0) if self.noise else None
        )

    def reward_terms(self) -> dict[str, Tensor]:
        """Return what each reward term added to the last step's reward, (N,) each; they sum up to it."""
        return self.terms.reward_terms()

    def episode_end(self, result: StepResult, env: int) -> str | None:
        """Return the termination that ended an episode, ``left the map``, ``time limit``, or None if it goes on."""
        return self.terms.end(env, bool(result.terminated[env]), bool(result.truncated[env]))

    def check(self, result: StepResult) -> None:
        """Raise NumericalFault if anything in the step is not finite. Waits for the device."""
        if not torch.isfinite(result.reward.sum() + result.final_observation.sum()):
            accuse(self._suspects(result.final_observation), result.episode_length)

    def check_so_far(self) -> None:
        """Raise NumericalFault if anything in any step on a GPU was not finite. Waits for the device."""
        self._evidence.check()

    def _suspects(self, observation: Tensor) -> dict[str, Tensor]:
        """What may not be finite after a step, causes first."""
        named = {"action": self._last_action, "qpos": self._last_qpos, "qvel": self._last_qvel}
        rewards = {f"reward.{t.key}": self.terms.values[:, k] for k, t in enumerate(self.terms.rewards)}
        return {**named, **rewards, "observation": observation}

    def drain_metrics(self, steps: int) -> dict[str, float]:
        """Return means since the last call, ``steps`` policy steps ago: reward terms per second, the level, ..."""
        rates = (self.reward_sums / (steps * self.num_envs * self.task.sim.policy_dt)).tolist()
        self.reward_sums.zero_()
        metrics = {f"reward/{t.key}": rate for t, rate in zip(self.terms.rewards, rates, strict=True)}
        if self._bounded:
            metrics["curriculum/terrain_level"] = float(self.level.float().mean())
        return metrics | self.gait_log.drain() | self.task_log.drain() | self.backend.drain_metrics()

    _BUFFERS = (
        *("action", "previous_action", "target", "joint_acc", "spawn"),
        *("steps", "_first_step", "episode_return", "reward_sums", "level"),
    )

    def _parts(self) -> dict[str, Any]:
        names = ("backend", "random", "plant", "command", "feet", "gait_log", "task_log")
        path = {"path": self.path} if self._curriculum else {}
        events = {f"event.{name}": part for name, part in self.events.items()}
        return {**{name: getattr(self, name) for name in names}, **path, **events, **self.terms.parts()}

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to continue bit for bit."""
        buffers = {name: getattr(self, name).clone() for name in self._BUFFERS}
        return {"core": buffers, "started": self._started, **{k: p.state_dict() for k, p in self._parts().items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, bit for bit, in an environment of the same configuration and size."""
        for name in self._BUFFERS:
            getattr(self, name).copy_(state["core"][name])
        for name, part in self._parts().items():
            if name in state or name not in ("task_log", "path"):  # which checkpoints of 0.1 do not have
                part.load_state_dict(state[name])
        self._started = state["started"]
