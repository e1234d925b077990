"""Robots that hang at attitudes of their own, side by side in one batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind_list
from go1exp.gap.replay.replayer import LEVEL, hold
from go1exp.gap.robots.go1 import suspended
from go1exp.sim.env.plant import Plant
from go1exp.sim.task import parse_parts

HANGS = np.array([LEVEL, (0.98, 0.0, 0.199, 0.0), (0.9, 0.3, -0.1, 0.3)])  # not all of unit length, as logs have them
DT, STEPS = 0.001, 300


def moved(num: int, built: Any, quats: np.ndarray | None, mounted: bool, effects: dict[str, Any]) -> torch.Tensor:
    """Return where the joints (N, 12) of robots are that step from rest."""
    machine = suspended(parse_parts(compose("gap", ["logs=none"]), ("robot",))[0]["robot"])
    backend, setup = machine.build(num, DT, built, 1, mounted)
    if quats is not None:
        hold(backend, quats)
    plant = Plant(backend, setup, machine.drive(), bind_list("effect", [effects], "effect"))
    plant.set_gains(torch.full_like(plant.q, 20.0), torch.full_like(plant.q, 0.5))
    plant.startup()
    qpos = torch.zeros_like(backend.qpos)
    qpos[:, -robot.NUM_JOINTS :] = torch.as_tensor(robot.NOMINAL_STANCE)
    everyone, rest = torch.ones(num, dtype=torch.bool), qpos[:, -robot.NUM_JOINTS :].clone()
    backend.reset(everyone, qpos, torch.zeros_like(backend.qvel))
    plant.reset(everyone, rest)
    for _ in range(STEPS):
        plant.step(rest + 0.1)
    return plant.q.clone()


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("tilt", [{}, {"base_tilt": {"roll": 0.05, "pitch": -0.1}}])
def test_each_moves_as_one_that_is_compiled_so(mounted: bool, tilt: dict[str, Any]) -> None:
    stand = {"soft_mount": {"pitch": 0.02, "roll": 0.02}} if mounted else {}
    together = moved(3, LEVEL, HANGS, mounted, {**tilt, **stand})
    for k, quat in enumerate(HANGS / np.linalg.norm(HANGS, axis=1, keepdims=True)):
        alone = moved(1, tuple(quat), None, mounted, {**tilt, **stand})
        torch.testing.assert_close(together[k : k + 1], alone, rtol=0.0, atol=1e-9)
    assert (together[0] - together[2]).abs().max() > 1e-3
