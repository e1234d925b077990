"""Fixtures of all tests; tests/conftest.py loads them."""

from __future__ import annotations

import os
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.extend.testing.actuators import go1_actuators
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.actuator_net import ActuatorNet, NetInfo, Provenance, group_names
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig, parse_task
from tests.small_run import made_once, plain, trained

if TYPE_CHECKING:
    from go1exp.evaluate.agents import PolicyAgent
    from go1exp.evaluate.protocol.stage import Stage

torch.set_num_threads(1)


@cache
def composed(overrides: tuple[str, ...], folder: str) -> dict[str, Any]:
    """Compose once what many tests begin with; paths among the overrides begin at ``folder``."""
    return compose("train", overrides)


@pytest.fixture(scope="session")
def make_task() -> Callable[..., TaskConfig]:
    """Parse the environment's configuration from command-line overrides."""
    return lambda *overrides: parse_task(deepcopy(composed(plain(*overrides), os.getcwd())))


@pytest.fixture
def make_core(make_task: Callable[..., TaskConfig]) -> Callable[..., Go1Core]:
    """Build a batched environment from overrides; keyword arguments go to ``Go1Core``."""

    def make(*overrides: str, num_envs: int = 4, **kwargs: Any) -> Go1Core:
        return Go1Core(make_task("backend.threads=1", *overrides), num_envs, **kwargs)

    return make


@pytest.fixture
def start_core(make_core: Callable[..., Go1Core]) -> Callable[..., Go1Core]:
    """Build as ``make_core`` does, and begin the first episodes."""

    def start(*overrides: str, **kwargs: Any) -> Go1Core:
        core = make_core(*overrides, **kwargs)
        core.reset()
        return core

    return start


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of a bundle of two tiny iterations: its policy hardly moves, so that a robot stands."""
    from go1exp.deploy.export.build import build

    def make(path: Path) -> None:
        run = trained(tmp_path_factory.mktemp("walk") / "run", "actuator.kp=35", "actuator.kd=0.7")
        path.write_bytes(build(run, seconds=0.2))

    return str(made_once(tmp_path_factory, "walk.zip", make))


@pytest.fixture(scope="session")
def stands(make_task: Callable[..., TaskConfig]) -> PolicyAgent:
    """Nominal robots that hold their stance."""
    from go1exp.evaluate.agents import PolicyAgent

    task = make_task("backend.threads=1", "sim.physics_dt=0.005", "rand=none")
    return PolicyAgent("stands", task, lambda observation: torch.zeros(len(observation), 12))


@pytest.fixture(scope="session")
def stage(stands: PolicyAgent) -> Stage:
    """They are to play something, without noise."""
    from go1exp.evaluate.protocol.stage import Setting, Stage

    return Stage(stands, Setting(noise=False, randomize=False, trunk_velocity="exact", seed=1))


@pytest.fixture
def drives() -> Callable[..., ActuatorSetup]:
    """Describe the drives of n Go1 robots at 2 ms; keyword arguments change that."""
    return go1_actuators


def random_net(
    seed: int = 0, bias: float = 0.1, skip: float = 0.0, torque: float = 10.0, **changes: Any
) -> ActuatorNet:
    """An actuator net of the Go1 that nobody fitted, of the size of ``torque`` N m; ``changes`` to what it says."""
    about = Provenance({}, (), (), (), 0.0, seed, "{}", {})
    usual: dict[str, Any] = {
        "robot": "go1",
        "joints": robot.JOINTS,
        "share": "kind",
        "inputs": ("position_error", "velocity"),
        "history": 3,
        "period": 0.002,
        "hidden": (8, 6, 7),
        "target": "tau_est",
        "kp": None,
        "kd": None,
        "provenance": about,
    }
    said = {**usual, **changes}
    info = NetInfo(groups=group_names(said["joints"], said["share"]), **said)
    rng, k, f = np.random.default_rng(seed), len(info.groups), info.features
    widths = (f, *info.hidden, 1)
    layers = list(pairwise(widths))
    return ActuatorNet(
        info,
        weights=tuple(rng.normal(0.0, 2.0 / np.sqrt(a), (k, a, b)) for a, b in layers),
        biases=tuple(bias * rng.normal(size=(k, b)) for _, b in layers),
        skip=skip * rng.normal(size=(k, f)),
        input_mean=bias * rng.normal(size=(k, f)),
        input_std=rng.uniform(0.2, 2.0, (k, f)),
        output_mean=bias * rng.normal(size=k),
        output_std=rng.uniform(0.5, 1.0, k) * torque,
        input_low=np.full((k, len(info.inputs)), -1.0),
        input_high=np.full((k, len(info.inputs)), 1.0),
    )


@pytest.fixture(scope="session")
def make_net(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write a random actuator net; keyword arguments as ``random_net``'s."""

    def make(**settings: Any) -> Path:
        path = tmp_path_factory.mktemp("net") / "net.npz"
        random_net(**settings).save(path)
        return path

    return make


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder of its own, as MuJoCo writes its warnings to a file where it runs."""
    monkeypatch.chdir(tmp_path)
