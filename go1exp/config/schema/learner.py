"""Settings of the learner, of its logs and of its checkpoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT, Fraction, NonNegative, Positive

Count = Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class PPOConfig:
    """The learner. Its numbers in ``conf/ppo`` are the paper's (section III-A) and, where it prints none, Isaac Lab's.

    Attributes:
        num_envs: environments that run side by side.
        iterations: rollouts, each followed by an update.
        steps: policy steps per environment and iteration.
        epochs: passes over a rollout.
        minibatches: gradient steps per pass; must divide num_envs x steps.
        learning_rate: step size of Adam; the first value unless the schedule is fixed.
        schedule: ``adaptive`` steers the rate by the KL divergence (rsl_rl's rule), ``fixed`` keeps it, ``linear``
            lowers it to the least of ``learning_rate_range`` over the iterations.
        desired_kl: the divergence per update that ``adaptive`` aims at.
        max_kl: an update ends before the gradient step, not its first, at which the divergence from the policy that
            collected the rollout is above this; null for no such end. For fine-tuning, whose first updates can throw a
            policy away.
        learning_rate_range: bounds of the learning rate.
        gamma: discount factor.
        gae_lambda: decay of the advantage estimator (GAE).
        clip_range: how far the probability ratio may move from 1.
        value_clip: bound of the value function's change; null for none.
        entropy: weight of the entropy bonus.
        value_coef: weight of the value loss.
        max_grad_norm: gradient clip, norm over actor and critic together.
        normalize_advantage: normalise advantages over each minibatch, as SB3 does.
        init_std: initial standard deviation of the actions.
        orthogonal_init: SB3's initial weights (gain sqrt(2), last layer of the actor 0.01); else PyTorch's, as rsl_rl.
        hidden: layers of actor and critic each.
        activation: nonlinearity between the layers.
        matmul_precision: ``highest`` is float32; ``bf16`` runs the update's matrix products in bfloat16; ``auto`` is
            ``bf16`` on a processor with units for it and ``highest`` on all others, which are much slower in it.
        symmetry: join each minibatch with its mirror image, left for right (Mittal et al., arXiv 2403.04359).
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    num_envs: Count
    iterations: Count
    steps: Count
    epochs: Count
    minibatches: Count
    learning_rate: Positive
    schedule: Literal["adaptive", "fixed", "linear"]
    desired_kl: Positive
    learning_rate_range: tuple[Positive, Positive]
    gamma: Fraction
    gae_lambda: Fraction
    clip_range: Positive
    value_clip: Positive | None
    entropy: NonNegative
    value_coef: NonNegative
    max_grad_norm: Positive
    normalize_advantage: bool
    init_std: Positive
    orthogonal_init: bool
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)]
    activation: Literal["elu", "relu", "tanh"]
    matmul_precision: Literal["highest", "bf16", "auto"]
    symmetry: bool = False  # runs of older versions do not have the key
    max_kl: Positive | None = None  # nor this one


@dataclass(frozen=True)
class WandbConfig:
    """Weights & Biases.

    Attributes:
        project: name of the project.
        mode: offline, or online, which needs an account.
        group: name under which runs are shown together; null takes that of the sweep, if there is one.
        entity: team or user, or null for the account's default.
        name: of the run; null takes the run folder's.
        tags: of the run, to find it by.
        notes: a sentence on what it is for.
        artifacts: log newest and best checkpoint, and the bundle of go1exp export, when training ends.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    project: Annotated[str, Field(min_length=1)]
    mode: Literal["offline", "online"]
    group: str | None
    entity: str | None
    name: str | None = None
    tags: tuple[str, ...] = ()
    notes: str | None = None
    artifacts: bool = False


@dataclass(frozen=True)
class LoggerConfig:
    """Where metrics go besides the progress bar.

    Attributes:
        csv: write metrics.csv in the run folder.
        tensorboard: write TensorBoard's event files in the run folder.
        wandb: Weights & Biases, or null for none.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    csv: bool
    tensorboard: bool
    wandb: WandbConfig | None


@dataclass(frozen=True)
class CheckpointConfig:
    """When checkpoints are written.

    Attributes:
        every: iterations from checkpoint to checkpoint.
        keep: newest checkpoints that stay.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    every: Count
    keep: Count
