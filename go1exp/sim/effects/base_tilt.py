"""``effect=base_tilt``: what should be level is not."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import torch

from go1exp.base.tensors.rotation import quat_multiply, rotate, rotate_inverse
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Measured, Param
from go1exp.sim.effects.identification import TWO_ATTITUDES, Identification

if TYPE_CHECKING:
    from torch import Tensor


def _tilted(roll: Tensor, pitch: Tensor, v: Tensor) -> Tensor:
    """Express vectors (N, 3) in a frame turned by ``pitch`` about y and then, in itself, by ``roll`` about x."""
    roll, pitch = roll.squeeze(1).to(v.dtype), pitch.squeeze(1).to(v.dtype)
    x, y, z = v.unbind(-1)
    x, z = torch.cos(pitch) * x - torch.sin(pitch) * z, torch.sin(pitch) * x + torch.cos(pitch) * z
    y, z = torch.cos(roll) * y + torch.sin(roll) * z, torch.cos(roll) * z - torch.sin(roll) * y
    return torch.stack([x, y, z], dim=-1)


@effect("base_tilt")
class BaseTilt(Effect):
    """A held trunk hangs tilted, against what is believed; in one that is free the IMU sits tilted.

    Held: gravity turns in the trunk's frame, for the joints and for the IMU. Free: what the IMU says turns. Tilt: by
    ``pitch`` (nose down) and then by ``roll`` (left side up). 1 to 8 degrees are likely (estimate). A held robot's
    looks like an ``encoder_offset`` in one pose, and every leg feels the same; two orientations of the trunk tell.
    """

    title = "a tilt of the trunk"
    params = (
        Param("roll", "rad", -0.2, 0.2, 0.0, 0.0087, "robot", "left side up"),
        Param("pitch", "rad", -0.2, 0.2, 0.0, 0.0087, "robot", "nose down"),
    )
    identification = Identification(
        nominal=True,
        rank=9,
        excitation="slow_ramps",
        confounded=("encoder_offset", "link_com"),
        separated_by=TWO_ATTITUDES,
    )
    fields = ("opt.gravity",)
    roll: Tensor
    pitch: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Turn gravity about a held trunk."""
        if self.setup.floating:
            return
        (trunk,) = model.ids("body", ("trunk",))
        gravity = model.field("opt.gravity")
        held = model.nominal("body_quat")[:, trunk].to(gravity)
        turned = rotate(held, _tilted(self.roll, self.pitch, rotate_inverse(held, gravity)))
        gravity.copy_(torch.where((self.roll == 0.0) & (self.pitch == 0.0), gravity, turned))

    def on_sensor(self, measured: Measured) -> Measured:
        """Turn what the IMU says; a held one feels gravity as it is, and tells an attitude to match."""
        names = ("gravity", "gyro", "acc") if self.setup.floating else ("gravity",)
        vectors = {name: getattr(measured, name) for name in names}
        readings = {name: _tilted(self.roll, self.pitch, v) for name, v in vectors.items() if v is not None}
        if measured.quat is not None:
            readings["quat"] = self._attitude(measured.quat)
        return dataclasses.replace(measured, **readings)

    def _attitude(self, quat: Tensor) -> Tensor:
        """Return the orientation (N, 4) of a frame that is tilted in the one of orientation ``quat``."""
        roll, pitch = 0.5 * self.roll.to(quat.dtype), 0.5 * self.pitch.to(quat.dtype)
        (sr, cr), (sp, cp) = (torch.sin(roll), torch.cos(roll)), (torch.sin(pitch), torch.cos(pitch))
        turned = quat_multiply(quat, torch.cat([cp * cr, cp * sr, sp * cr, -sp * sr], dim=1))  # pitch, then roll
        return torch.where((self.roll == 0.0) & (self.pitch == 0.0), quat, turned)
