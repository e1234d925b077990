"""Friction of a joint: ``effect=coulomb``, ``viscous`` and further laws that add to its bound or to its torque."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_KD, Identification


@effect("asymmetric_friction")
class AsymmetricFriction(Effect):
    """Further dry friction, ``forward`` while the angle grows and ``backward`` while it falls.

    tau = -forward at qd > 0, +backward at qd < 0, and anything between the two to hold a joint at rest. That is,
    exactly and at rest too, a symmetric bound and a constant torque::

        tau = -(forward + backward) / 2 sign(qd) + (backward - forward) / 2

    The bound goes to the joint's dry friction, the constant acts on the joint; neither half alone is friction, together
    they only brake. So data cannot tell this effect from ``coulomb`` with a constant torque, such as that of an
    ``encoder_offset`` in one pose. Differences of up to 0.6 N m are likely (estimate).
    """

    title = "dry friction that depends on direction"
    params = (
        Param("forward", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction while the angle grows"),
        Param("backward", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction while the angle falls"),
    )
    identification = Identification(
        simpler="coulomb", simpler_if_equal=("forward", "backward"), excitation="slow_ramps"
    )
    forward: Tensor
    backward: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the constant half of the difference."""
        return 0.5 * (self.backward - self.forward)

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound with the mean of both directions."""
        return bound + 0.5 * (self.forward + self.backward)


@effect("coulomb")
class Coulomb(Effect):
    """Dry friction of a joint: up to ``bound`` against the motion, and as much as needed to hold a joint at rest.

    tau = -bound sign(qd). Coulomb (1785); MuJoCo's ``frictionloss``, a constraint that is solved with the motion, so
    that a joint sticks without creeping or chattering. Published Go1 models have 0.2 to 1.0 N m. Slow motion in one
    direction cannot tell it from ``viscous``, a constant load not from ``load_friction``. New values count from
    ``Plant.refresh`` on.
    """

    title = "dry friction"
    params = (Param("bound", "N m", 0.0, 3.0, 0.0, 0.05, "joint", "friction torque"),)
    identification = Identification(nominal=True, rank=4, excitation="slow_ramps")
    fields = ("dof_frictionloss",)
    bound: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Raise the friction bound of the joints."""
        model.field("dof_frictionloss")[:, -self.bound.shape[1] :] += self.bound


@effect("load_friction")
class LoadFriction(Effect):
    """Dry friction that grows with the load of the gears: bound + coefficient |actuator torque - external * outside|.

    The actuator's torque is what the motor makes, as the actuator reports it, before the transmission; ``outside`` is
    the torque of the links' weight, Coriolis and centrifugal forces. ``external`` says how much of that counts. At 1
    this is the law of Duclusaud et al. (BAM, arXiv 2410.08650), model M3: a weight that turns a joint whose actuator is
    off rubs too, and one that is held counts twice. At other values it is the directional law of their M5, without its
    Stribeck part, with coefficients of the motor ``coefficient`` and of the load ``coefficient * external``. At 0 the
    load is the actuator's torque alone, and a joint that is pushed while its actuator is off has no such friction.

    BAM's files have 0.02 to 0.26 for servos at 1; at 0 a held weight takes twice that for the same friction. The forces
    on the feet of a robot that stands are not in ``outside``, so that its gears rub too little at 1. At a constant load
    this is ``coulomb``; in slow motion it resembles ``strength`` and ``kp_scale``. Identification tries 0 and 1.
    """

    title = "friction that grows with load"
    params = (
        Param("coefficient", "-", 0.0, 0.5, 0.0, 0.01, "joint", "friction per torque of the gears' load"),
        Param("external", "-", 0.0, 2.0, 0.0, math.inf, "joint", "share of the load from outside that counts"),
    )
    identification = Identification(
        laws=({"external": 0.0}, {"external": 1.0}),
        simpler="coulomb",
        excitation="slow_ramps",
        confounded=("coulomb",),
        separated_by="record slow_ramps through poses of different load, and torque_off",
    )
    coefficient: Tensor
    external: Tensor

    def on_load(self, bound: Tensor, torque: Tensor, outside: Tensor) -> Tensor:
        """Return the bound with the share of the load."""
        return bound + self.coefficient * (torque - self.external * outside).abs()


@effect("quadratic_drag")
class QuadraticDrag(Effect):
    """Friction in proportion to the square of the joint's speed: tau = -drag qd |qd|.

    Churned grease and air. Ranges of 0 to 0.05 N m s2/rad2 are likely (estimate); at 10 rad/s the tolerance is 0.2 N
    m. Only fast motion shows it; there it resembles ``viscous`` and a torque that falls with speed
    (``torque_speed_limit``).
    """

    title = "drag that grows with the square of speed"
    params = (Param("drag", "N m s2/rad2", 0.0, 0.05, 0.0, 0.002, "joint", "torque per speed squared"),)
    drag: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque against the motion."""
        return -self.drag * qd * qd.abs()


@effect("stribeck")
class Stribeck(Effect):
    """Dry friction that fades with speed: bound = bound + strength exp(-(|qd| / speed)^exponent).

    Stribeck (1902): a lubricant layer carries a joint that moves. A joint breaks away with a jerk. It comes
    on top of ``coulomb``, from which slow and fast motion together tell it. Friction models of servos have speeds of
    0.1 to 1 rad/s and exponents of 1 upwards (BAM, ICRA 2025); LuGre's exponent is 2.
    """

    title = "friction that falls with speed"
    params = (
        Param("strength", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction at rest"),
        Param("speed", "rad/s", 0.01, 2.0, 0.2, math.inf, "joint", "speed at which exp(-1) of it is left"),
        Param("exponent", "-", 0.5, 4.0, 2.0, math.inf, "joint", "how suddenly it fades"),
    )
    identification = Identification(
        shapes=({"speed": 0.1}, {"speed": 0.5}), free_shapes=("speed",), simpler="coulomb", excitation="slow_ramps"
    )
    strength: Tensor
    speed: Tensor
    exponent: Tensor

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound with what is left of the further friction."""
        return bound + self.strength * torch.exp(-((qd.abs() / self.speed) ** self.exponent))


@effect("viscous")
class Viscous(Effect):
    """Friction in proportion to the joint's speed: tau = -damping qd.

    Published Go1 models have 0.01 to 0.5 N m s/rad, the larger ones in place of kd. It acts on the joint, not in the
    drive: the drive's torque limit and its report do not include it. While the drive does not saturate it is
    ``kd_scale``, unless kd is varied, the actuator switched off or its torque measured well.
    """

    title = "viscous friction"
    params = (Param("damping", "N m s/rad", 0.0, 2.0, 0.0, 0.02, "joint", "torque per speed"),)
    identification = Identification(
        nominal=True, rank=5, excitation="torque_off", confounded=("kd_scale",), separated_by=TWO_KD
    )
    damping: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque against the motion."""
        return -self.damping * qd
