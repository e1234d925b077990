"""One Go1 as a Gymnasium environment: the core with N = 1 and the batch axis removed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from go1exp.sim.env.batch import listed, whole
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import spaces
from go1exp.sim.task import TaskConfig


class Go1Env(gym.Env[np.ndarray, np.ndarray]):
    """A Go1 from configuration; registered as ``Go1-v0``.

    ``gymnasium.make("go1exp.sim.gym:Go1-v0", overrides=["reward=paper", "rand=none"])`` takes overrides.

    The info of a step has ``reward_terms``, what each term added to the reward (weight and period included), and where
    an episode ends ``episode_end``: the key of the termination that was true, ``left the map`` or ``time limit``.

    Args:
        overrides: as after ``go1exp train``; those of the learner and the run are ignored.
        task: a parsed configuration in their place.
        noise: add the configured observation noise.
        env_index: behave like this environment of a batch with the same seed, in the first episode.
        render_mode: ``rgb_array`` or None.

    Raises:
        go1exp.config.schema.registry.ConfigError: if an override does not fit.
        ValueError: from ``step`` for an action of another shape.
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
    ) -> None:
        if task is None:
            from go1exp.config.compose import compose_checked
            from go1exp.sim.task import parse_task

            task = parse_task(compose_checked("train", listed(overrides)))
        self.core = Go1Core(task, 1, first_env=whole("env_index", env_index, 0), noise=noise)
        self.observation_space, self.action_space = spaces(self.core)
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
        given = torch.as_tensor(action, dtype=torch.float32)
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
