"""A trained policy as a function, from a run folder alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from go1exp import robot
from go1exp.sim.task import PPOConfig, TrainConfig
from go1exp.train import checkpoint, run_folder, start
from go1exp.train.ppo import GaussianPolicy, policy_settings

Policy = Callable[[Tensor], Tensor]
"""Observations (N, O) float32 -> actions (N, 12), deterministic."""


def load_run(run: Path, which: Path | None = None) -> tuple[TrainConfig, Policy, dict[str, Any]]:
    """Load a run by its own configuration; return that, its policy, and the description that ``load_policy`` returns.

    Raises:
        FileNotFoundError: if ``run`` is not a run folder or has no checkpoint.
        go1exp.config.schema.registry.ConfigError: if its configuration is not one that this version knows.
    """
    config = run_folder.read_parsed(run)
    policy, about = load_policy(run, config.ppo, which)
    return config, policy, about


def load_policy(run: Path, config: PPOConfig, which: Path | None = None) -> tuple[Policy, dict[str, Any]]:
    """Load the policy of a run as a function; arguments and errors as ``load_network``'s."""
    network, about = load_network(run, config, which)

    def policy(observation: Tensor) -> Tensor:
        with torch.no_grad():
            return network._predict(observation, deterministic=True)

    return policy, about


def load_network(run: Path, config: PPOConfig, which: Path | None = None) -> tuple[GaussianPolicy, dict[str, Any]]:
    """Load the network of a run's policy.

    Args:
        run: run folder.
        config: the run's own learner settings, which give the shape of the network.
        which: a checkpoint file; the newest if None.

    Returns:
        The network; and ``iteration``, ``file`` and ``num_timesteps`` (earlier stages included) of the checkpoint.

    Raises:
        FileNotFoundError: if there is no checkpoint.
    """
    state, path = (checkpoint.read(which), which) if which else checkpoint.load_latest(run)
    size, policy_size = (state["policy"][f"mlp_extractor.{net}_net.0.weight"].shape[1] for net in ("value", "policy"))
    network = GaussianPolicy(
        Box(-np.inf, np.inf, (size,), np.float32),
        Box(-1.0, 1.0, (robot.NUM_JOINTS,), np.float32),
        lambda _: 0.0,
        **policy_settings(config, policy_size if policy_size < size else None),
    )
    network.load_state_dict(state["policy"])
    network.set_training_mode(False)
    steps = state["num_timesteps"] + start.timesteps_before(run)
    about = {"iteration": state["iteration"], "num_timesteps": steps, "file": str(path)}
    return network, about
