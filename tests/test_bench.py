"""What a benchmark says could be reached at best."""

from __future__ import annotations

from typing import Any

import pytest
from torch.utils.flop_counter import FlopCounterMode

from go1exp.config.compose import compose
from go1exp.evaluate.bench import env
from go1exp.sim.task import parse_train
from go1exp.train import trainer
from tests.small_run import SMALL


@pytest.mark.parametrize("symmetry", [False, True])
def test_the_least_update_has_the_products_of_an_update(symmetry: bool) -> None:
    """Its floating-point operations are those of ``train``, but for the gradient of the observations."""
    ppo = trainer.build(parse_train(compose("train", [*SMALL, f"ppo.symmetry={symmetry}"])))
    ppo.learn(ppo.n_envs * ppo.n_steps)
    with FlopCounterMode(display=False) as whole:
        ppo.train()
    with FlopCounterMode(display=False) as least:
        steps = env.products_subject(ppo)()
    assert steps == ppo.n_envs * ppo.n_steps
    networks: Any = ppo.policy.mlp_extractor
    first = sum(net[0].weight.numel() for net in (networks.policy_net, networks.value_net))
    rows = ppo.n_epochs * ppo.n_envs * ppo.n_steps * (2 if symmetry else 1)
    assert least.get_total_flops() - 2 * rows * first == whole.get_total_flops()


def test_the_limit_adds_the_times_of_environment_and_products() -> None:
    measured = {"env": [1000.0, 3000.0, 1000.0], "matrix_products": [1000.0, 1000.0, 3000.0]}
    assert env.least_time_share(measured) == pytest.approx(0.5)  # of 1/2, 1/4 and 3/4
