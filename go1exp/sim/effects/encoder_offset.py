"""``effect=encoder_offset``: the zero of the joint encoders is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_ATTITUDES, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("encoder_offset")
class EncoderOffset(Effect):
    """The encoder reads the angle plus a constant, and so do the actuator, the policy and the log: q_read = q + offset.

    Walk-these-ways randomises +-0.02 rad on a Go1; calibration by hand against the hard stops is good to some 10 mrad.
    In one pose a tilted trunk, a shifted centre of mass or a constant torque of kp offset look the same.
    """

    title = "a zero error of the encoders"
    params = (Param("offset", "rad", -0.15, 0.15, 0.0, 0.003, "joint", "reading at true zero"),)
    identification = Identification(
        nominal=True,
        rank=8,
        uniform=True,
        excitation="slow_ramps",
        confounded=("base_tilt", "link_com"),
        separated_by=TWO_ATTITUDES,
        # Sealed walks: hips of 85 % were named as certified offsets of the calves (docs/notebook/gap_walks.md).
        standing_caveat="Actuators that are weak at one kind of joints can look like this encoder_offset on a standing "
        "robot: look at its zeros, or record it suspended, before training takes it.",
    )
    order = 10  # after the transmission: the encoder reads the motor's side
    offset: Tensor

    def on_encoder(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the reading."""
        return q + self.offset, qd
