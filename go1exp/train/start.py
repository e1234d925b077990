"""A new run that begins with the weights of another: fine-tuning, or a second stage with other rewards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from go1exp.base.files import write_json
from go1exp.config.schema import plugins
from go1exp.config.schema.history import frame_width, frames_of
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.sim.task import TrainConfig
from go1exp.train import checkpoint, run_folder
from go1exp.train.ppo import AdaptivePPO

FILE = "start.json"
"""In the new run's folder: where its first weights are from."""


@dataclass(frozen=True)
class Weights:
    """The state of a policy, and what ``start.json`` tells of it."""

    policy: dict[str, Any]
    about: dict[str, Any]


def read(config: TrainConfig, source: Path) -> Weights:
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
    differ = [
        f"{name} is {new} here and {old} there"
        for name, new, old in (
            ("observation", *(_inputs(c.task.observation) for c in (config, theirs))),
            ("critic", *(_inputs(c.task.critic) for c in (config, theirs))),
            ("ppo.hidden", list(config.ppo.hidden), list(theirs.ppo.hidden)),
            ("ppo.activation", config.ppo.activation, theirs.ppo.activation),
        )
        if new != old
    ]
    if differ:
        raise ConfigError([f"start_from = {str(source)!r}: its weights fit no policy of this run: {'; '.join(differ)}"])
    state, path = checkpoint.load_latest(source)
    about = {
        "run": str(source),
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
    file = run / FILE
    return int(json.loads(file.read_text())["num_timesteps"]) if file.is_file() else 0


def begin(ppo: AdaptivePPO, weights: Weights, run: Path) -> None:
    """Give ``ppo`` the weights (actor, critic, standard deviations), and note in ``run`` where they are from.

    Iterations, optimiser, learning rate, robots and curriculum begin anew.
    """
    ppo.policy.load_state_dict(weights.policy)
    write_json(run / FILE, weights.about)
    print(f"starting from {weights.about['run']}, iteration {weights.about['iteration']}")
