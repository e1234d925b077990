"""A picture without any graphics library: the robot as a stick figure, seen from the side."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import torch

from go1exp import robot
from go1exp.base.files import replacing
from go1exp.sim.env.core import Go1Core
from go1exp.train.policy import Policy


def poses_of(core: Go1Core, policy: Policy, seconds: float, count: int = 8) -> list[np.ndarray]:
    """Run the policy in environment 0 and return ``count`` poses: world x, z of each leg's joints, (4, 4, 2), m.

    The four points of a leg are hip, thigh joint, knee and foot.
    """
    data = mujoco.MjData(core.backend.model)
    steps = round(seconds / core.task.sim.policy_dt)
    wanted = set(np.linspace(steps // 2, steps - 1, count).astype(int).tolist())
    poses = []
    observation = core.reset()
    for step in range(steps):
        observation = core.step(policy(observation)).observation
        if step in wanted:
            data.qpos[:] = core.backend.qpos[0].numpy()
            mujoco.mj_kinematics(core.backend.model, data)
            legs = [
                [*(data.body(f"{leg}_{part}").xpos for part in robot.JOINT_KINDS), data.site(f"{leg}_foot").xpos]
                for leg in robot.LEGS
            ]
            poses.append(np.array(legs)[..., [0, 2]])
    return poses


def write_png(path: Path, poses: list[np.ndarray]) -> None:
    """Draw poses side by side, right legs dark and left legs light."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.0 * len(poses), 2.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, pose in zip(np.atleast_1d(figure.subplots(1, len(poses), sharey=True)), poses, strict=True):
        centre = pose[:, 0, 0].mean()
        for leg, colour in ((1, "#9db8d2"), (3, "#9db8d2"), (0, "#1f4e79"), (2, "#1f4e79")):
            axes.plot(pose[leg, :, 0] - centre, pose[leg, :, 1], "-o", color=colour, ms=3, lw=2)
        axes.plot(pose[[0, 2], 0, 0] - centre, pose[[0, 2], 0, 1], color="#222222", lw=5)
        axes.axhline(0.0, color="#888888", lw=1)
        axes.set(xlim=(-0.45, 0.45), ylim=(-0.05, 0.5), aspect="equal", title=f"x = {centre:.2f} m")
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, keep_suffix=True) as partial:
        figure.savefig(partial, dpi=100)


def picture(core: Go1Core, policy: Policy, seconds: float, path: Path) -> None:
    """Run a policy and draw its poses."""
    with torch.no_grad():
        write_png(path, poses_of(core, policy, seconds))
