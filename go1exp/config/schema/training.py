"""Settings of a training: learner, logs, checkpoints, auxiliary evaluation and videos, early stopping, schedules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.config.schema.registry import Count, CountOrZero, Duration, Fraction, NonNegative, Positive, Strict


@dataclass(frozen=True)
class PPOConfig(Strict):
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
        matmul_precision: of the update's matrix products. ``highest`` is float32; ``tf32`` rounds their factors to 10
            bits on a GPU and is ``highest`` elsewhere; ``bf16`` is bfloat16; ``auto`` is ``bf16`` on a processor with
            units for it and ``highest`` on all others, which are much slower in it.
        symmetry: join each minibatch with its mirror image, left for right (Mittal et al., arXiv 2403.04359).
        coarse_physics: physics step of the training over sim.physics_dt, which evaluations take. It is made shorter
            where it does not divide sim.policy_dt, and a net keeps its own period.
    """

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
    matmul_precision: Literal["highest", "tf32", "bf16", "auto"]
    symmetry: bool = False  # runs of older versions do not have the key
    max_kl: Positive | None = None  # nor this one
    coarse_physics: Annotated[int, Field(ge=1, le=10_000)] = 1


@dataclass(frozen=True)
class WandbConfig(Strict):
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

    project: Annotated[str, Field(min_length=1)]
    mode: Literal["offline", "online"]
    group: str | None
    entity: str | None
    name: str | None = None
    tags: tuple[str, ...] = ()
    notes: str | None = None
    artifacts: bool = False


@dataclass(frozen=True)
class LoggerConfig(Strict):
    """Where metrics go besides the progress bar.

    Attributes:
        csv: write metrics.csv in the run folder.
        tensorboard: write TensorBoard's event files in the run folder.
        wandb: Weights & Biases, or null for none.
    """

    csv: bool
    tensorboard: bool
    wandb: WandbConfig | None


@dataclass(frozen=True)
class CheckpointConfig(Strict):
    """When checkpoints are written.

    Attributes:
        every: iterations from checkpoint to checkpoint.
        keep: newest checkpoints that stay.
    """

    every: Count
    keep: Count


ROWS = "evals.csv"
"""File of a run folder: a row for each evaluation."""

EVALUATED = "eval/"
"""Begin of metrics that are columns of ``ROWS``, as trainings log them."""


@dataclass(frozen=True)
class EvalDuring(Strict):
    """Evaluation in a process of its own, on the CPU engine, while training goes on; the best policy is kept.

    Attributes:
        every: iterations from evaluation to evaluation; 0 for none.
        x: commanded forward velocities, m/s.
        y: velocities to the left, m/s.
        yaw: yaw rates, rad/s.
        episodes: robots of each command.
        seconds: length of an episode, s.
        settle_s: time at its start that does not count for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training.
        seed: seed of everything random, the same each time.
    """

    every: CountOrZero = 0
    x: tuple[float, ...] = (-0.5, 0.5, 1.0)
    y: tuple[float, ...] = (0.5,)
    yaw: tuple[float, ...] = (1.0,)
    episodes: Count = 8
    seconds: Duration = 8.0
    settle_s: NonNegative = 2.0
    noise: bool = True
    randomize: bool = True
    seed: CountOrZero = 1


@dataclass(frozen=True)
class VideoDuring(Strict):
    """Videos in the same process.

    Attributes:
        every: iterations from video to video; 0 for none.
        seconds: length of a video, s.
        velocity: commanded velocity in it, x m/s, y m/s, yaw rad/s.
    """

    every: CountOrZero = 0
    seconds: Duration = 6.0
    velocity: tuple[float, float, float] = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class StopRule(Strict):
    """When a training ends before its last iteration.

    Attributes:
        figure: metric that decides, such as rollout/return, or eval/score with eval.every; null for none.
        better: whether higher or lower values of it are better.
        at: value that is good enough; null for none.
        patience: iterations without a better value than before after which training ends; null for none.
        least: by how much a value must be better to count.
    """

    figure: str | None = None
    better: Literal["higher", "lower"] = "higher"
    at: float | None = None
    patience: Count | None = None
    least: NonNegative = 0.0

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.figure is None and not (self.at is None and self.patience is None):
            raise ValueError("figure = None: at and patience need one, such as rollout/return")
        if self.figure is not None and self.at is None and self.patience is None:
            raise ValueError(f"figure = {self.figure!r}: needs at or patience, or both")


@dataclass(frozen=True)
class EstimatorConfig(Strict):
    """What the actor reads beside its observation: a latent that an encoder makes of it (``train/network.py``).

    Attributes:
        latent: numbers of the latent; 0 for no estimator.
        hidden: layers of the encoder.
        weight: of the estimator's loss beside PPO's.
    """

    latent: CountOrZero = 0
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (256, 128)
    weight: Positive = 1.0


BESIDE: dict[str, Any] = {
    "eval": EvalDuring(),
    "video": VideoDuring(),
    "stop": StopRule(),
    "estimator": EstimatorConfig(),
}
"""Sections of the configuration, as they are where a run does not have them."""


Iterations = Annotated[int, Field(ge=1, le=1000)]
Value = float | tuple[float, float]


@dataclass(frozen=True)
class Trigger(Strict):
    """A training metric that starts a ramp.

    Attributes:
        measure: metric of the training's log, such as gait/trot_error; none of eval/ and time/.
        below: the ramp starts when the metric's mean is at most this.
        above: or when it is at least this.
        iterations: iterations over which the mean is taken.
        also: another metric that must be at its threshold at the same time.
    """

    measure: str
    below: float | None = None
    above: float | None = None
    iterations: Iterations = 5
    also: Trigger | None = None

    def __post_init__(self) -> None:
        """Check that there is one threshold."""
        if (self.below is None) == (self.above is None):
            raise ValueError("measure: needs one of below and above")

    def __str__(self) -> str:
        """Return the metric and its threshold."""
        threshold = f">= {self.above}" if self.below is None else f"<= {self.below}"
        return f"{self.measure} {threshold}"

    def satisfied_by(self, mean: float) -> bool:
        """Return whether the ramp starts at this mean of the metric."""
        return mean <= self.below if self.below is not None else mean >= (self.above or 0.0)

    def all(self) -> tuple[Trigger, ...]:
        """Return this trigger and those that must be satisfied with it."""
        return (self, *(self.also.all() if self.also else ()))


@dataclass(frozen=True)
class Ramp(Strict):
    """One setting that moves linearly from one value to another while a policy is trained.

    Attributes:
        set: key of the setting, such as reward.touchdown_speed.weight, actuator.command or contact.time_constant.
        from: value before the ramp.
        to: value after it; without it the configured one.
        start: time after which the ramp starts, in unit; 0 without when.
        over: time that the ramp takes, in unit; 0 is a jump.
        when: start at a metric's threshold instead, {measure, below or above, iterations, also}.
        unit: steps of all robots together, iterations, which suit small and large batches alike, or share, of all
            steps that the training will make.
        optional: leave the ramp out of a task without this setting, such as a delay with actuator=pd, or
            where it is drawn for each robot.
    """

    path: Annotated[str, Field(alias="set")]
    first: Annotated[Value, Field(alias="from")]
    over: NonNegative
    last: Annotated[Value | None, Field(alias="to")] = None
    start: NonNegative | None = None
    when: Trigger | None = None
    unit: Literal["steps", "iterations", "share"] = "steps"
    optional: bool = False

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.start is not None and self.when is not None:
            raise ValueError("when: start has no meaning beside it; give one of the two")

    def value(self, since_start: float) -> Value:
        """Return the value some time, in ``unit``, after the ramp's start; negative before it."""
        assert self.last is not None
        if since_start < 0.0:
            return self.first
        if since_start >= self.over:
            return self.last
        share = since_start / self.over
        if isinstance(self.first, tuple) and isinstance(self.last, tuple):
            low, high = (a + share * (b - a) for a, b in zip(self.first, self.last, strict=True))
            return low, high
        assert isinstance(self.first, float)
        assert isinstance(self.last, float)
        return self.first + share * (self.last - self.first)
