"""Torques that depend on the angle: ``effect=cogging``, ``joint_stop``, ``parallel_stiffness``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.mdp.randomizations import damping_ratio
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import LARGEST_ANGLE, LEAST_ANGLE, MEAN_ANGLE, Effect, Identification, Param, Periodic

if TYPE_CHECKING:
    from torch import Tensor


@effect("cogging")
class Cogging(Effect):
    """A torque that is periodic in the joint's angle: tau = amplitude sin(count q + phase).

    Slots that attract magnets, teeth that mesh. Amplitudes of 0.1 to 0.8 N m are likely (estimate). ``count``
    periods make one turn of the joint; its usual value of 38 is six for each turn of a rotor behind the Go1's gear
    ratio of 6.333, an assumption (not published). It conserves energy, but data that are not sorted by
    angle show it as ``coulomb``. A step must not skip a period: count times speed times step should stay below 1.
    """

    title = "cogging torque"
    params = (
        Param("amplitude", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "largest torque"),
        Param("count", "-", 1.0, 150.0, 38.0, math.inf, "joint", "periods per turn of the joint"),
        Param("phase", "rad", -math.pi, math.pi, 0.0, math.inf, "joint", "phase at angle zero"),
    )
    identification = Identification(
        # Over a radian of motion, neighbouring counts differ by half a period.
        periodic=Periodic("amplitude", "phase", "count", counts=tuple(float(count) for count in range(18, 64, 3))),
        free_shapes=("phase", "count"),
        excitation="slow_ramps",
    )

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque at this angle."""
        return self.amplitude * torch.sin(self.count * q + self.phase)


NULL = 0.02
"""MuJoCo's own time constant of a joint limit, s."""

REBOUND = math.exp(-2.0)
"""Restitution of MuJoCo's own joint limit, whose damping is critical."""


@effect("joint_stop")
class JointStop(Effect):
    """Place, softness and rebound of the hard stops, which MuJoCo has as a spring-damper beyond a joint's range.

    ``lower`` and ``upper`` shift the stops towards larger angles. ``time_constant`` is the spring's (stiffness per
    inertia 1 / time_constant^2): rubber yields where a casting does not. ``restitution`` is the share of its speed with
    which a joint comes back, by the damper alone; 0.135 is MuJoCo's. Stops of one kind of robot were seen 0.16 rad from
    each other (docs/notebook/gap_real.md); the bounds are twice that, those of ``restitution`` what a step
    of 2 ms resolves. It shows at the stops and nowhere else, where ``torque_speed_limit`` may act too; an
    ``encoder_offset`` moves a stop as well, and everything else with it. A time constant below twice the physics step
    MuJoCo raises to that.
    """

    title = "place, softness or rebound of the joint stops"
    params = (
        Param("time_constant", "s", 0.004, 0.2, NULL, 0.003, "joint", "of the stop's spring"),
        Param("restitution", "-", 0.02, 0.7, REBOUND, 0.1, "joint", "speed after over speed before"),
        Param("lower", "rad", -0.3, 0.3, 0.0, 0.02, "joint", "shift of the stop at the least angle"),
        Param("upper", "rad", -0.3, 0.3, 0.0, 0.02, "joint", "shift of the stop at the largest angle"),
    )
    identification = Identification(
        levels=(
            *({"time_constant": -0.014}, {"time_constant": 0.03}, {"restitution": 0.3}),
            *({name: shift} for name in ("lower", "upper") for shift in (-0.1, -0.04, 0.04, 0.1)),
        ),
        excitation="steps",
        confounded=("encoder_offset",),
        separated_by="record steps that reach the stops, and slow_ramps that do not",
    )
    fields = ("jnt_solref", "jnt_range")

    def edit_model(self, model: ModelFields) -> None:
        """Set them; the driven joints are the model's last. No stop passes the middle of the range."""
        joints = slice(-self.time_constant.shape[1], None)
        solref, ends = model.field("jnt_solref")[:, joints], model.field("jnt_range")[:, joints]
        ratio = torch.where(self.restitution != REBOUND, damping_ratio(self.restitution).to(solref), solref[..., 1])
        time = torch.where(self.time_constant != NULL, self.time_constant, solref[..., 0])
        solref[..., 0], solref[..., 1] = time / ratio, ratio  # the spring's 1 / (time ratio) stays
        low, high = ends[..., 0].clone(), ends[..., 1].clone()
        middle = 0.5 * (low + high)
        ends[..., 0] = torch.where(self.lower != 0.0, torch.minimum(low + self.lower, middle), low)
        ends[..., 1] = torch.where(self.upper != 0.0, torch.maximum(high + self.upper, middle), high)


@effect("parallel_stiffness")
class ParallelStiffness(Effect):
    """A spring between the links beside the actuator: tau = -stiffness (q - rest).

    Cables and covers: 0.5 to 5 N m/rad (estimate). It acts on the joint, so the actuator neither limits nor reports it;
    ``rest`` is the true angle without its torque. It resembles ``kp_scale`` and, within a small range of angles,
    gravity.
    """

    title = "a spring beside the actuator"
    params = (
        Param("stiffness", "N m/rad", 0.0, 20.0, 0.0, 0.1, "joint", "torque per angle"),
        Param("rest", "rad", -5.0, 5.0, 0.0, math.inf, "joint", "angle without torque"),
    )
    identification = Identification(
        shapes=tuple({"rest": angle} for angle in (MEAN_ANGLE, LEAST_ANGLE, LARGEST_ANGLE)),
        free_shapes=("rest",),
        excitation="slow_ramps",
    )

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the spring's torque."""
        return -self.stiffness * (q - self.rest)
