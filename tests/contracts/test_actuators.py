"""What every actuator promises, and the law of each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import go1exp.config  # noqa: F401  (registers every member)
from go1exp import robot
from go1exp.drive import DriveSetup
from go1exp.registry import Entry, members


def each(group: str) -> Any:
    """Parametrise a test over the members of a group."""
    return pytest.mark.parametrize("entry", members(group).values(), ids=members(group).keys())


def joint_noise(n: int, scale: float, seed: int = 0) -> Tensor:
    return torch.as_tensor(np.random.default_rng(seed).normal(0.0, scale, (n, 12)))


@each("actuator")
def test_an_actuator_never_exceeds_the_torque_limit(entry: Entry, drives: Callable[..., DriveSetup]) -> None:
    actuator = entry.target(drives(20))
    limit = torch.tensor([23.7, 23.7, 35.55] * 4, dtype=torch.float64)
    reached = torch.zeros(12, dtype=torch.bool)
    for k in range(20):
        tau = actuator.torque(joint_noise(20, 5.0, k), joint_noise(20, 5.0, k + 100), joint_noise(20, 20.0, k + 200))
        assert tau.shape == (20, 12)
        assert (tau.abs() <= limit).all()
        reached |= (tau.abs() > 0.999 * limit).any(0)
    assert reached.all()


@each("actuator")
def test_an_actuator_gives_no_torque_without_error_at_rest(entry: Entry, drives: Callable[..., DriveSetup]) -> None:
    actuator = entry.target(drives(3))
    q = torch.as_tensor(robot.NOMINAL_STANCE).repeat(3, 1)
    for _ in range(10):
        assert not actuator.torque(q, q, torch.zeros_like(q)).any()


@each("actuator")
def test_an_actuator_drives_a_robot_the_same_alone_and_in_a_batch(entry: Entry, drives: Callable[..., DriveSetup]) -> None:
    batch, alone = entry.target(drives(5)), [entry.target(drives(1)) for _ in range(5)]
    for k in range(30):
        inputs = joint_noise(5, 0.3, k), joint_noise(5, 0.3, k + 100), joint_noise(5, 3.0, k + 200)
        if k == 15:
            batch.reset(torch.tensor([False, True, False, True, False]))
            for i in (1, 3):
                alone[i].reset(torch.tensor([True]))
        together = batch.torque(*inputs)
        for i in range(5):
            single = alone[i].torque(*(x[i : i + 1] for x in inputs))
            assert torch.equal(together[i : i + 1], single), (k, i)


@each("actuator")
def test_an_actuator_continues_from_its_saved_state_and_leaves_its_inputs_alone(entry: Entry, drives: Callable[..., DriveSetup]) -> None:
    first, second = entry.target(drives(3)), entry.target(drives(3))
    for k in range(20):
        inputs = joint_noise(3, 0.3, k), joint_noise(3, 0.3, k + 100), joint_noise(3, 3.0, k + 200)
        copies = [x.clone() for x in inputs]
        tau = first.torque(*inputs)
        assert all(torch.equal(a, b) for a, b in zip(inputs, copies, strict=True))
        if k >= 10:
            assert torch.equal(tau, second.torque(*inputs))
        elif k == 9:
            second.load_state_dict(first.state_dict())


def test_pd_is_the_law_of_the_firmware(drives: Callable[..., DriveSetup]) -> None:
    pd = members("actuator")["pd"].target(drives(1), kp=20.0, kd=0.5)
    target, q, qd = torch.zeros(3, 1, 12, dtype=torch.float64)
    target[0, 0], q[0, 0], qd[0, 0] = 0.3, 0.1, -2.0  # 20 x 0.2 + 0.5 x 2
    qd[0, 1] = 4.0  # -0.5 x 4
    target[0, 2], target[0, 3], target[0, 4] = 9.0, -9.0, 9.0
    assert pd.torque(target, q, qd)[0, :6].tolist() == pytest.approx([5.0, -2.0, 35.55, -23.7, 23.7, 0.0])
