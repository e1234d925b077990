"""Kernels of MuJoCo Warp are compiled side by side before the first step, which then compiles none."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from go1exp.config.compose import compose
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_task

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra gpu"),
    pytest.mark.slow("go1exp/sim/physics/warp_kernels.py", "go1exp/sim/physics/mujoco_warp.py"),
]


@pytest.mark.parametrize("terrain", ["flat", "rough"])
def test_the_first_step_compiles_nothing(terrain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import warp

    task = parse_task(
        compose(
            "train", [f"terrain={terrain}", "backend=warp", "backend.device=cpu", "backend.graph=false", "effect=none"]
        )
    )
    module = type(warp.get_module("any"))
    loaded: list[str] = []
    core = Go1Core(task, 2, 0)
    load = module.load

    def noted(self: warp.Module, *given: object, **named: object) -> object:
        before = set(self.execs)
        done = load(self, *given, **named)
        loaded.extend([self.name] if set(self.execs) != before else [])
        return done

    monkeypatch.setattr(module, "load", noted)
    core.reset()
    core.step(torch.zeros(2, 12))
    assert loaded == []
