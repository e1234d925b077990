"""The robot of a description, or the Go1."""

from __future__ import annotations

import go1exp.actuator
import go1exp.effects  # noqa: F401  (registers every effect)
from go1exp.effects.tolerances import Tolerances
from go1exp.gap.replay.machine import Machine
from go1exp.gap.robots.description import Go1Model, ModelConfig
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.hung import hung
from go1exp.robot import RobotConfig


def machine_of(model: ModelConfig | Go1Model, config: RobotConfig, path: str = "model") -> Machine:
    """Return the robot of a description; the Go1 is ``config``, hung.

    Raises:
        ConfigError: with what its MuJoCo file lacks, naming the key.
    """
    if isinstance(model, Go1Model):
        return hung(config, Tolerances.of(model.tolerances))
    return FixedBase.of(model, path)
