"""Mirrored samples: every minibatch together with its image across the robot's sagittal plane.

Mittal et al., "Symmetry considerations for learning task symmetric robot policies", arXiv 2403.04359, section III:
observation and action are mirrored; old log-probability, old value, advantage and return are those of the original,
since a mirrored robot would have earned the same. (The policy that collected the samples would have taken the mirrored
action with another probability as long as it is not symmetric; the paper keeps the old one all the same.)
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from go1exp.config.schema.history import frames_of
from go1exp.config.schema.registry import Term
from go1exp.mdp.mirror import ACTION, Mirror, side_by_side


class SampleMirror(NamedTuple):
    """The mirrors of a policy's input (O columns) and of its output (A)."""

    observation: Mirror
    action: Mirror = ACTION

    def joined(self, batch: RolloutBufferSamples) -> RolloutBufferSamples:
        """Return (2 B) samples: ``batch`` (B), then its image."""
        images = batch._replace(observations=self.observation(batch.observations), actions=self.action(batch.actions))
        pairs = zip(batch, images, strict=True)
        return RolloutBufferSamples(*(torch.cat(pair) for pair in pairs))


def of_policy(observations: Iterable[Term]) -> SampleMirror:
    """Return the mirror of a policy that sees these terms one after the other; each must declare its own."""
    return SampleMirror(side_by_side(t.entry.traits["mirror"].repeated(frames_of(t)) for t in observations))
