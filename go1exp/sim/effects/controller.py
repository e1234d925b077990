"""Gains, encoders and arithmetic of the controller: ``effect=kp_scale``, ``kd_scale`` and further errors of it."""

from __future__ import annotations

import torch
from torch import Tensor

from go1exp.config.schema.registry import effect
from go1exp.robot.go1_fields import KD_STEP, KP_STEP, TORQUE_STEP
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_ATTITUDES, TWO_GAIN_SETS, TWO_KD, Identification


@effect("dead_band")
class DeadBand(Effect):
    """Within ``band`` of its target an actuator takes the angle that its encoder reads for the target.

    Servos have it so that they do not buzz at rest: Feetech's STS3215 by a register of 0 to 32 steps of its encoder
    (1.5 mrad each, so 0.05 rad, the bound), one of which it is delivered with. Beyond it the whole error counts, and
    the torque jumps by kp times the band. A joint at rest resembles one with ``coulomb`` friction or ``backlash``; the
    torque that it begins with grows with kp here, and not there.
    """

    title = "a dead band of the actuator"
    params = (Param("band", "rad", 0.0, 0.05, 0.0, 0.001, "joint", "largest error that is left alone"),)
    identification = Identification(
        levels=({"band": 0.002}, {"band": 0.005}, {"band": 0.015}, {"band": 0.03}),
        excitation="slow_ramps",
        confounded=("coulomb", "backlash"),
        separated_by=TWO_GAIN_SETS,
    )
    band: Tensor

    def on_error(self, target: Tensor, q: Tensor) -> Tensor:
        """Return the target, or the angle where that is as good."""
        return torch.where((target - q).abs() > self.band, target, torch.where(self.band > 0.0, q.to(target), target))


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


@effect("fixed_point", gains=True)
class FixedPoint(Effect):
    """Gains, feed-forward torques and reported torques are cut towards zero to whole steps, ``steps`` times a Go1's.

    A Go1's packets carry kp in steps of 1/32 N m/rad, kd of 1/16 N m s/rad, torque of 1/256 N m both ways
    (``robot/go1_fields.py``, read off the vendor's client), so that kd = 0.3 becomes 0.25 and kd = 0.5 stays. Targets
    are floats and stay as they are. The torque that acts is not cut, only what the actuator reports of it: policies
    that observe it, recordings and the replay of ``gap`` have its steps. The packets' range is never reached by a Go1.
    What moves differently are gains and torques that are fed forward, so recordings at one gain cannot tell it from
    ``kp_scale``, ``kd_scale``, ``viscous``.
    """

    title = "fixed-point numbers in commands and reported torques"
    params = (Param("steps", "-", 0.0, 8.0, 0.0, 1.0, "robot", "steps over those of a Go1's packets; 0: none"),)
    identification = Identification(
        levels=({"steps": 4.0},), excitation="torque_off", confounded=("viscous",), separated_by=TWO_KD
    )
    order = -10
    steps: Tensor

    def _cut(self, values: Tensor, step: float) -> Tensor:
        """Return values (N, J) in whole steps, towards zero; as they are where there are none."""
        size = self.steps * step
        return torch.where(size > 0.0, torch.trunc(values / size) * size, values)

    def on_feedforward(self, torque: Tensor) -> Tensor:
        """Return the torque that the packets carry."""
        return self._cut(torque, TORQUE_STEP)

    def on_report(self, torque: Tensor) -> Tensor:
        """Return the torque that the packets carry back."""
        return self._cut(torque, TORQUE_STEP)

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains that the packets carry."""
        return self._cut(kp, KP_STEP), self._cut(kd, KD_STEP)


@effect("kd_scale", gains=True)
class KdScale(Effect):
    """The actuators' velocity gain is a multiple of the configured one: kd = scale kd.

    Walk-these-ways randomises 0.5 to 1.5; +-15 to 75 % are likely (estimate). While the actuator does not saturate it
    is ``viscous``, unless kd is varied or the torque is measured well; and ``torque_delay`` takes kp delay away from
    kd. New values count from ``Plant.refresh`` on.
    """

    title = "a change of the velocity gain"
    params = (Param("scale", "-", 0.0, 3.0, 1.0, 0.15, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True, rank=1, excitation="torque_off", confounded=("viscous",), separated_by=TWO_KD
    )
    scale: Tensor

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains with the real kd."""
        return kp, kd * self.scale


@effect("kp_scale", gains=True)
class KpScale(Effect):
    """The actuators' position gain is a multiple of the configured one: kp = scale kp.

    Walk-these-ways randomises 0.8 to 1.3; +-5 to 30 % are likely (estimate). At rest it is not identifiable
    against ``strength``, in a narrow band not against ``command_delay``. New values count from ``Plant.refresh`` on.
    """

    title = "a change of the position gain"
    params = (Param("scale", "-", 0.2, 2.0, 1.0, 0.1, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True,
        rank=0,
        weighs_on_legs=True,
        uniform=True,
        confounded=("armature", "link_mass", "strength"),
        separated_by=TWO_GAIN_SETS,
    )
    scale: Tensor

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains with the real kp."""
        return kp * self.scale, kd
