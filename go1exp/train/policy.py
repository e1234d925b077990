"""Policies out of run folders: as a function, and as the first weights of a new run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from go1exp import robot
from go1exp.base.files import write_json
from go1exp.config.schema import plugins
from go1exp.config.schema.history import frame_width, frames_of
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.sim.task import TrainConfig
from go1exp.train import checkpoint, run_folder
from go1exp.train.network import GaussianPolicy, policy_settings
from go1exp.train.ppo import AdaptivePPO

START = "start.json"
"""In the new run's folder: where its first weights are from."""


@dataclass(frozen=True)
class Weights:
    """The state of a policy, and its origin as in ``start.json``."""

    policy: dict[str, Tensor]
    about: dict[str, Any]


def read_weights(config: TrainConfig, source: Path) -> Weights:
    """Return the weights of ``source``'s newest checkpoint.

    Args:
        config: the new run's.
        source: run folder, or that of a shipped policy.

    Raises:
        ConfigError: if a policy of the new run is another function than one of ``source``.
        FileNotFoundError: if ``source`` holds no checkpoint.
    """
    with plugins.restored():
        theirs = run_folder.read_parsed(source)
    both_estimate = config.estimator.latent and theirs.estimator.latent
    differ = [  # all that the networks are built by; estimator.weight is of the loss
        f"{name} is {new} here and {old} there"
        for name, new, old in (
            ("observation", *(_inputs(c.task.observation) for c in (config, theirs))),
            ("critic", *(_inputs(c.task.critic) for c in (config, theirs))),
            ("ppo.hidden", list(config.ppo.hidden), list(theirs.ppo.hidden)),
            ("estimator.latent", config.estimator.latent, theirs.estimator.latent),
            ("estimator.hidden", *(list(c.estimator.hidden) if both_estimate else None for c in (config, theirs))),
            ("ppo.activation", config.ppo.activation, theirs.ppo.activation),
        )
        if new != old
    ]
    if differ:
        raise ConfigError([f"start_from = {str(source)!r}: its weights fit no policy of this run: {'; '.join(differ)}"])
    state, path = checkpoint.load_latest(source)
    about = {
        "run": config.process.start_from or str(source),  # as given: a shipped policy by its name
        "checkpoint": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "iteration": state["iteration"],
        "num_timesteps": state["num_timesteps"] + timesteps_before(source),
    }
    return Weights(state["policy"], about)


def _inputs(terms: Sequence[Term]) -> list[str]:
    """Return what each term gives a policy: its name, and how many numbers of how many steps."""
    frames = ((t, frame_width(t), frames_of(t)) for t in terms)
    return [
        f"{t.entry.name} ({wide} x {steps} steps)" if steps > 1 else f"{t.entry.name} ({wide})"
        for t, wide, steps in frames
    ]


def timesteps_before(run: Path) -> int:
    """Return the policy steps that a run's first weights had learnt from, over all stages before it."""
    file = run / START
    return int(json.loads(file.read_text())["num_timesteps"]) if file.is_file() else 0


def begin_with(ppo: AdaptivePPO, weights: Weights, run: Path) -> None:
    """Give ``ppo`` the weights (actor, critic, standard deviations), and note in ``run`` where they are from.

    Iterations, optimiser, learning rate, robots and curriculum begin anew.
    """
    ppo.policy.load_state_dict(weights.policy)
    write_json(run / START, weights.about)
    print(f"starting from {weights.about['run']}, iteration {weights.about['iteration']}")


Policy = Callable[[Tensor], Tensor]
"""Observations (N, O) float32 -> actions (N, 12), deterministic."""


def load_run(run: Path, which: Path | None = None) -> tuple[TrainConfig, Policy, dict[str, Any]]:
    """Load a run by its own configuration; return that, its policy, and the description that ``load_policy`` returns.

    Raises:
        FileNotFoundError: if ``run`` is not a run folder or has no checkpoint.
        go1exp.config.schema.registry.ConfigError: if its configuration is not one that this version knows.
    """
    config = run_folder.read_parsed(run)
    policy, about = load_policy(run, config, which)
    return config, policy, about


def load_policy(run: Path, config: TrainConfig, which: Path | None = None) -> tuple[Policy, dict[str, Any]]:
    """Load the policy of a run as a function; arguments and errors as ``load_network``'s."""
    network, about = load_network(run, config, which)
    return acting(network), about


def acting(network: GaussianPolicy) -> Policy:
    """Return a network as a function."""

    def policy(observation: Tensor) -> Tensor:
        with torch.no_grad():
            return network._predict(observation, deterministic=True)

    return policy


def load_network(run: Path, config: TrainConfig, which: Path | None = None) -> tuple[GaussianPolicy, dict[str, Any]]:
    """Load the network of a run's policy.

    Args:
        run: run folder.
        config: the run's own, which gives the shape of the network.
        which: a checkpoint file; the newest if None.

    Returns:
        The network; and ``iteration``, ``file`` and ``num_timesteps`` (earlier stages included) of the checkpoint.

    Raises:
        FileNotFoundError: if there is no checkpoint.
    """
    state, path = (checkpoint.read(which), which) if which else checkpoint.load_latest(run)
    actor = "policy_net.encoder" if config.estimator.latent else "policy_net"
    size, policy_size = (state["policy"][f"mlp_extractor.{net}.0.weight"].shape[1] for net in ("value_net", actor))
    network = GaussianPolicy(
        Box(-np.inf, np.inf, (size,), np.float32),
        Box(-1.0, 1.0, (robot.NUM_JOINTS,), np.float32),
        lambda _: 0.0,
        **policy_settings(config.ppo, policy_size if policy_size < size else None, config.estimator),
    )
    network.load_state_dict(state["policy"])
    network.set_training_mode(False)
    steps = state["num_timesteps"] + timesteps_before(run)
    about = {"iteration": state["iteration"], "num_timesteps": steps, "file": str(path)}
    return network, about
