"""What the tests share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from go1exp import robot
from go1exp.compose import compose
from go1exp.config import TaskConfig, parse_task
from go1exp.drive import DriveSetup
from go1exp.env.core import Go1Core
from go1exp.randomness import EnvRandom

torch.set_num_threads(1)  # tests run side by side


@pytest.fixture(scope="session")
def make_task() -> Callable[..., TaskConfig]:
    """Parse the environment's configuration from command-line overrides."""
    return lambda *overrides: parse_task(compose("train", overrides))


@pytest.fixture
def make_core(make_task: Callable[..., TaskConfig]) -> Callable[..., Go1Core]:
    """Build a batched environment from overrides; keyword arguments go to ``Go1Core``."""

    def make(*overrides: str, num_envs: int = 4, **kwargs: Any) -> Go1Core:
        return Go1Core(make_task("backend.threads=1", *overrides), num_envs, **kwargs)

    return make


@pytest.fixture
def drives() -> Callable[..., DriveSetup]:
    """Describe the drives of n Go1 robots at 2 ms; keyword arguments change that."""

    def make(n: int, **changes: Any) -> DriveSetup:
        def spread(values: tuple[float, float, float]) -> torch.Tensor:
            return torch.as_tensor(robot.per_joint(values))

        usual: dict[str, Any] = {
            "num_envs": n,
            "physics_dt": 0.002,
            "joints": robot.JOINTS,
            "effort_limit": spread(robot.EFFORT_LIMIT),
            "velocity_limit": spread(robot.VELOCITY_LIMIT),
            "armature": spread(robot.ROTOR_ARMATURE),
            "random": EnvRandom(0, n),
            "device": torch.device("cpu"),
            "dtype": torch.float64,
        }
        return DriveSetup(**{**usual, **changes})

    return make
