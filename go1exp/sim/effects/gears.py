"""Gears that yield: ``effect=flexibility`` and ``effect=backlash``, in series.

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

import torch
from torch import Tensor

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Effect, Gears, Param
from go1exp.sim.effects.identification import Identification

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
    gap: Tensor

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
    compliance: Tensor
    damping: Tensor

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
