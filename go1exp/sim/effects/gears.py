"""Friction of a joint, and gears that yield: ``effect=flexibility`` and ``effect=backlash``, in series.

The rotor (inertia J, reflected to the joint) turns by a twist x beyond the joint. With the gears' compliance s, their
play b and a structural damping time t, the torque F that reaches the joint obeys::

    J (x'' + q'') = torque - F          s F = e + t e'          e = x - clamp(x, -b/2, b/2)

The actuator's encoder reads the rotor: q + x. Both effects together are one spring and one dead zone in series.

Numerics. The joint's own motion is the engine's, in leapfrog: it kicks the joint once a step by F. A stiff spring would
make that unstable, and a rigid gear (s = 0) has no spring at all. So F is taken at the instant of the kick by the
trapezoidal rule (Newmark, 1959), in which the twist's acceleration appears; solving for F leaves::

    F = (J e + beta torque) / (J s + beta) - A q''         A = J beta / (J s + beta)         beta ~ dt^2 / 4

The second part is an inertia that moves with the joint, and the engine gets it as such: exact for a soft spring, where
A vanishes, and for a rigid gear, where all of the rotor moves with the joint; stable for every s; second order in the
step. An oscillation that the step cannot resolve is damped out: towards s = 0 the rule becomes one that reaches the
end of the play within the step and stays there.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import torch

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup, ModelFields
from go1exp.sim.effects.base import TWO_KD, Effect, Gears, Identification, Param

if TYPE_CHECKING:
    from torch import Tensor


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

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque against the motion."""
        return -self.damping * qd


LIGHTEST = 1e-5
"""A rotor counts for at least this, kg m2; the Go1's have 0.004 and more."""


@effect("backlash")
class Backlash(Effect):
    """The joint is free within a gap of the gears: no torque passes while |rotor angle - joint angle| < gap / 2.

    Flanks meet without bouncing; the actuator reads the rotor. The law is that of ``sim/effects/gears.py``, where
    ``flexibility`` is in series. 5 to 40 mrad are likely (estimate). It shows at reversals and as a small cycle at
    rest; within the gap the joint has lost its rotor, which ``armature`` mimics in part.
    """

    title = "play in the gears"
    params = (Param("gap", "rad", 0.0, 0.1, 0.0, 0.001, "joint", "free angle from flank to flank"),)
    identification = Identification(levels=({"gap": 0.002}, {"gap": 0.015}), excitation="slow_ramps")

    def on_gears(self, gears: Gears) -> Gears:
        """Add the gap."""
        return dataclasses.replace(gears, gap=gears.gap + self.gap)


@effect("flexibility")
class Flexibility(Effect):
    """The gears twist under load: rotor angle - joint angle = compliance torque, and the actuator reads the rotor.

    Rotor and joint swing against each other at sqrt((1 / J_rotor + 1 / J_joint) / compliance); the law is that of
    ``sim/effects/gears.py``. Stiffnesses of 60 to 400 N m/rad are likely at robots of this size (estimate). Dry
    friction stays at the joint. To a slow actuator it looks like a smaller kp, below the resonance like ``lag`` or
    ``armature``. An actuator with kd > J_rotor / physics step (2.2 N m s/rad for a hip at 2 ms)
    shakes the rotor.
    """

    title = "compliance of the gears"
    params = (
        Param("compliance", "rad/(N m)", 0.0, 0.02, 0.0, 5e-4, "joint", "twist per torque"),
        Param("damping", "-", 0.02, 1.0, 0.05, math.inf, "joint", "damping ratio of the rotor on this spring"),
    )
    identification = Identification(levels=({"compliance": 0.001}, {"compliance": 0.004}))

    def on_gears(self, gears: Gears) -> Gears:
        """Add the compliance."""
        return dataclasses.replace(gears, compliance=gears.compliance + self.compliance, damping=self.damping)


class TwoMass(Memory):
    """The rotors of N robots behind their gears.

    Attributes:
        twist: (N, J) angle of the rotor beyond the joint, rad.
        rate: (N, J) its speed half a step earlier, rad/s.
    """

    memory = ("twist", "rate", "_earlier", "_pull", "_share")

    def __init__(self, setup: ActuatorSetup) -> None:
        """Begin untwisted."""
        self._dt = setup.physics_dt
        self.twist, self.rate, self._earlier = setup.zeros(), setup.zeros(), setup.zeros()
        self._pull, self._share = setup.zeros(), setup.zeros()

    def reset(self, mask: Tensor) -> None:
        """Untwist the rows of ``mask`` (N,)."""
        for name in self.memory:
            getattr(self, name).masked_fill_(mask.unsqueeze(1), 0.0)

    def motor(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return angle and speed of the rotors, given those of the joints, all (N, J) at this instant."""
        return q + self.twist, qd + torch.lerp(self._earlier, self.rate, 1.5)

    def transmit(self, gears: Gears, torque: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the engine needs for this step.

        Args:
            gears: how the gears yield.
            torque: (N, J) on the rotors, N m.
            inertia: (N, J) of the rotors, kg m2.

        Returns:
            ``rigid``: (N, J) bool, gears that do not yield, and whose rotor is the engine's.
            ``through``: (N, J) torque on the joint, N m.
            ``carried``: (N, J) inertia that moves with the joint, kg m2.
        """
        dt, s = self._dt, gears.compliance
        rotor = inertia.clamp(min=LIGHTEST)
        unresolved = dt**4 / (dt**4 + 16.0 * (rotor * s) ** 2)  # 0: well resolved by the step, 1: rigid
        damping = 2.0 * gears.damping * torch.sqrt(s * rotor) + unresolved * dt
        beta = 0.25 * (1.0 + unresolved) * dt**2 + 0.5 * damping * dt

        ahead = self.twist + damping * self.rate
        # Where the rotor alone would go. What the joint will do is not known: one that has just been hit did
        # something else in the step before.
        loose = ahead + beta * torque / rotor
        half = 0.5 * gears.gap
        end = torch.minimum(torch.maximum(loose, -half), half)
        pressed = (loose != end) | (gears.gap == 0.0)
        stretch, divisor = ahead - end, rotor * s + beta

        rigid = (s == 0.0) & (gears.gap == 0.0)
        through = torch.where(pressed, (rotor * stretch + beta * torque) / divisor, 0.0)
        carried = torch.where(pressed, rotor * beta / divisor, 0.0)
        self._pull.copy_(
            torch.where(pressed, (s * torque - stretch) / divisor, torque / rotor).masked_fill_(rigid, 0.0)
        )
        self._share.copy_(torch.where(pressed, rotor * s / divisor, 1.0).masked_fill_(rigid, 0.0))
        return rigid, torch.where(rigid, torque, through), torch.where(rigid, inertia, carried)

    def follow(self, acceleration: Tensor) -> None:
        """Turn the rotors, given the joints' ``acceleration`` (N, J) in the step that has been made, rad/s2."""
        self._earlier.copy_(self.rate)
        self.rate += self._dt * (self._pull - self._share * acceleration)
        self.twist += self._dt * self.rate
