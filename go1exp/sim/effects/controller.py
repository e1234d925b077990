"""Gains, encoders, arithmetic and delays of the controller: ``effect=kp_scale``, ``command_delay`` and others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from go1exp.base.tensors.memory import CommandLine
from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.go1_fields import KD_STEP, KP_STEP, TORQUE_STEP
from go1exp.sim.effects.base import SHARP_EDGES, TWO_ATTITUDES, TWO_GAIN_SETS, TWO_KD, Effect, Identification, Param

if TYPE_CHECKING:
    from torch import Tensor


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
        levels=({"steps": 2.0}, {"steps": 4.0}), excitation="torque_off", confounded=("viscous",), separated_by=TWO_KD
    )
    order = -10

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
    params = (Param("scale", "-", 0.0, 5.0, 1.0, 0.15, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True,
        rank=1,
        of_gains=True,
        excitation="torque_off",
        confounded=("viscous",),
        separated_by=TWO_KD,
    )

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
    params = (Param("scale", "-", 0.2, 5.0, 1.0, 0.1, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True,
        rank=0,
        weighs_on_legs=True,
        of_gains=True,
        uniform=True,
        confounded=("armature", "link_mass", "strength"),
        separated_by=TWO_GAIN_SETS,
    )

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains with the real kp."""
        return kp * self.scale, kd


class Delayed(Effect):
    """Base of effects with a parameter ``delay`` in s, up to that parameter's upper bound."""

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Allocate the past."""
        super().__init__(setup, **values)
        (longest,) = (p.high for p in self.params if p.name == "delay")
        self._line = CommandLine(
            setup.num_envs, len(setup.joints), longest, setup.physics_dt, setup.dtype, setup.device
        )
        self._steps = self._line.steps(self.delay)

    def prepare(self) -> None:
        """Work out how many samples ago the delays are."""
        self._steps.copy_(self._line.steps(self.delay))

    def late(self, signal: Tensor) -> Tensor:
        """Take the newest ``signal`` (N, J) and return that of ``delay`` ago; once a step."""
        return self._line.at(signal, self._steps)

    def reset(self, mask: Tensor) -> None:
        """Let the next signal stand for the whole past in the rows of ``mask`` (N,)."""
        self._line.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the values and the past."""
        return {**super().state_dict(), **self._line.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Write values and past back, in place."""
        super().load_state_dict(state)
        self._line.load_state_dict(state)


@effect("command_delay")
class CommandDelay(Delayed):
    """The actuator acts on the target of a while ago: target(t - delay); its own feedback is not delayed.

    Computer, bus and motor controller take their time: 2 to 40 ms on robots of this class (estimate). The published
    Go1 actuator net acts one policy step (20 ms) late. A log whose commands and states have clocks of their own shows a
    shift between them as a delay; in a narrow band so do ``kp_scale`` and armature.
    """

    title = "a delay of commands"
    params = (Param("delay", "s", 0.0, 0.06, 0.0, 0.001, "joint", "age of the target"),)
    identification = Identification(nominal=True, rank=10, levels=({"delay": 0.01},), excitation="steps")

    def on_feedforward(self, torque: Tensor) -> Tensor:
        """Return the feed-forward torque of ``delay`` ago: it comes with the target."""
        return self._line.fed(torque, self._steps)

    def on_target(self, target: Tensor) -> Tensor:
        """Return the target of ``delay`` ago."""
        return self.late(target)


@effect("torque_delay")
class TorqueDelay(Delayed):
    """The motor makes the torque that the actuator asked for a while ago: tau(t) = demand(t - delay).

    Feedback is late too, unlike with ``command_delay``, so that a joint rings: the delay acts like a kd that is smaller
    by kp delay. Loops that run over the bus have 1 to 8 ms (estimate). To first order the same as ``lag``; sharp
    command edges tell them apart.
    """

    title = "a delay of torque"
    params = (Param("delay", "s", 0.0, 0.02, 0.0, 0.001, "joint", "age of the torque"),)
    identification = Identification(
        nominal=True, rank=11, excitation="steps", confounded=("lag",), separated_by=SHARP_EDGES
    )
    order = 30

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque asked for ``delay`` ago."""
        return self.late(torque)


@effect("lag")
class Lag(Effect):
    """The motor's torque follows the demand as a first-order lag: time d(tau)/dt = demand - tau.

    The current loop's bandwidth: 2 to 15 ms (estimate). Solved exactly for a demand that changes linearly between
    two steps, so that no step makes it unstable and a time of zero is the demand itself. To first order the same as
    ``torque_delay``; fast chirps, which it damps and a delay does not, tell them apart. An episode begins settled.
    """

    title = "a lag of torque"
    params = (Param("time", "s", 0.0, 0.05, 0.0, 0.001, "joint", "time constant"),)
    identification = Identification(confounded=("torque_delay",), separated_by=SHARP_EDGES)
    memory = ("_made", "_asked", "_fresh")
    order = 40

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Begin settled."""
        super().__init__(setup, **values)
        self._made, self._asked = setup.zeros(), setup.zeros()
        self._fresh = torch.ones(setup.num_envs, 1, dtype=torch.bool, device=setup.device)
        self._kept, self._before, self._now = setup.zeros(), setup.zeros(), setup.zeros()
        self._absent = torch.ones_like(self._kept, dtype=torch.bool)
        self.prepare()

    def prepare(self) -> None:
        """Work out the weights of torque made, last demand and demand."""
        steps = self.setup.physics_dt / self.time  # infinite at time 0, where only the demand counts
        self._kept.copy_(torch.exp(-steps))
        mean = -torch.expm1(-steps) / steps  # of the weight with which the past counts over the step
        self._before.copy_(mean - self._kept)
        self._now.copy_(1.0 - mean)
        self._absent.copy_(self.time == 0.0)

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made, given the demand."""
        made = (self._kept * self._made).addcmul_(self._before, self._asked).addcmul_(self._now, torque)
        made = torch.where(self._fresh | self._absent, torque, made)
        self._made.copy_(made)
        self._asked.copy_(torque)
        self._fresh.zero_()
        return made

    def reset(self, mask: Tensor) -> None:
        """Begin settled at the next demand in the rows of ``mask`` (N,)."""
        self._fresh |= mask.unsqueeze(1)
