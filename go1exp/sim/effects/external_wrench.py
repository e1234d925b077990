"""``effect=external_wrench``: something pulls at the trunk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("external_wrench")
class ExternalWrench(Effect):
    """A constant force (world frame) and torque (trunk frame) on the trunk: wind, a tether, a cable.

    0 to 20 N are likely (estimate). It adds to the acceleration of the trunk and turns with neither robot nor gait.
    A held trunk shows none of it. On a level robot a vertical one looks like a ``payload``, a horizontal one like a
    ``base_tilt``.
    """

    title = "an external force or torque"
    params = (
        Param("x", "N", -50.0, 50.0, 0.0, 1.0, "robot", "force along the world's x"),
        Param("y", "N", -50.0, 50.0, 0.0, 1.0, "robot", "along y"),
        Param("z", "N", -50.0, 50.0, 0.0, 1.0, "robot", "along z, up"),
        Param("roll", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "torque about the trunk's x"),
        Param("pitch", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "about y"),
        Param("yaw", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "about z"),
    )
    identification = Identification(needs_ground=True, excitation="squat")
    x: Tensor
    y: Tensor
    z: Tensor
    roll: Tensor
    pitch: Tensor
    yaw: Tensor

    def on_base(self, wrench: Tensor) -> Tensor:
        """Add force and torque."""
        return wrench + torch.cat([self.x, self.y, self.z, self.roll, self.pitch, self.yaw], dim=1)
