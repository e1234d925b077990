"""The numpy border to Stable-Baselines3."""

from __future__ import annotations

from numbers import Real
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from go1exp import robot
from go1exp.config.schema.registry import ConfigError
from go1exp.mdp.types import StepResult
from go1exp.sim.env.core import Go1Core


def spaces(core: Go1Core, action_box: float | None = None) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Return the observation and action space of one environment.

    The action space is +-``action_box``, at most ``action.clip``, which is meant by None. Raises ConfigError if
    ``action_box`` is not positive.
    """
    clip = core.task.action.clip
    if action_box is not None:
        clip = min(action_box, clip) if isinstance(action_box, Real) else 0.0
    if not clip > 0.0:
        raise ConfigError([f"action_box = {action_box}: must be a positive number, in units of action.scale"])
    return (
        gym.spaces.Box(-np.inf, np.inf, (core.observation_size,), np.float32),
        gym.spaces.Box(-clip, clip, (robot.NUM_JOINTS,), np.float32),
    )


def action_tensor(actions: Any, device: torch.device) -> torch.Tensor:
    """Return actions as a tensor; raise ValueError if they are not numbers."""
    given = actions
    if not isinstance(actions, torch.Tensor):
        try:
            given = np.asarray(actions)
        except ValueError:  # rows of different lengths
            given = np.array(None)
        if given.dtype.kind in "biuf":
            with np.errstate(over="ignore"):  # infinite; the step names it
                given = torch.from_numpy(np.asarray(given, np.float32, order="C"))
    if not isinstance(given, torch.Tensor) or given.is_complex():
        raise ValueError(f"action: must be an array of numbers, not {type(actions).__name__} {actions!r:.80}")
    return given.to(device, torch.float32)


class Go1VecEnv(VecEnv):
    """``Go1Core`` as SB3 wants it: copies, one ``done`` flag, and the truth about it in ``infos``.

    An info is filled only for episodes that ended: ``terminal_observation``, ``TimeLimit.truncated`` and ``episode``
    with return ``r`` and length ``l`` in steps.

    Args:
        core: the environments.
        action_box: bound of the action space; None is ``action.clip``. Off-policy learners explore all of it.

    Raises:
        NumericalFault: from ``step`` when an action, state, reward or observation is not finite.
    """

    def __init__(self, core: Go1Core, action_box: float | None = None) -> None:
        self.core = core
        super().__init__(core.num_envs, *spaces(core, action_box))
        self._actions = torch.zeros_like(core.action)

    def reset(self) -> VecEnvObs:
        """Start all episodes anew; observations (N, O) float32."""
        if self._seeds[0] is not None:
            self.core.reseed(self._seeds[0])
        self._reset_seeds()
        return self.core.reset().cpu().numpy()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (N, 12) for ``step_wait``."""
        self._actions = action_tensor(actions, self.core.device)

    def step_wait(self) -> VecEnvStepReturn:
        """Advance one policy step."""
        result = self.core.step(self._actions)
        self.core.check(result)
        done = (result.terminated | result.truncated).cpu().numpy()
        return (
            result.observation.cpu().numpy(),
            result.reward.cpu().numpy().copy(),  # SB3 adds the bootstrap value in place
            done,
            self._infos(result, done),
        )

    def _infos(self, result: StepResult, done: np.ndarray) -> list[dict[str, Any]]:
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in done.nonzero()[0]:
            infos[i] = {
                "terminal_observation": result.final_observation[i].cpu().numpy().copy(),
                "TimeLimit.truncated": bool(result.truncated[i]),
                "episode": {"r": float(result.episode_return[i]), "l": int(result.episode_length[i])},
            }
        return infos

    def close(self) -> None:
        """Nothing to release: threads end with the object."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the core, once per environment asked for; raise AttributeError if it has none."""
        value = None if attr_name == "render_mode" else getattr(self.core, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Refuse: the environments share one core."""
        raise NotImplementedError(f"{attr_name!r}: environments of a batch cannot differ in attributes")

    def env_method(self, method_name: str, *args: object, indices: VecEnvIndices = None, **kwargs: object) -> list[Any]:
        """Refuse: there are no single environments to call."""
        raise NotImplementedError(f"{method_name!r}: environments of a batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]
