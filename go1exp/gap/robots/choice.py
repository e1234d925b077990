"""The robot of a description, or the Go1."""

from __future__ import annotations

from go1exp.gap.robots.description import ModelConfig
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.hung import hung
from go1exp.gap.robots.protocol import Robot
from go1exp.robot import RobotConfig


def robot_of(model: ModelConfig | None, config: RobotConfig, path: str = "model") -> Robot:
    """Return the robot of a description; the Go1 ``config``, hung, where there is none.

    Raises:
        ConfigError: with what its MuJoCo file lacks, naming the key.
    """
    return hung(config) if model is None else FixedBase.of(model, path)
