"""What every actuator promises beyond ``check_actuator`` (``test_members.py``), and the law of PD."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import go1exp.sim.task  # noqa: F401  (registers every member)
from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.registry import members
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.motors import Actuator

NEEDS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "delay": lambda net: {"drive": {"term": "pd"}},
    "net": lambda net: {"file": str(net)},
}
"""Member -> what it cannot be built without, given the file of a net."""

EVERY = [*members("actuator"), "delay of net"]


@pytest.fixture(params=EVERY)
def name(request: pytest.FixtureRequest) -> str:
    """Name of a member, or of one wrapped in another."""
    return str(request.param)


@pytest.fixture(scope="session")
def net_file(make_net: Callable[..., Path]) -> Path:
    """A net whose law keeps the promise to be still at rest: those of most files keep it approximately."""
    return make_net(bias=0.0, torque=300.0)


@pytest.fixture
def build(name: str, drives: Callable[..., ActuatorSetup], net_file: Path) -> Callable[..., Actuator]:
    """Build the member for n robots, the first of them number ``first`` of a batch; their first episode begins."""
    member, _, inner = name.partition(" of ")
    parameters = NEEDS.get(member, lambda net: {})(net_file)
    if inner:
        parameters["drive"] = {"term": inner, **NEEDS[inner](net_file)}

    def make(n: int, first: int = 0) -> Actuator:
        made: Actuator = members("actuator")[member].target(drives(n, random=EnvRandom(0, n, first)), **parameters)
        made.reset(torch.ones(n, dtype=torch.bool))
        return made

    return make


def joint_noise(n: int, scale: float, seed: int = 0) -> Tensor:
    return torch.as_tensor(np.random.default_rng(seed).normal(0.0, scale, (n, 12)))


def moment(n: int, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """Target, angle and speed at step k."""
    return joint_noise(n, 0.3, k), joint_noise(n, 0.3, k + 100), joint_noise(n, 3.0, k + 200)


def test_it_gives_no_torque_without_error_at_rest(build: Callable[..., Actuator]) -> None:
    actuator = build(3)
    q = torch.as_tensor(robot.NOMINAL_STANCE).repeat(3, 1)
    for _ in range(10):
        assert not actuator.torque(q, q, torch.zeros_like(q)).any()


def test_it_begins_an_episode_as_if_it_were_the_first(build: Callable[..., Actuator]) -> None:
    used, new = build(4), build(4)
    for k in range(20):
        used.torque(*moment(4, k))
    for actuator in (used, new):  # the same number of times, for whatever is drawn at a reset
        actuator.reset(torch.ones(4, dtype=torch.bool))
    for k in range(20):
        assert torch.equal(used.torque(*moment(4, k)), new.torque(*moment(4, k))), k


def test_a_saved_state_is_a_copy(build: Callable[..., Actuator]) -> None:
    def numbers(state: dict[str, Any]) -> list[Tensor]:
        return [t for value in state.values() for t in (numbers(value) if isinstance(value, dict) else [value])]

    actuator = build(2)
    state = actuator.state_dict()
    before = [t.clone() for t in numbers(state)]
    for k in range(5):
        actuator.torque(*moment(2, k))
    actuator.reset(torch.tensor([True, False]))
    assert all(torch.equal(a, b) for a, b in zip(before, numbers(state), strict=True))


def test_pd_is_the_law_of_the_firmware(drives: Callable[..., ActuatorSetup]) -> None:
    pd = members("actuator")["pd"].target(drives(1), kp=20.0, kd=0.5)
    target, q, qd = torch.zeros(3, 1, 12, dtype=torch.float64)
    target[0, 0], q[0, 0], qd[0, 0] = 0.3, 0.1, -2.0  # 20 x 0.2 + 0.5 x 2
    qd[0, 1] = 4.0  # -0.5 x 4
    target[0, 2], target[0, 3], target[0, 4] = 9.0, -9.0, 9.0
    assert pd.torque(target, q, qd)[0, :6].tolist() == pytest.approx([5.0, -2.0, 35.55, -23.7, 23.7, 0.0])
