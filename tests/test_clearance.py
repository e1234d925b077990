"""No robot starts inside the ground."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.mdp.kinematics import foot_positions
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.scene import load_robot
from go1exp.sim.task import parse_task


def test_the_closed_form_of_the_feet_is_the_models() -> None:
    model = load_robot("merged").compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(*robot.JOINT_POS_LIMITS.T)
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = 0.0, (1.0, 0.0, 0.0, 0.0), q
        mujoco.mj_kinematics(model, data)
        feet = [data.site(f"{leg}_foot").xpos for leg in robot.LEGS]
        np.testing.assert_allclose(foot_positions(torch.as_tensor(q)[None])[0], feet, atol=1e-12)


@pytest.mark.parametrize("terrain", ["flat", "rough"])
def test_no_foot_starts_below_the_ground(terrain: str) -> None:
    core = Go1Core(parse_task(compose("train", [f"terrain={terrain}", "rand=table1"])), 256, seed=3)
    core.reset()
    height = core.snapshot().foot_height
    assert height is not None
    clear = height - robot.FOOT_RADIUS
    assert float(clear.min()) > -1e-4
    lowest = clear.amin(-1)
    assert (lowest < 1e-4).float().mean() > 0.2, "many are lifted just so far that they touch"
    assert (lowest > 1e-3).float().mean() > 0.1, "those that are clear stay where they are"
