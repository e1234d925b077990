"""The robot of a description, or the Go1."""

from __future__ import annotations

from typing import TYPE_CHECKING

import go1exp.actuator
import go1exp.effects  # noqa: F401  (registers every effect)
from go1exp.robot import RobotConfig

if TYPE_CHECKING:
    from go1exp.gap.robots.description import ModelConfig

from go1exp.gap.replay.machine import Machine
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.hung import hung


def machine_of(model: ModelConfig | None, config: RobotConfig, path: str = "model") -> Machine:
    """Return the robot of a description; the Go1 ``config``, hung, where there is none.

    Raises:
        ConfigError: with what its MuJoCo file lacks, naming the key.
    """
    return hung(config) if model is None else FixedBase.of(model, path)
