"""The batched environment from overrides: ``go1exp.make``."""

from __future__ import annotations

from collections.abc import Sequence

from go1exp.config.compose import compose
from go1exp.sim.env.arguments import listed, whole
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_task


def make(
    overrides: Sequence[str] = (),
    num_envs: int = 1024,
    seed: int = 0,
    *,
    noise: bool = True,
    spread_starts: bool = False,
) -> Go1Core:
    """Return N robots that step together on torch tensors, as training has them.

    ``reset()`` returns observations (N, O); ``step(actions)`` takes (N, 12) and returns a ``StepResult``; episodes that
    end begin anew by themselves. All tensors are on ``device`` of the result and valid until the next step.

    Args:
        overrides: as after ``go1exp train``; those of the learner and the run are ignored.
        num_envs: N.
        seed: of everything random.
        noise: add the configured observation noise.
        spread_starts: let first episodes begin at random times, so that not all end together.

    Raises:
        go1exp.config.schema.registry.ConfigError: if an override, a number of robots or a seed is invalid.
    """
    num_envs, seed = whole("num_envs", num_envs, 1), whole("seed", seed, 0)
    task = parse_task(compose("train", listed(overrides)))
    return Go1Core(task, num_envs, seed, noise=noise, spread_starts=spread_starts)
