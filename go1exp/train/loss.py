"""PPO's advantages, loss and mirrored samples, for every learner on every device.

Both are those of Stable-Baselines3 (``RolloutBuffer.compute_returns_and_advantage`` and ``PPO.train``), to which
tests/test_device_training.py holds them, written as pure functions of tensors: SB3's own cannot be had without its
loops, which read numbers back from the device after every minibatch.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import torch
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor
from torch.nn.functional import mse_loss

from go1exp.config.schema.history import frames_of
from go1exp.config.schema.registry import Term
from go1exp.mdp.mirror import ACTION, Mirror, side_by_side
from go1exp.sim.task import PPOConfig

if TYPE_CHECKING:
    from go1exp.train.network import GaussianPolicy


class Loss(NamedTuple):
    """The loss of one minibatch, its parts, and what is reported of it; each ().

    Attributes:
        total: what the gradient step lowers.
        policy: the clipped surrogate.
        value: mean square error of the value function.
        entropy: the negative mean entropy.
        clip_fraction: share of samples whose ratio of probabilities left the clip range; without gradient.
        approx_kl: a sampled divergence from the policy that collected the samples (J. Schulman, "Approximating KL
            divergence", 2020); without gradient.
        estimation: mean square error of the estimator; 0 without one.

    Clip fraction and divergence are of the samples that were collected, without their mirror images: an image's ratio
    says how asymmetric a policy is, not how far it has moved.
    """

    total: Tensor
    policy: Tensor
    value: Tensor
    entropy: Tensor
    clip_fraction: Tensor
    approx_kl: Tensor
    estimation: Tensor


def ppo_loss(
    policy: GaussianPolicy,
    batch: RolloutBufferSamples,
    config: PPOConfig,
    mirror: SampleMirror | None = None,
    among: Tensor | None = None,
) -> Loss:
    """Return the clipped loss of a minibatch (Schulman et al. 2017, equations 7 and 9), without a look at any value.

    With ``mirror`` it is the loss of the minibatch joined with its mirror image, and the policy's
    ``last_distribution`` has the image's rows behind those of the minibatch. ``among`` are the advantages (B,) of the
    minibatch of which ``batch`` is a part; None if it is all of it.
    """
    collected = len(batch.actions)
    if mirror is not None:
        batch = mirror.joined(batch)
    values, log_prob, entropy = policy.evaluate_actions(batch.observations, batch.actions)
    values, advantage = values.flatten(), batch.advantages
    assert entropy is not None
    if config.normalize_advantage and collected > 1:
        whole = advantage if among is None else among if mirror is None else among.repeat(2)
        advantage = (advantage - whole.mean()) / (whole.std() + 1e-8)
    log_ratio = log_prob - batch.old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - config.clip_range, 1 + config.clip_range)
    policy_loss = -torch.min(advantage * ratio, advantage * clipped).mean()
    if config.value_clip is not None:
        values = batch.old_values + (values - batch.old_values).clamp(-config.value_clip, config.value_clip)
    value_loss, entropy_loss = mse_loss(batch.returns, values), -entropy.mean()
    estimation = policy.mlp_extractor.estimation_loss(batch.observations)
    total = policy_loss + config.entropy * entropy_loss + config.value_coef * value_loss
    total = total + policy.estimator.weight * estimation
    with torch.no_grad():
        log_ratio, ratio = log_ratio[:collected], ratio[:collected]
        clip_fraction = ((ratio - 1).abs() > config.clip_range).float().mean()
        approx_kl = ((ratio - 1) - log_ratio).mean()
    return Loss(total, policy_loss, value_loss, entropy_loss, clip_fraction, approx_kl, estimation)


def write_advantages(
    advantages: Tensor,
    rewards: Tensor,
    values: Tensor,
    starts: Tensor,
    last_values: Tensor,
    last_ended: Tensor,
    gamma: float,
    gae_lambda: float,
) -> None:
    """Write the generalised advantage estimates (Schulman et al. 2016, equation 16) of a rollout into ``advantages``.

    Args:
        advantages: (T, N), written.
        rewards: (T, N); a step that met a time limit has the discounted value of what would have come after it in it.
        values: (T, N) of the states in which the steps were taken.
        starts: (T, N) float, 1 where an episode began with the step.
        last_values: (N,) of the states after the rollout.
        last_ended: (N,) whether an episode ended with the last step.
        gamma: discount of a step.
        gae_lambda: weight of longer looks ahead.
    """
    advantage = torch.zeros_like(last_values)
    for step in reversed(range(len(rewards))):
        last = step == len(rewards) - 1
        continues = 1.0 - (last_ended.float() if last else starts[step + 1])
        after = last_values if last else values[step + 1]
        delta = rewards[step] + gamma * after * continues - values[step]
        advantage = delta + gamma * gae_lambda * continues * advantage
        advantages[step].copy_(advantage)


class SampleMirror(NamedTuple):
    """The mirrors of a policy's input (O columns) and of its output (A)."""

    observation: Mirror
    action: Mirror = ACTION

    def joined(self, batch: RolloutBufferSamples) -> RolloutBufferSamples:
        """Return (2 B) samples: ``batch`` (B), then its image."""
        images = batch._replace(observations=self.observation(batch.observations), actions=self.action(batch.actions))
        pairs = zip(batch, images, strict=True)
        return RolloutBufferSamples(*(torch.cat(pair) for pair in pairs))


def mirror_of(observations: Iterable[Term]) -> SampleMirror:
    """Return the mirror of a policy that sees these terms one after the other; each must declare its own."""
    return SampleMirror(side_by_side(t.entry.traits["mirror"].repeated(frames_of(t)) for t in observations))
