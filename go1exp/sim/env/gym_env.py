"""One Go1 as a Gymnasium environment: the core with N = 1 and the batch axis removed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from go1exp.sim.env.batch import make, task_of, whole
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import action_tensor, spaces
from go1exp.sim.task import TaskConfig

ACTION_BOX = 2.0
"""Default bound of the action space, in units of ``action.scale``: 0.4 rad about the nominal stance by default.

Actions drawn uniformly from it leave a robot standing for seconds; those from +-``action.clip`` (100) do not.
"""

# A forked process has none of OpenMP's threads and would wait for them. AsyncVectorEnv forks by default.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


class Go1Env(gym.Env[np.ndarray, np.ndarray]):
    """A Go1 from configuration; registered as ``Go1-v0``.

    ``gymnasium.make("go1exp.sim.gym:Go1-v0", overrides=["reward=paper", "rand=none"])`` takes overrides.

    The info of a step has ``reward_terms``, what each term added to the reward (weight and period included), and where
    an episode ends ``episode_end``: the key of the termination that was true, ``left the map`` or ``time limit``.

    Args:
        overrides: as after ``go1exp train``; those of the learner and the run are checked and have no effect.
        task: a parsed configuration in their place.
        noise: add the configured observation noise.
        env_index: behave like this environment of a batch with the same seed, in the first episode.
        render_mode: ``rgb_array`` or None.
        action_box: bound of the action space, in units of ``action.scale``; at most ``action.clip``. Actions beyond
            it are applied all the same, up to ``action.clip``.

    Raises:
        go1exp.config.schema.registry.ConfigError: if an override does not fit.
        ValueError: from ``step`` for an action of another shape, or without numbers.
        go1exp.sim.env.faults.NumericalFault: from ``step`` when a value is not finite.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        overrides: Sequence[str] = (),
        *,
        task: TaskConfig | None = None,
        noise: bool = True,
        env_index: int = 0,
        render_mode: str | None = None,
        action_box: float = ACTION_BOX,
    ) -> None:
        task = task or task_of(overrides)
        self.core = Go1Core(task, 1, first_env=whole("env_index", env_index, 0), noise=noise)
        self.observation_space, self.action_space = spaces(self.core, action_box)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / task.sim.policy_dt)}
        self.render_mode = render_mode
        self._camera: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; a seed makes it and all that follow reproducible."""
        super().reset(seed=seed)
        if seed is not None:
            self.core.reseed(seed)
        return self.core.reset()[0].cpu().numpy().copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply an action (12,) for one policy period."""
        given = action_tensor(action, self.core.device)
        if given.shape != self.action_space.shape:
            raise ValueError(f"action: has shape {tuple(given.shape)}; must be {self.action_space.shape}")
        result = self.core.step(given.unsqueeze(0))
        self.core.check(result)
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        last = result.final_observation if terminated or truncated else result.observation
        info: dict[str, Any] = {"reward_terms": {k: float(v[0]) for k, v in self.core.reward_terms().items()}}
        if end := self.core.episode_end(result, 0):
            info["episode_end"] = end
        return last[0].cpu().numpy().copy(), float(result.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return a picture (480, 640, 3) uint8 if the render mode is ``rgb_array``."""
        if self.render_mode != "rgb_array":
            return None
        if self._camera is None:
            from go1exp.sim.env.camera import Camera

            self._camera = Camera(self.core)
        return self._camera.frame(0)

    def close(self) -> None:
        """Release the renderer."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


class Go1VectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N robots that step together, as Gymnasium wants a batch: ``gymnasium.make_vec("go1exp.sim.gym:Go1-v0", N)``.

    An episode that ends begins anew in the same step; info then has ``final_obs`` (N, O) and the mask ``_final_obs``.

    Args:
        num_envs: N.
        overrides: as after ``go1exp train``; those of the learner and the run are checked and have no effect.
        noise: add the configured observation noise.
        action_box: as of ``Go1Env``.

    Raises:
        ConfigError: if an override or the number of robots does not fit.
        NumericalFault: from ``step`` when a value is not finite.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, overrides: Sequence[str] = (), *, noise: bool = True, action_box: float = ACTION_BOX
    ) -> None:
        self.core = make(overrides, num_envs, noise=noise)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces(self.core, action_box)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start all episodes anew; a seed makes them and all that follow reproducible."""
        if seed is not None:
            self.core.reseed(seed)
        return self.core.reset().cpu().numpy().copy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (N, 12) for one policy period."""
        result = self.core.step(action_tensor(actions, self.core.device))
        self.core.check(result)
        flags = result.terminated, result.truncated
        observation, reward, terminated, truncated = (
            value.cpu().numpy().copy() for value in (result.observation, result.reward, *flags)
        )
        ended = terminated | truncated
        info = {"final_obs": result.final_observation.cpu().numpy().copy(), "_final_obs": ended} if ended.any() else {}
        return observation, reward, terminated, truncated, info
