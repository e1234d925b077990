"""Torque that is fed forward: where it enters, how late, and that nothing changes without it."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from go1exp import robot
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.plant import Plant

Make = Callable[..., Go1Core]

HUNG = ("rand=none", "event=none", "termination=none")
LEVEL = (1.0, 0.0, 0.0, 0.0)
LIMIT = torch.as_tensor(robot.per_joint(robot.EFFORT_LIMIT))


def hung(start_core: Make, *overrides: str, n: int = 3) -> Plant:
    """N robots on a stand, in the nominal stance, at rest."""
    core = start_core(*HUNG, *overrides, num_envs=n, held=LEVEL)
    return core.plant


def torques(n: int, scale: float, seed: int = 0) -> Tensor:
    return torch.as_tensor(np.random.default_rng(seed).normal(0.0, scale, (n, 12)))


def stance(n: int) -> Tensor:
    return torch.as_tensor(robot.NOMINAL_STANCE).repeat(n, 1)


def limp(plant: Plant) -> None:
    """Take the drives' gains away."""
    plant.set_gains(torch.zeros_like(plant.q), torch.zeros_like(plant.q))


DRIVES = [
    (),
    ("actuator=dc_motor",),
    ("actuator=voltage",),
    ("actuator=delay", "actuator.command=[0.006,0.006]"),
    ("effect=[command_delay,strength]", "effect.command_delay.delay=0.005", "effect.strength.scale=0.8"),
]


@pytest.mark.parametrize("overrides", DRIVES)
def test_none_is_what_there_was_and_zeros_change_no_bit(make_core: Make, overrides: tuple[str, ...]) -> None:
    without, zeros = hung(make_core, *overrides), hung(make_core, *overrides)
    for k in range(20):
        target = stance(3) + 0.05 * torques(3, 1.0, k)
        without.step(target)
        zeros.step(target, torch.zeros(3, 12, dtype=target.dtype))
        assert torch.equal(without.torque, zeros.torque)
        assert torch.equal(without.q, zeros.q)
    assert "fed" not in without.state_dict()


def test_the_torque_is_the_drives_own_plus_what_is_fed_within_the_limit(make_core: Make) -> None:
    plant = hung(make_core)
    for k in range(10):
        target, fed = stance(3) + 0.2 * torques(3, 1.0, k), torques(3, 20.0, 100)
        q, speed = plant.q.clone(), plant.speed().clone()
        before = plant._target.clone()
        plant.step(target, fed)
        share = 0.5 if k == 0 else 1.0  # a change counts for half of its step
        wanted = 20.0 * (0.5 * (before + target) - q) - 0.5 * speed + share * fed
        torch.testing.assert_close(plant.torque, wanted.clamp(-LIMIT, LIMIT), rtol=0.0, atol=1e-12)
    assert (wanted.abs() > LIMIT).any()


def test_limp_drives_accelerate_joints_as_inverse_dynamics_says(make_core: Make) -> None:
    plant = hung(make_core, n=1)
    limp(plant)
    fed = torques(1, 3.0)
    plant.step(stance(1), fed)
    data = mujoco.MjData(plant.backend.model)
    before = deepcopy(plant.backend.qvel)
    data.qpos[:], data.qvel[:] = plant.backend.qpos[0].numpy(), before[0].numpy()
    plant.step(stance(1), fed)
    data.qacc[:] = (plant.backend.qvel - before)[0].numpy() / 0.002
    mujoco.mj_inverse(plant.backend.model, data)
    np.testing.assert_allclose(data.qfrc_inverse, fed[0], atol=1e-6)


@pytest.mark.parametrize(
    "overrides",
    [
        ("actuator=delay", "actuator.command=[0.006,0.006]"),
        ("effect=command_delay", "effect.command_delay.delay=0.006"),
    ],
)
def test_it_is_as_late_as_the_target(make_core: Make, overrides: tuple[str, ...]) -> None:
    plant, one = hung(make_core, *overrides), stance(3)
    still = torch.zeros(3, 12, dtype=one.dtype)
    limp(plant)
    for _ in range(5):
        plant.step(one, still)
    seen = []
    for _ in range(6):
        plant.step(one, still + 2.0)
        seen.append(float(plant.torque[0, 0]))
    np.testing.assert_allclose(seen, [0.0, 0.0, 0.0, 1.0, 2.0, 2.0], atol=1e-12)


def test_a_weak_drive_makes_less_of_it_and_a_net_adds_it(make_core: Make, make_net: Callable[..., Path]) -> None:
    weak = hung(make_core, "effect=strength", "effect.strength.scale=0.5", "effect.strength.spread.scale=0.0")
    limp(weak)
    fed = torques(3, 5.0)
    for _ in range(3):
        weak.step(stance(3), fed)
    torch.testing.assert_close(weak.torque, 0.5 * fed.clamp(-LIMIT, LIMIT), rtol=0.0, atol=1e-12)
    net = ("actuator=net", f"actuator.file={make_net()}")
    with_it, without = hung(make_core, *net), hung(make_core, *net)
    with_it.step(stance(3), fed)
    without.step(stance(3))
    expected = (without.torque + 0.5 * fed).clamp(-LIMIT, LIMIT)
    torch.testing.assert_close(with_it.torque, expected, rtol=0.0, atol=1e-12)


def test_a_stop_and_a_new_start_continue_bit_for_bit(make_core: Make) -> None:
    options = (
        "actuator=delay",
        "actuator.command=[0.004,0.01]",
        "effect=command_delay",
        "effect.command_delay.delay=0.003",
    )
    through, resumed = hung(make_core, *options), hung(make_core, *options)
    for k in range(10):
        through.step(stance(3), torques(3, 5.0, k))
    resumed.load_state_dict(deepcopy(through.state_dict()))
    resumed.backend.load_state_dict(deepcopy(through.backend.state_dict()))
    for k in range(10, 20):
        for plant in (through, resumed):
            plant.step(stance(3), torques(3, 5.0, k))
        assert torch.equal(through.torque, resumed.torque)
        assert torch.equal(through.q, resumed.q)


def test_a_reset_forgets_it_in_its_rows_only(make_core: Make) -> None:
    plant = hung(make_core)
    limp(plant)
    for _ in range(3):
        plant.step(stance(3), torch.full((3, 12), 2.0, dtype=torch.float64))
    plant.reset(torch.tensor([True, False, False]), stance(3))
    plant.step(stance(3))
    assert plant.torque[:, 0].tolist() == [0.0, 1.0, 1.0]


class Old:
    """A drive as plugins had them before torques could be fed forward."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        return torch.zeros_like(q)


def test_a_drive_that_takes_none_is_named(make_core: Make) -> None:
    plant = hung(make_core)
    plant.actuator = Old()  # type: ignore[assignment]
    plant.step(stance(3))
    with pytest.raises(ConfigError, match="Old takes no feed-forward torque; use actuator=pd"):
        plant.step(stance(3), torques(3, 1.0))
