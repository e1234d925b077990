"""The robot of a description, or the Go1."""

from __future__ import annotations

from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import ConfigError
from go1exp.gap.robots.description import Go1Model, ModelConfig
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.robots.protocol import Robot
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import Tolerances


def robot_of(
    model: ModelConfig | Go1Model, config: RobotConfig, path: str = "model", contact: ContactConfig | None = None
) -> Robot:
    """Return the robot of a description; the Go1 is ``config``, suspended.

    Args:
        model: the description.
        config: of the Go1.
        path: key of the description, for messages.
        contact: of a Go1's feet, if one was chosen.

    Raises:
        ConfigError: with what its MuJoCo file lacks, naming the key; or if a contact was chosen for a fixed base.
    """
    if isinstance(model, Go1Model):
        return suspended(config, Tolerances.from_effects(model.tolerances), contact)
    if contact is not None:
        raise ConfigError(
            [f"contact: is of the feet of a Go1; {path} is a robot on a fixed base, and it would do nothing"]
        )
    return FixedBase.from_config(model, path)
