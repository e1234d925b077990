"""What the tests share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from go1exp.compose import compose
from go1exp.config import TaskConfig, parse_task
from go1exp.env.core import Go1Core

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
