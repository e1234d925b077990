"""What a benchmark says could be reached at best."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import pytest
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import gpu_steps
from go1exp.config.compose import compose
from go1exp.config.schema.physics import WarpBackend
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


@pytest.mark.parametrize("name", gpu_steps.ROWS)
def test_each_row_about_a_gpu_is_a_task_and_an_option_of_mujoco(name: str) -> None:
    change, overrides = gpu_steps.ROWS[name]
    assert isinstance(gpu_steps.task_of(overrides).backend, WarpBackend)
    change(mujoco.MjModel.from_xml_string("<mujoco/>"))


def test_errors_of_the_physics_grow_with_its_step() -> None:
    def off(physics_dt: float) -> dict[str, float]:
        task = dataclasses.replace(plain, sim=dataclasses.replace(plain.sim, physics_dt=physics_dt))
        return gpu_steps.errors(gpu_steps.moved(task, 16, gpu_steps.option()) - reference)

    plain = gpu_steps.task_of(())
    plain = dataclasses.replace(plain, backend=plain.backend.as_reference())
    sim = dataclasses.replace(plain.sim, physics_dt=gpu_steps.FINE)
    reference = gpu_steps.moved(dataclasses.replace(plain, sim=sim), 16, gpu_steps.option())
    fine, coarse = off(0.001), off(0.005)
    assert 0.0 < fine["angle_mrad"] < coarse["angle_mrad"]
    assert 0.0 < fine["height_mm"] < coarse["height_mm"]
