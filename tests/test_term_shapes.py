"""A term that gives values of another shape than it must is named; nothing is spread over the robots in silence."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.mdp.types import Snapshot
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.terms import Call
from go1exp.sim.task import parse_task


def one_number(s: Snapshot) -> Tensor:
    return s.joint_vel.sum()


def every_joint(s: Snapshot) -> Tensor:
    return s.joint_vel


@pytest.mark.parametrize(
    ("group", "term", "words"),
    [
        ("reward", one_number, r"reward.{key}: gives \(\) for 3 robots, must be \(N,\), one value per robot"),
        ("reward", every_joint, r"reward.{key}: gives \(3, 12\) for 3 robots, must be \(N,\)"),
        ("termination", every_joint, r"termination.{key}: gives \(3, 12\) for 3 robots, must be \(N,\)"),
        ("observation", every_joint, r"observation.{key}: gives \(3, 12\) for 3 robots, must be \(N, 3\) as its size"),
        ("observation", one_number, r"observation.{key}: gives \(\) for 3 robots, must be \(N, 3\)"),
    ],
)
def test_the_term_is_named(group: str, term: Call, words: str) -> None:
    core = Go1Core(parse_task(compose("train", [])), 3)
    terms = core.terms
    calls, declared = {
        "reward": (terms._reward_calls, terms.rewards),
        "termination": (terms._termination_calls, terms._terminations),
        "observation": (terms._observation_calls, terms.observed),
    }[group]
    core.reset()
    calls[0] = term
    with pytest.raises(ConfigError, match=words.format(key=declared[0].key)):
        core.step(torch.zeros(3, 12))
