"""The robot of a description, or the Go1."""

from __future__ import annotations

from go1exp.effects.tolerances import Tolerances
from go1exp.gap.robots.description import Go1Model, ModelConfig
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.hung import hung
from go1exp.gap.robots.protocol import Robot
from go1exp.robot import RobotConfig


def robot_of(model: ModelConfig | Go1Model, config: RobotConfig, path: str = "model") -> Robot:
    """Return the robot of a description; the Go1 is ``config``, hung.

    Raises:
        ConfigError: with what its MuJoCo file lacks, naming the key.
    """
    if isinstance(model, Go1Model):
        return hung(config, Tolerances.from_effects(model.tolerances))
    return FixedBase.of(model, path)
