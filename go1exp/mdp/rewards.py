"""The 19 reward and penalty terms of the paper's Table III, in the reading of ``reward=paper``.

Dowdy and Chagas Vaz, "Isaac Sim-to-Real", CASE 2025, print "general expressions"; most of the names and several of the
weights are those of Isaac Lab's Spot task. A term is computed as printed unless the expression is ill-posed or plainly
abbreviates the Spot definition; then it is that definition with the paper's constants. ``rewards_literal.py`` holds
the table to the letter, and ``docs/paper.md`` compares both line by line.

Every term takes a Snapshot and returns a magnitude ``(N,)``, non-negative unless it says otherwise; the weight in the
YAML carries the sign.
The sum of weight x term is multiplied by the policy's period (0.02 s), as in Isaac Lab, so a weight is a rate per
second.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import Memory, constant_like
from go1exp.config.schema.registry import Fraction, NonNegative, Positive, reward
from go1exp.mdp.derived import (
    ASYNC_PAIRS,
    DIAGONAL_SIGNS,
    SYNC_PAIRS,
    clock_angle,
    foot_speed_xy,
    is_moving,
    joint_deviation,
    since_last_contact_began,
)
from go1exp.mdp.feet import LARGEST_PRICED_FORCE
from go1exp.mdp.types import Snapshot, TermSetup

if TYPE_CHECKING:
    from torch import Tensor


@reward("feet_air_time")
def feet_air_time(s: Snapshot, *, mode_time: Positive = 0.175, speed_threshold: NonNegative = 0.5) -> Tensor:
    """Steps of the right length: time in the running phase of each foot, s, as long as it is below ``mode_time``.

    Moving: sum_i T_i [T_i < m], T_i = max(air, contact time). Standing: sum_i clip(contact - air, -m, m).
    Swing and stance count equally, so that the best gait changes phase every ``mode_time``. Sum over feet, s;
    negative for a standing robot with its feet in the air. Printed: sum_i (t_air,i - 0.175), which rewards never
    landing; source of the form: Isaac Lab, Spot `air_time`.
    """
    phase = torch.maximum(s.foot_air_time, s.foot_contact_time)
    stepping = torch.where(phase < mode_time, phase, torch.zeros_like(phase))
    standing = (s.foot_contact_time - s.foot_air_time).clamp(-mode_time, mode_time)
    return torch.where(is_moving(s, speed_threshold).unsqueeze(-1), stepping, standing).sum(-1)


@reward("feet_air_time_touchdown")
def feet_air_time_touchdown(s: Snapshot, *, threshold: NonNegative = 0.175) -> Tensor:
    """Long swings, rewarded at touchdown: sum_i (last air time_i - threshold) [foot i touched down], s; any sign.

    The other reading of the paper's first row (Isaac Lab, `feet_air_time`); zero while no motion is commanded.
    """
    gain = ((s.foot_last_air_time - threshold) * s.foot_touchdown).sum(-1)
    return gain * (s.command[:, :2].norm(dim=-1) > 0)


@reward("linear_velocity_error")
def linear_velocity_error(s: Snapshot, *, scale: Positive = 1.0, ramp: NonNegative = 0.0) -> Tensor:
    """Tracking of the commanded planar velocity: exp(-|v*_xy - v_xy| / scale); scale in m/s. Table III.

    ``ramp``, s/m, raises the reward of fast commands: times 1 + ramp max(|v*_xy| - 1 m/s, 0), as in Isaac Lab's
    Spot task.
    """
    wanted = s.command[:, :2]
    kernel = torch.exp(-(wanted - s.base_lin_vel_b[:, :2]).norm(dim=-1) / scale)
    return kernel * (1.0 + ramp * (wanted.norm(dim=-1) - 1.0).clamp(min=0.0))


@reward("angular_velocity_error")
def angular_velocity_error(s: Snapshot, *, scale: Positive = 2.0) -> Tensor:
    """Tracking of the commanded yaw rate: exp(-|w*_z - w_z| / scale); scale in rad/s. Table III."""
    return torch.exp(-(s.command[:, 2] - s.base_ang_vel_b[:, 2]).abs() / scale)


@reward("gait")
def gait(
    s: Snapshot, *, scale: Positive = 0.1, max_error: Positive = 0.2, speed_threshold: NonNegative = 0.5
) -> Tensor:
    """Trot in absolute time, which also rewards trembling: prefer ``trot``. In (0, 1]; 0 while standing.

    sync(i, j) = exp(-(min((A_i - A_j)^2, e^2) + min((C_i - C_j)^2, e^2)) / scale) over diagonal legs, async(i, j) the
    same with A_i - C_j and C_i - A_j over the other pairs; A and C are running air and contact times, e = ``max_error``
    in s, ``scale`` in s2. Source: Table III, with the factors of Isaac Lab's Spot `GaitReward`.
    """
    air, contact = s.foot_air_time, s.foot_contact_time

    def mismatch(a: Tensor, b: Tensor) -> Tensor:
        return (a - b).square().clamp(max=max_error**2)

    error = torch.zeros_like(air[:, 0])
    for i, j in SYNC_PAIRS:
        error = error + mismatch(air[:, i], air[:, j]) + mismatch(contact[:, i], contact[:, j])
    for i, j in ASYNC_PAIRS:
        error = error + mismatch(air[:, i], contact[:, j]) + mismatch(contact[:, i], air[:, j])
    return torch.exp(-error / scale) * is_moving(s, speed_threshold)


@reward("foot_clock")
def foot_clock(s: Snapshot, *, rate: Positive = 2.5, height: Positive = 0.06, excess: Fraction = 1.0) -> Tensor:
    """Feet that follow the clock of observation ``gait_clock`` in a trot: sum of 1/4 - min(|z_i - h_i| / height, 1).

    z is the height of the sole over the ground, 0 for one that sinks in; h_i = ``height`` sin^2(p_i) where sin(p_i) > 0
    (swing), else 0; p is the clock's angle for FR and RL, half a turn later for the others. Heights in m. At most 1,
    0 on average for standing feet, so that a fall costs no more than the trot that is missed; as steep there as next to
    1; 0 while no motion is commanded. Of what a swinging foot is higher than h_i the share ``excess`` counts: less than
    1 lets feet clear steps. Not in Table III; after Siekmann et al., arXiv 2011.01387, heights for forces.
    """
    return _following(s, rate, height, excess)


@reward("foot_clock_ahead", reads=("foot_rise",))
def foot_clock_ahead(
    s: Snapshot, *, rate: Positive = 2.5, height: Positive = 0.06, excess: Fraction = 1.0, margin: NonNegative = 0.05
) -> Tensor:
    """As ``foot_clock``, with feet that clear what lies ahead: ``height`` or rise + ``margin``, whichever is more.

    The rise is that of the ground up to 0.2 m ahead of the foot, where the command leads (``RiseAhead``), m. It tells a
    foot at the bottom of a riser how much higher it must be; the robot itself sees nothing of it. Not in Table III.
    """
    assert s.foot_rise is not None
    return _following(s, rate, (s.foot_rise + margin).clamp(min=height), excess)


def _following(s: Snapshot, rate: float, height: Tensor | float, excess: float) -> Tensor:
    """Return ``foot_clock`` with a ``height`` for all feet or for each, (N, 4), m."""
    lift = torch.sin(clock_angle(s, rate)).unsqueeze(-1) * constant_like(DIAGONAL_SIGNS, s.foot_height)
    wanted = lift.clamp(min=0.0).square()
    sole = (s.foot_height - robot.FOOT_RADIUS).clamp(min=0.0) / height
    error = (sole - wanted).abs() * torch.where((wanted > 0.0) & (sole > wanted), excess, 1.0)
    following = 1.0 - error.clamp(max=1.0).sum(-1)
    return following * (s.command.norm(dim=-1) > 0)


@reward("load_clock")
def load_clock(s: Snapshot, *, rate: Positive = 2.5) -> Tensor:
    """Weight on the diagonal that the clock of ``gait_clock`` puts on the ground: sum_i F_i c_i / sum_i F_i.

    c = -sin(p), p as in ``foot_clock``; F are the forces on the feet, N. In -1 to 1, 0 for standing feet; shifting
    weight is rewarded before a foot leaves the ground. 0 while no motion is commanded. Not in Table III; after Siekmann
    et al., arXiv 2011.01387.
    """
    stance = -torch.sin(clock_angle(s, rate)).unsqueeze(-1) * constant_like(DIAGONAL_SIGNS, s.foot_force)
    share = s.foot_force / s.foot_force.sum(-1, keepdim=True).clamp(min=1.0)
    return (share * stance).sum(-1) * (s.command.norm(dim=-1) > 0)


@reward("diagonal_load")
def diagonal_load(s: Snapshot) -> Tensor:
    """Reward weight on one diagonal at a time: |F_FR + F_RL - F_FL - F_RR| / sum_i F_i, in [0, 1].

    F are the forces on the feet, N. 0 for standing feet, 1 in the stance phases of a trot; 0 while no motion is
    commanded. Shifting weight is rewarded before a foot leaves the ground, where ``trot`` is flat. Not in Table III.
    """
    sign = constant_like(DIAGONAL_SIGNS, s.foot_force)
    share = (s.foot_force * sign).sum(-1).abs() / s.foot_force.sum(-1).clamp(min=1.0)
    return share * (s.command.norm(dim=-1) > 0)


@reward("foot_clearance")
def foot_clearance(
    s: Snapshot, *, target_height: Positive = 0.08, scale: Positive = 0.005, speed_scale: Positive = 2.0
) -> Tensor:
    """Moving feet at the right height: exp(-sum_i (z_i - h)^2 tanh(k u_i) / scale), in (0, 1].

    z is the height of the foot's centre over the ground, u its horizontal speed; h in m, ``scale`` in m2,
    ``speed_scale`` k in s/m. Printed without magnitude or speed: exp(-sum (z_i - 0.08)); form of Isaac Lab's Spot task.
    """
    error = (s.foot_height - target_height).square() * torch.tanh(speed_scale * foot_speed_xy(s))
    return torch.exp(-error.sum(-1) / scale)


@reward("action_smoothness")
def action_smoothness(s: Snapshot) -> Tensor:
    """Change of the policy's output, |a_t - a_t-1|, unscaled actions. Table III."""
    return (s.action - s.previous_action).norm(dim=-1)


@reward("action_rate")
def action_rate(s: Snapshot, *, free: NonNegative = 0.0) -> Tensor:
    """Actions that jump: sum_j max(|a_t - a_t-1|_j - free, 0)^2 of unscaled actions; with 0 that of legged_gym."""
    return ((s.action - s.previous_action).abs() - free).clamp(min=0.0).square().sum(-1)


@reward("air_time_variance")
def air_time_variance(s: Snapshot, *, max_time: Positive = 0.5) -> Tensor:
    """Unequal legs: variance over feet of the last swing time plus that of the last stance time, s2.

    Times are cut at ``max_time``. Printed as a double sum of signed differences, which is zero for any gait; Spot form.
    """
    air, contact = s.foot_last_air_time.clamp(max=max_time), s.foot_last_contact_time.clamp(max=max_time)
    return air.var(dim=-1) + contact.var(dim=-1)


@reward("base_motion")
def base_motion(s: Snapshot, *, heave_weight: Fraction = 0.8) -> Tensor:
    """Heaving, rolling and pitching: h v_z^2 + (1 - h) (|w_x| + |w_y|), h = ``heave_weight``.

    Printed as |w_x + w_y|, which a roll and an equal pitch cancel; form of Isaac Lab's Spot task.
    """
    tilt_rate = s.base_ang_vel_b[:, :2].abs().sum(-1)
    return heave_weight * s.base_lin_vel_b[:, 2].square() + (1.0 - heave_weight) * tilt_rate


@reward("base_orientation")
def base_orientation(s: Snapshot) -> Tensor:
    """Tilt, |g_xy| = sin(angle between trunk and vertical). Table III."""
    return s.projected_gravity_b[:, :2].norm(dim=-1)


@reward("foot_slip")
def foot_slip(s: Snapshot) -> Tensor:
    """Sliding of feet that bear force: sum_i [contact_i] u_i, horizontal speed, m/s.

    Printed as the norm over the feet; the sum is the Spot form.
    """
    return (foot_speed_xy(s) * s.foot_contact).sum(-1)


@reward("foot_force")
def foot_force(s: Snapshot) -> Tensor:
    """Forces on the feet in the last physics step: sum_i |F_i|^2, N2. Table III; ``foot_peak_force`` sees all.

    A force counts for ``LARGEST_PRICED_FORCE`` at most.
    """
    return s.foot_force.clamp(max=LARGEST_PRICED_FORCE).square().sum(-1)


@reward("foot_peak_force")
def foot_peak_force(s: Snapshot) -> Tensor:
    """Hard footfalls: sum_i |F_i|^2, N2, of each foot's largest force in the policy step. Table III.

    A footfall's peak lasts a few milliseconds; the last physics step shows one in several. A force counts for
    ``LARGEST_PRICED_FORCE`` at most.
    """
    return s.foot_peak_force.clamp(max=LARGEST_PRICED_FORCE).square().sum(-1)


@reward("touchdown_speed")
def touchdown_speed(s: Snapshot, *, free: NonNegative = 0.0) -> Tensor:
    """Feet that land fast: sum_i max(w_i - free, 0)^2 [foot i touched down], m2/s2, w the downward speed in m/s.

    Counted in the step of the touchdown: weight x policy period for each. Not in Table III.
    """
    return ((s.foot_touchdown_speed - free).clamp(min=0.0).square() * s.foot_touchdown).sum(-1)


@reward("joint_torque")
def joint_torque(s: Snapshot) -> Tensor:
    """Effort, |tau|, N m. Table III."""
    return s.joint_torque.norm(dim=-1)


@reward("joint_acceleration")
def joint_acceleration(s: Snapshot) -> Tensor:
    """Jerkiness, |qdd| over the last physics substep, rad/s2. Table III."""
    return s.joint_acc.norm(dim=-1)


@reward("joint_velocity")
def joint_velocity(s: Snapshot) -> Tensor:
    """Fast joints, |qd|, rad/s. Table III."""
    return s.joint_vel.norm(dim=-1)


@reward("joint_deviation")
def joint_deviation_(s: Snapshot, *, standing_scale: NonNegative = 5.0, speed_threshold: NonNegative = 0.5) -> Tensor:
    """Distance from the nominal stance, |q - q0|, rad; times ``standing_scale`` while standing.

    Printed as a sum of signed differences, which left and right cancel; form of Isaac Lab's Spot task.
    """
    distance = joint_deviation(s).norm(dim=-1)
    return torch.where(is_moving(s, speed_threshold), distance, standing_scale * distance)


@reward("joint_position_limit", fixed=("soft_factor",))
def joint_position_limit(s: Snapshot, *, soft_factor: Fraction = 0.95) -> Tensor:
    """Joints at a limit: number of joints outside the range shrunk by ``soft_factor`` about its centre, 0 to 12.

    Printed for the upper limit alone; both ends count here.
    """
    low, high = (constant_like(tuple(bound), s.joint_pos) for bound in robot.soft_limits(soft_factor).T.tolist())
    outside = (s.joint_pos <= low) | (s.joint_pos >= high)
    return outside.sum(-1).to(s.joint_pos.dtype)


@reward("joint_velocity_limit")
def joint_velocity_limit(s: Snapshot, *, limit: tuple[Positive, Positive, Positive] = robot.VELOCITY_LIMIT) -> Tensor:
    """Joints at top speed: number of joints with |qd| >= limit (hip, thigh, calf, rad/s), 0 to 12.

    Printed for positive speed alone; both directions count here.
    """
    top = constant_like(tuple(robot.per_joint(limit).tolist()), s.joint_vel)
    return (s.joint_vel.abs() >= top).sum(-1).to(s.joint_vel.dtype)


@reward("thigh_contact")
def thigh_contact(s: Snapshot) -> Tensor:
    """Thighs that touch the ground, 0 to 4. Table III."""
    return s.thigh_contact.sum(-1).to(s.joint_pos.dtype)


@reward("calf_contact")
def calf_contact(s: Snapshot) -> Tensor:
    """Calves that touch the ground, 0 to 4; the foot does not count. Table III."""
    return s.calf_contact.sum(-1).to(s.joint_pos.dtype)


@reward("trunk_contact")
def trunk_contact(s: Snapshot) -> Tensor:
    """Trunk, head or a hip touched the ground, 0 or 1. Not in Table III.

    Where this ends the episode (``termination=fall``) it is the penalty of a fall, once: weight x policy period.
    """
    return s.trunk_contact.to(s.joint_pos.dtype)


SHORTEST_CYCLE, LONGEST_CYCLE = 0.04, 1.0
"""Between these a foot's cycle counts as one, s: two policy steps, and a foot that was left standing."""

BOUNCE, BOUNCE_SHARE = 0.03, 0.2
"""A swing shorter than this, s, and than this share of the foot's last cycle, is a bounce (chosen): as they lift off,
simulated feet touch the ground again for some milliseconds, and as they land they come off it again."""


@reward("trot")
class Trot(Memory):
    """Trot at any stride rate: product of two synchrony and four asynchrony factors of phases; 0 while standing.

    sync(i, j) = exp(-(1 - cos(p_i - p_j)) / scale) over diagonal legs, async(i, j) = exp(-(1 + cos(p_i - p_j)) / scale)
    over the other pairs; p is the phase of a foot, from touchdown to touchdown. Pace, bound and pronk earn
    exp(-8 / scale). The exponent is that of four equally coupled oscillators, which have one stable state: from almost
    all phases there is a way up to the trot (``docs/paper.md``). A foot that does not touch down anew after one cycle
    loses its phase within the next, and its cosines go to zero. Cycles shorter than ``full_cycle`` s earn in proportion
    to their length, mean of the feet. In (0, 1]. Source: the product is Table III's, whose factors are not printed;
    these are von Mises distributions.
    """

    memory = ("since", "cycle", "swing")

    def __init__(
        self,
        setup: TermSetup,
        *,
        scale: Positive = 2.0,
        full_cycle: NonNegative = 0.0,
        speed_threshold: NonNegative = 0.5,
    ) -> None:
        """Start without phases; ``scale`` without unit, ``full_cycle`` in s, ``speed_threshold`` in m/s."""
        self._dt, self._scale, self._speed_threshold = setup.dt, scale, speed_threshold
        self._full_cycle = full_cycle
        self.since = setup.zeros(4)  # s since the touchdown that began the cycle
        self.cycle = setup.zeros(4)  # s, the last cycle's length
        self.swing = setup.zeros(4)  # s, longest time in the air since then
        self.reset(torch.ones(setup.num_envs, dtype=torch.bool, device=setup.device))

    def reset(self, mask: Tensor) -> None:
        """Take the phases of the rows of ``mask`` (N,) away."""
        rows = mask.unsqueeze(1)
        self.since.masked_fill_(rows, 2.0 * LONGEST_CYCLE)
        self.cycle.masked_fill_(rows, LONGEST_CYCLE)
        self.swing.masked_fill_(rows, 0.0)

    def __call__(self, s: Snapshot) -> Tensor:
        """(N,) of one policy step."""
        self._follow(s)
        phase = self.since / self.cycle
        length, angle = (2.0 - phase).clamp(0.0, 1.0), 2.0 * math.pi * phase
        x, y = length * torch.cos(angle), length * torch.sin(angle)
        error = torch.zeros_like(x[:, 0])
        for pairs, sign in ((SYNC_PAIRS, 1.0), (ASYNC_PAIRS, -1.0)):
            for i, j in pairs:
                error = error + 1.0 - sign * (x[:, i] * x[:, j] + y[:, i] * y[:, j])
        long_enough = (self.cycle.mean(-1) / self._full_cycle).clamp(max=1.0)
        return torch.exp(-error / self._scale) * long_enough * is_moving(s, self._speed_threshold)

    def _follow(self, s: Snapshot) -> None:
        """Let one policy step pass for the phases."""
        self.since += self._dt
        torch.maximum(self.swing, torch.where(s.foot_touchdown, s.foot_last_air_time, s.foot_air_time), out=self.swing)
        lost = self.since > 2.0 * self.cycle
        landed = s.foot_touchdown & ((self.swing >= (BOUNCE_SHARE * self.cycle).clamp(max=BOUNCE)) | lost)
        overdue = torch.minimum(since_last_contact_began(s), torch.full_like(self.since, self._dt))
        length = self.since - overdue
        # A first step is the beginning of no cycle: any second one ends the shortest.
        cycle = torch.where(length > LONGEST_CYCLE, torch.zeros_like(length), length).clamp(min=SHORTEST_CYCLE)
        self.cycle.copy_(torch.where(landed, cycle, self.cycle))
        self.since.copy_(torch.where(landed, overdue, self.since))
        self.swing.copy_(torch.where(landed, s.foot_air_time, self.swing))
