"""Every reward term against numbers worked out by hand from paper Table III and Isaac Lab's Spot task."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from benchmarks.gait_scores import (
    GAITS,
    PHYSICS_DT,
    RATES,
    SCORES,
    Pattern,
    climbing,
    mean_scores,
    pattern,
    registered,
    steps,
    trembling,
    walking,
)
from go1exp import robot
from go1exp.config.schema.registry import members
from go1exp.mdp.types import Snapshot, TermSetup
from go1exp.sim.task import TaskConfig

WALK = [0.5, 0.0, 0.0]
"""A command, so that the robot counts as moving."""

FR, FL, RR, RL = range(4)
"""Columns of the feet, by the vendor's order."""


def snapshot(n: int = 1, **changes: Any) -> Snapshot:
    """N robots that have stood in the nominal stance for a second, with ``changes`` (broadcast over the robots)."""
    stance = list(robot.NOMINAL_STANCE)
    rest: dict[str, Any] = {
        "base_pos_w": [0.0, 0.0, 0.325],
        "base_quat_w": [1.0, 0.0, 0.0, 0.0],
        "base_lin_vel_b": [0.0] * 3,
        "base_ang_vel_b": [0.0] * 3,
        "projected_gravity_b": [0.0, 0.0, -1.0],
        "joint_pos": stance,
        "joint_vel": [0.0] * 12,
        "joint_acc": [0.0] * 12,
        "joint_torque": [0.0] * 12,
        "joint_target": stance,
        "action": [0.0] * 12,
        "previous_action": [0.0] * 12,
        "command": [0.0] * 3,
        "foot_height": [0.023] * 4,
        "foot_vel_w": [[0.0] * 3] * 4,
        "foot_force": [31.25] * 4,
        "foot_contact": [True] * 4,
        "foot_air_time": [0.0] * 4,
        "foot_contact_time": [1.0] * 4,
        "foot_last_air_time": [0.0] * 4,
        "foot_last_contact_time": [0.0] * 4,
        "foot_touchdown": [False] * 4,
        "foot_peak_force": [31.25] * 4,
        "foot_touchdown_speed": [0.0] * 4,
        "thigh_contact": [False] * 4,
        "calf_contact": [False] * 4,
        "trunk_contact": False,
        "episode_time": 1.0,
        "height_scan": [-0.33] * 187,
        "foot_rise": [0.0] * 4,
    }
    assert rest.keys() == {f.name for f in fields(Snapshot)}
    assert changes.keys() <= rest.keys()
    tensors = {}
    for name, value in rest.items():
        base = torch.tensor(value)
        base = base if base.dtype == torch.bool else base.float()
        new = torch.as_tensor(changes.get(name, base)).to(base.dtype)
        tensors[name] = new.expand(n, *base.shape).clone()
    return Snapshot(**tensors)


def with_joints(**angles: float) -> dict[str, Any]:
    """The nominal stance with some joints moved, rad."""
    q = list(robot.NOMINAL_STANCE)
    for joint, angle in angles.items():
        q[robot.JOINTS.index(joint)] = angle
    return {"joint_pos": q}


def feet(**values: Any) -> list[Any]:
    """Per-leg values by leg name, zero for legs that are not named."""
    empty = [0.0] * 3 if any(isinstance(v, list) for v in values.values()) else 0.0
    return [values.get(leg, empty) for leg in robot.LEGS]


def evaluate(name: str, s: Snapshot, **parameters: Any) -> torch.Tensor:
    """The term's value; a term that remembers sees its first step."""
    entry = members("reward")[name]
    setup = TermSetup(len(s.command), s.command.device, 0.02)
    return entry.target(setup, **parameters)(s) if entry.remembers else entry.target(s, **parameters)


class Case(NamedTuple):
    """A situation (changes of the snapshot), parameters off their defaults, and the term's value in it."""

    term: str
    says: str
    changes: dict[str, Any]
    expected: float
    parameters: dict[str, Any] = {}  # noqa: RUF012  (never written)


TROT_PHASE = {"foot_air_time": feet(FR=0.1, RL=0.1), "foot_contact_time": feet(FL=0.1, RR=0.1)}
PACE_PHASE = {"foot_air_time": feet(FR=0.1, RR=0.1), "foot_contact_time": feet(FL=0.1, RL=0.1)}
BOUND_PHASE = {"foot_air_time": feet(FR=0.1, FL=0.1), "foot_contact_time": feet(RR=0.1, RL=0.1)}
PRONK_PHASE = {"foot_air_time": [0.1] * 4, "foot_contact_time": [0.0] * 4}
LANDING = {"foot_touchdown_speed": [1.5, 2.0, 0.5, 9.0], "foot_touchdown": [True, False, True, False]}
STEP = {"foot_rise": feet(FR=0.15)}
QUARTER, THIRD = {"command": WALK, "episode_time": 0.1}, {"command": WALK, "episode_time": 0.3}
TURNING = {"command": [0.0, 0.0, 0.5], "episode_time": 0.1}
APART = {"foot_air_time": [0.0, 1.0, 2.0, 3.0], "foot_contact_time": [10.0, 20.0, 30.0, 40.0]}
SLIDING = {
    "foot_vel_w": feet(FR=[3.0, -4.0, 9.0], FL=[0.0, 1.0, 9.0], RR=[0.5, 0.0, -9.0]),
    "foot_contact": [True, False, True, True],
}
ON_THREE = {"foot_contact_time": [1.0, 0.0, 1.0, 1.0]}
STEPPING = {"command": WALK, "foot_air_time": feet(FR=0.1, RL=0.3), "foot_contact_time": feet(FL=0.05, RR=0.25)}
TWO_LAND = {"foot_last_air_time": [0.3, 0.1, 0.5, 0.0], "foot_touchdown": [True, True, False, False], "command": WALK}
METRE_OFF = {"command": [1.0, 0.0, 1.0], "base_lin_vel_b": [0.4, 0.8, 0.0]}
FAST_WALK = {"command": [3.0, 0.0, 0.0], "base_lin_vel_b": [3.0, 0.0, 0.0]}
TENTH_OFF = [q + 0.1 for q in robot.NOMINAL_STANCE]
DRIFTING, SLOW = (
    {"joint_pos": TENTH_OFF, "base_lin_vel_b": [0.9, 0, 0]},
    {"standing_scale": 2.0, "speed_threshold": 1.0},
)
HIGH_FEET = {"foot_vel_w": feet(FR=[20.0, 0, 0], RL=[0, 20.0, 0]), "foot_height": [0.2] * 4}
WIDE = {"target_height": 0.1, "scale": 0.1, "speed_scale": 1.0}
HEAVING = {"base_lin_vel_b": [3.0, 3.0, -0.5], "base_ang_vel_b": [1.0, -2.0, 5.0]}
OUTSIDE = with_joints(
    FR_hip=0.8199, RL_hip=-0.8199, FL_thigh=-0.5564, RR_thigh=4.3714, RR_calf=-2.7698, RL_calf=-0.9362
)
INSIDE = with_joints(FR_hip=0.8198, RL_hip=-0.8198, FL_thigh=-0.5563, RR_thigh=4.3713, RR_calf=-2.7697, RL_calf=-0.9363)
"""Of 95 % of the ranges: hip +-0.81985, thigh -0.556325..4.371325, calf -2.76975..-0.93625."""
BEYOND = with_joints(FR_hip=0.862, RL_hip=-0.864, FL_calf=-2.819)
ONE_ABOVE = with_joints(FR_hip=0.8631, FL_hip=-0.8631, RR_hip=0.8629, RL_calf=-2.82)
FAST = {"joint_vel": [30.2, 30.0, 20.1, -30.2, -30.0, -20.1, 30.05, 30.2, 20.0, 0.0, -30.2, -20.0]}
"""Above 30.1, 30.1 and 20.06 rad/s: FR hip and calf and RR thigh forwards, FL hip and calf and RL thigh backwards."""

CASES = [
    # 4 x 0.175: standing, long contact is cut at mode_time.
    Case("feet_air_time", "standing on all feet", {}, 0.7),
    # 3 x 0.175 - 0.1, and - 0.175
    Case("feet_air_time", "standing with a foot lifted for 0.1 s", {**ON_THREE, "foot_air_time": feet(FL=0.1)}, 0.425),
    Case("feet_air_time", "standing with a foot lifted for long", {**ON_THREE, "foot_air_time": feet(FL=0.3)}, 0.35),
    # 0.1 + 0.05, and 0.1 + 0.3 + 0.05 + 0.25
    Case("feet_air_time", "moving: only phases shorter than mode_time pay", STEPPING, 0.15),
    Case("feet_air_time", "moving: another mode_time", STEPPING, 0.7, {"mode_time": 0.31}),
    Case("feet_air_time", "told to turn is moving", {"command": [0.0, 0.0, -0.01]}, 0.0),
    Case("feet_air_time", "drifting at 0.57 m/s is moving", {"base_lin_vel_b": [0.4, -0.4, 0.0]}, 0.0),
    Case("feet_air_time", "drifting at 0.42 m/s is standing", {"base_lin_vel_b": [0.3, -0.3, 0.0]}, 0.7),
    Case("feet_air_time", "falling is not moving", {"base_lin_vel_b": [0.0, 0.0, -2.0]}, 0.7),
    Case("feet_air_time", "another threshold", {"base_lin_vel_b": [0.3, -0.3, 0.0]}, 0.0, {"speed_threshold": 0.4}),
    # 0.125 - 0.075; the others do not land
    Case("feet_air_time_touchdown", "two feet land after 0.3 and 0.1 s", TWO_LAND, 0.05),
    Case("feet_air_time_touchdown", "another threshold", TWO_LAND, 0.2, {"threshold": 0.1}),
    Case("feet_air_time_touchdown", "nothing without a velocity", {**TWO_LAND, "command": [0.0, 0.0, 1.0]}, 0.0),
    Case("linear_velocity_error", "no error", {"command": WALK, "base_lin_vel_b": [0.5, 0.0, 0.7]}, 1.0),
    Case("linear_velocity_error", "an error of 0.6 and 0.8 m/s", METRE_OFF, 0.36787944),  # exp(-1)
    Case("linear_velocity_error", "another scale", METRE_OFF, 0.60653066, {"scale": 2.0}),  # exp(-1/2)
    # 1 + 0.5 (3 - 1)
    Case("linear_velocity_error", "a ramp pays fast commands more", FAST_WALK, 2.0, {"ramp": 0.5}),
    Case("linear_velocity_error", "and slow ones no less", {"base_lin_vel_b": [0.0] * 3}, 1.0, {"ramp": 0.5}),
    Case("angular_velocity_error", "no error", {"command": [0, 0, 0.7], "base_ang_vel_b": [3.0, 3.0, 0.7]}, 1.0),
    # exp(-2/2)
    Case(
        "angular_velocity_error", "wrong by 2 rad/s", {"command": [0, 0, 1], "base_ang_vel_b": [0, 0, -1]}, 0.36787944
    ),
    Case("gait", "a perfect trot", {"command": WALK, **TROT_PHASE}, 1.0),
    # Pace, bound and pronk: eight of the twelve squared differences are 0.1^2; exp(-0.08 / 0.1).
    Case("gait", "a pace", {"command": WALK, **PACE_PHASE}, 0.44932896),
    Case("gait", "a bound", {"command": WALK, **BOUND_PHASE}, 0.44932896),
    Case("gait", "a pronk", {"command": WALK, **PRONK_PHASE}, 0.44932896),
    Case("gait", "a pace on another scale", {"command": WALK, **PACE_PHASE}, 0.67032005, {"scale": 0.2}),
    # Eight differences of 0.05^2, by the cut; exp(-0.02 / 0.1).
    Case("gait", "a pace with errors cut at 0.05 s", {"command": WALK, **PACE_PHASE}, 0.81873075, {"max_error": 0.05}),
    # Standing under a command: each of eight differences is cut at 0.2^2; exp(-0.32 / 0.1).
    Case("gait", "standing when told to walk", {"command": WALK}, 0.04076220),
    Case("gait", "all twelve differences at their cut", {"command": WALK, **APART}, 0.00822975),  # exp(-4.8)
    Case("gait", "a trot without a command", TROT_PHASE, 0.0),
    Case("gait", "a trot that drifts fast without a command", {**TROT_PHASE, "base_lin_vel_b": [0, 0.51, 0]}, 1.0),
    # Six pairs without a phase; exp(-6 / 2). More below, since the term remembers.
    Case("trot", "the first step of a robot that is told to walk", {"command": WALK}, 0.04978707),
    Case("trot", "the same on another scale", {"command": WALK}, 0.36787944, {"scale": 6.0}),
    Case("trot", "no cycle is longer than the longest", {"command": WALK}, 0.04978707 / 2, {"full_cycle": 2.0}),
    Case("trot", "standing", {}, 0.0),
    Case("trot", "drifting without a command", {"base_lin_vel_b": [0, 0.3, 0]}, 0.04978707, {"speed_threshold": 0.2}),
    # A quarter turn of a clock of 2.5 Hz: FR and RL should be 0.06 m up.
    Case("foot_clock", "feet that follow", {**QUARTER, "foot_height": [0.083, 0.02, 0.023, 0.083]}, 1.0),
    Case("foot_clock", "the other diagonal", {**QUARTER, "foot_height": [0.023, 0.083, 0.083, 0.023]}, -3.0),
    Case("foot_clock", "standing feet, at worst", QUARTER, -1.0),
    Case("foot_clock", "two half as high, one too high", {**QUARTER, "foot_height": [0.053, 0.9, 0.023, 0.053]}, -1.0),
    Case("foot_clock", "an eighth: half of the height", {**QUARTER, "episode_time": 0.05}, 0.0),
    Case("foot_clock", "the other swing", {**THIRD, "foot_height": feet(FL=0.083, RR=0.083)}, 1.0),
    Case("foot_clock", "another rate", QUARTER, 0.0, {"rate": 1.25, "height": 0.1}),
    # Two feet 0.06 of 0.12 m up: each half a height off.
    Case("foot_clock", "excess", {**QUARTER, "foot_height": [0.113, 0.053, 0.023, 0.083]}, 0.375, {"excess": 0.25}),
    Case("foot_clock", "half as high", {**QUARTER, "foot_height": [0.083, 0.023, 0.023, 0.083]}, 0.0, {"height": 0.12}),
    Case("foot_clock", "told to turn", {**TURNING, "foot_height": [0.083, 0.02, 0.023, 0.083]}, 1.0),
    Case("foot_clock", "nothing without a command", {**QUARTER, "command": [0.0] * 3}, 0.0),
    # The same, FR before a step of 0.15 m: 0.2 m up.
    Case("foot_clock_ahead", "level ground", {**QUARTER, "foot_height": [0.083, 0.02, 0.023, 0.083]}, 1.0),
    Case("foot_clock_ahead", "over the step", {**QUARTER, **STEP, "foot_height": [0.223, 0.02, 0.023, 0.083]}, 1.0),
    Case("foot_clock_ahead", "too low for it", {**QUARTER, **STEP, "foot_height": [0.083, 0.02, 0.023, 0.083]}, 0.3),
    Case("foot_clock_ahead", "a low one", {**QUARTER, "foot_rise": feet(FR=0.01), "foot_height": [0.083] * 4}, -1.0),
    Case(
        "foot_clock_ahead", "less to spare", {**QUARTER, **STEP, "foot_height": [0.083] * 4}, -1.625, {"margin": 0.01}
    ),
    # A quarter turn: FL and RR should bear the weight.
    Case("load_clock", "standing feet", QUARTER, 0.0),
    Case("load_clock", "all of it", {**QUARTER, "foot_force": feet(FL=60.0, RR=70.0)}, 1.0),
    Case("load_clock", "all of it on the others", {**QUARTER, "foot_force": feet(FR=60.0, RL=70.0)}, -1.0),
    Case("load_clock", "three quarters", {**QUARTER, "foot_force": [10.0, 30.0, 30.0, 10.0]}, 0.5),
    Case("load_clock", "a fall through the air", {**QUARTER, "foot_force": [0.0] * 4}, 0.0),
    Case("load_clock", "another rate", {**QUARTER, "foot_force": feet(FL=60.0)}, math.sqrt(0.5), {"rate": 1.25}),
    Case("load_clock", "told to turn", {**TURNING, "foot_force": feet(FL=60.0, RR=70.0)}, 1.0),
    Case("load_clock", "nothing without a command", {"episode_time": 0.1, "foot_force": feet(FL=60.0)}, 0.0),
    Case("diagonal_load", "standing feet", {**QUARTER, "foot_force": [30.0] * 4}, 0.0),
    Case("diagonal_load", "one diagonal", {**QUARTER, "foot_force": feet(FL=60.0, RR=70.0)}, 1.0),
    Case("diagonal_load", "the other diagonal", {**QUARTER, "foot_force": feet(FR=60.0, RL=70.0)}, 1.0),
    Case("diagonal_load", "three quarters", {**QUARTER, "foot_force": [10.0, 30.0, 30.0, 10.0]}, 0.5),
    Case("diagonal_load", "a side, as in a pace", {**QUARTER, "foot_force": feet(FR=60.0, RR=60.0)}, 0.0),
    Case("diagonal_load", "a fall through the air", {**QUARTER, "foot_force": [0.0] * 4}, 0.0),
    Case("diagonal_load", "told to turn", {**TURNING, "foot_force": feet(FL=60.0, RR=70.0)}, 1.0),
    Case("diagonal_load", "no command", {"command": [0.0] * 3, "foot_force": feet(FL=60.0)}, 0.0),
    Case("foot_clearance", "standing", {}, 1.0),
    # exp(-0.057^2 tanh(2) / 0.005)
    Case("foot_clearance", "a foot that slides at 1 m/s", {"foot_vel_w": feet(RR=[0.6, -0.8, 0.0])}, 0.53449916),
    Case("foot_clearance", "a foot that is lifted straight up", {"foot_vel_w": feet(RR=[0.0, 0.0, 1.0])}, 1.0),
    Case("foot_clearance", "right height", {"foot_vel_w": [[2.0, 0.0, 0.0]] * 4, "foot_height": [0.08] * 4}, 1.0),
    # Two feet 0.1 m too high at full speed: exp(-2 x 0.01 / 0.1).
    Case("foot_clearance", "other parameters", HIGH_FEET, 0.81873075, WIDE),
    Case("action_smoothness", "no change", {"action": [0.7] * 12, "previous_action": [0.7] * 12}, 0.0),
    Case("action_smoothness", "all by 0.25", {"action": [0.5] * 12, "previous_action": [0.25] * 12}, 0.86602540),
    Case("action_rate", "no change", {"action": [0.7] * 12, "previous_action": [0.7] * 12}, 0.0),
    Case("action_rate", "all by 0.25", {"action": [0.5] * 12, "previous_action": [0.25] * 12}, 0.75),
    Case("action_rate", "downward, by 0.05 more than is free", {"previous_action": [0.25] * 12}, 0.03, {"free": 0.2}),
    Case(
        "action_rate", "less than is free", {"action": [0.5] * 12, "previous_action": [0.25] * 12}, 0.0, {"free": 0.3}
    ),
    # Mean 0.25, squared deviations 0.0225 + 0.0025 + 0.0025 + 0.0225, over 3.
    Case("air_time_variance", "unequal swings", {"foot_last_air_time": [0.1, 0.2, 0.3, 0.4]}, 0.05 / 3),
    Case("air_time_variance", "unequal stances", {"foot_last_contact_time": [0.4, 0.1, 0.3, 0.2]}, 0.05 / 3),
    Case("air_time_variance", "one swing cut at 0.5 s", {"foot_last_air_time": [0.1, 0.2, 0.3, 0.9]}, 0.0875 / 3),
    Case("air_time_variance", "equal legs", {"foot_last_air_time": [0.2] * 4, "foot_last_contact_time": [0.3] * 4}, 0),
    # 0.8 x 0.25 + 0.2 x (1 + 2), and 0.5 x 0.25 + 0.5 x 3
    Case("base_motion", "heaving and tilting", HEAVING, 0.8),
    Case("base_motion", "heaving and tilting, another weight", HEAVING, 1.625, {"heave_weight": 0.5}),
    Case("base_orientation", "level", {}, 0.0),
    Case("base_orientation", "rolled by 30 degrees", {"projected_gravity_b": [0.0, -0.5, -math.sqrt(0.75)]}, 0.5),
    Case("base_orientation", "on its back is level", {"projected_gravity_b": [0.0, 0.0, 1.0]}, 0.0),
    Case("foot_slip", "two sliding feet bear force", SLIDING, 5.5),
    Case("foot_force", "four forces", {"foot_force": [3.0, 4.0, 0.0, 10.0]}, 125.0),
    Case("foot_peak_force", "four forces", {"foot_peak_force": [3.0, 4.0, 0.0, 10.0]}, 125.0),
    Case("foot_peak_force", "a peak that the last substep does not show", {"foot_peak_force": feet(RR=300.0)}, 90000.0),
    # 1.5^2 + 0.5^2; the others are in the air or have stood for a while.
    Case("touchdown_speed", "two feet land", LANDING, 2.5),
    Case("touchdown_speed", "slow landings are free", LANDING, 0.81, {"free": 0.6}),
    Case("joint_torque", "2 N m everywhere", {"joint_torque": [2.0, -2.0] * 6}, math.sqrt(48)),
    Case("joint_acceleration", "3 and 4", {"joint_acc": [3.0] + [0.0] * 10 + [-4.0]}, 5.0),
    Case("joint_velocity", "5 and 12", {"joint_vel": [0.0, 5.0] + [0.0] * 9 + [-12.0]}, 13.0),
    Case("joint_deviation", "standing at the nominal stance", {}, 0.0),
    Case("joint_deviation", "moving with all joints 0.1 off", {"command": WALK, "joint_pos": TENTH_OFF}, 0.34641016),
    Case("joint_deviation", "standing with all joints 0.1 off", {"joint_pos": TENTH_OFF}, 1.73205081),
    Case("joint_deviation", "twice as much while drifting", DRIFTING, 0.69282032, SLOW),
    Case("joint_position_limit", "the nominal stance", {}, 0.0),
    Case("joint_position_limit", "six joints just outside the soft range", OUTSIDE, 6.0),
    Case("joint_position_limit", "six joints just inside the soft range", INSIDE, 0.0),
    Case("joint_position_limit", "the whole range", BEYOND, 2.0, {"soft_factor": 1.0}),
    Case("joint_velocity_limit", "six fast joints", FAST, 6.0),
    Case("joint_velocity_limit", "a lower limit for the hips", FAST, 7.0, {"limit": (30.0, 30.1, 20.06)}),
    Case("thigh_contact", "two thighs", {"thigh_contact": [True, False, True, False]}, 2.0),
    Case("thigh_contact", "calves do not count", {"calf_contact": [True] * 4, "trunk_contact": True}, 0.0),
    Case("calf_contact", "three calves", {"calf_contact": [True, True, True, False]}, 3.0),
    Case("calf_contact", "feet do not count", {"foot_contact": [True] * 4, "thigh_contact": [True] * 4}, 0.0),
    Case("trunk_contact", "the trunk", {"trunk_contact": True}, 1.0),
    Case("trunk_contact", "legs do not count", {"thigh_contact": [True] * 4, "calf_contact": [True] * 4}, 0.0),
    # Table III to the letter
    Case("feet_air_time_literal", "feet on the ground", {}, -0.7),
    Case("feet_air_time_literal", "never landing pays", {"foot_air_time": [10.0] * 4}, 39.3),
    Case("feet_air_time_literal", "another threshold", {"foot_air_time": [0.3, 0.1, 0, 0]}, 0.0, {"threshold": 0.1}),
    Case("foot_clearance_literal", "feet on the ground", {}, 1.25608533),  # exp(4 x 0.057)
    Case("foot_clearance_literal", "feet at the target", {"foot_height": [0.08] * 4}, 1.0),
    # exp(4 x 0.077)
    Case("foot_clearance_literal", "another target", {}, 1.36070099, {"target_height": 0.1}),
    Case("air_time_variance_literal", "unequal swings", {"foot_last_air_time": [0.125, 0.25, 0.5, 1.0]}, 0.0),
    Case("base_motion_literal", "roll and pitch add", {"base_ang_vel_b": [-1.0, -2.0, 7.0]}, 3.0),
    Case("base_motion_literal", "roll and opposite pitch cancel", {"base_ang_vel_b": [1.5, -1.5, 7.0]}, 0.0),
    Case("foot_slip_literal", "two sliding feet bear force", SLIDING, 5.02493781),  # sqrt(5^2 + 0.5^2)
    Case("joint_deviation_literal", "all joints 0.1 off", {"joint_pos": TENTH_OFF}, 1.2),
    Case("joint_deviation_literal", "left and right cancel", with_joints(FR_thigh=1.8, FL_thigh=-0.2), 0.0),
    Case("joint_position_limit_literal", "one of four joints beyond a stop is above it", ONE_ABOVE, 1.0),
    Case("joint_velocity_limit_literal", "three joints fast forwards", FAST, 3.0),
    Case("joint_velocity_limit_literal", "a lower limit for the hips", FAST, 4.0, {"limit": (30.0, 30.1, 20.06)}),
]


@pytest.mark.parametrize("case", CASES, ids=[f"{c.term}: {c.says}" for c in CASES])
def test_a_term_has_the_value_worked_out_by_hand(case: Case) -> None:
    value = evaluate(case.term, snapshot(**case.changes), **case.parameters)
    assert value.shape == (1,)
    assert value.item() == pytest.approx(case.expected, rel=1e-6, abs=1e-6)


def test_every_registered_term_has_a_value_worked_out_by_hand() -> None:
    assert {case.term for case in CASES} == set(members("reward"))


@pytest.mark.parametrize("reward", ["paper", "paper_literal"])
def test_the_configured_terms_are_finite_at_rest_and_penalise_nothing_but_the_literal_ones(
    make_task: Callable[..., TaskConfig], reward: str
) -> None:
    terms = make_task(f"reward={reward}").reward
    setup = TermSetup(1, torch.device("cpu"), 0.02)
    calls = {term.key: term(setup) if term.entry.remembers else term for term in terms}
    values = {key: call(snapshot()).item() for key, call in calls.items()}
    assert all(math.isfinite(v) for v in values.values())
    penalties = {t.key: values[t.key] for t in terms if t.slots["weight"] < 0 and t.key != "foot_force"}
    assert penalties == dict.fromkeys(penalties, 0.0)
    assert values["foot_force"] == pytest.approx(4 * 31.25**2)


# Claims that hold for more than one situation


def test_no_timers_take_the_gait_term_out_of_its_bounds() -> None:
    rng = np.random.default_rng(0)
    air, contact = rng.uniform(0.0, 1.0, (2, 5000, 4))
    value = evaluate("gait", snapshot(5000, command=WALK, foot_air_time=air, foot_contact_time=contact))
    assert value.min() >= math.exp(-4.8) * (1 - 1e-5)
    assert value.max() <= 1.0


def test_a_trot_of_any_phase_is_perfect_and_any_other_pairing_is_not() -> None:
    """Sweep through a stride in which legs of a pair share a phase and the pairs alternate."""
    t = torch.arange(1, 10) * 0.02
    zero = torch.zeros_like(t)
    for pair in [(FR, RL), (FR, RR), (FR, FL)]:
        air = torch.stack([t if leg in pair else zero for leg in range(4)], dim=-1)
        contact = torch.stack([zero if leg in pair else t for leg in range(4)], dim=-1)
        for a, c in [(air, contact), (contact, air)]:
            value = evaluate("gait", snapshot(9, command=WALK, foot_air_time=a, foot_contact_time=c))
            assert torch.equal(value, torch.ones(9)) if pair == (FR, RL) else (value < 1.0).all()


def together(patterns: Sequence[Pattern]) -> Pattern:
    """Rows of one batch."""
    return Pattern(*(torch.cat(part) for part in zip(*patterns, strict=True)))


TROT_SCORES = {name: SCORES[name] for name in ("gait", "trot")}


@pytest.mark.parametrize("rate", RATES)
def test_a_trot_is_paid_in_full_at_every_stride_rate_and_duty(rate: float) -> None:
    """At 25 Hz and a duty of 0.35 or 0.65 the timers' 2 ms round a phase by a twentieth of the cycle."""
    trots = together([pattern(rate, GAITS["trot"], duty) for duty in (0.35, 0.5, 0.65)])
    score = mean_scores(walking(trots), TROT_SCORES)["trot"]
    assert score[1].item() > 0.99
    assert score.min().item() > (0.98 if rate < 20 else 0.9)


@pytest.mark.parametrize("rate", RATES)
def test_no_other_gait_is_paid_at_any_stride_rate(rate: float) -> None:
    """The kernel in absolute time pays all of them at 25 Hz, the hop of three legs 0.72 at the rate that it had."""
    others = together([pattern(rate, offset) for name, offset in GAITS.items() if name != "trot"])
    scores = mean_scores(walking(others), TROT_SCORES)
    assert scores["trot"].max().item() < 0.2
    if rate == 25.0:
        assert scores["gait"].min().item() > 0.95


@pytest.mark.parametrize(
    ("name", "expected"),
    [("trot", 1.0), ("pace", math.exp(-4)), ("bound", math.exp(-4)), ("pronk", math.exp(-4)), ("walk", math.exp(-2))],
)
def test_a_gait_is_paid_by_the_closed_form(name: str, expected: float) -> None:
    """Two pairs in phase that should not be and two in opposition that should be in phase: exp(-4 x 2 / 2)."""
    makers = {"2": registered("trot"), "4": registered("trot", scale=4.0), "long": registered("trot", full_cycle=0.8)}
    score = mean_scores(walking(pattern(2.5, GAITS[name])), makers)
    assert score["2"].item() == pytest.approx(expected, rel=2e-3)
    assert score["4"].item() == pytest.approx(expected**0.5, rel=2e-3)
    assert score["long"].item() == pytest.approx(expected / 2, rel=2e-3)  # cycles of 0.4 s


@pytest.mark.parametrize("rate", [1.5, 2.5, 4.5])
def test_feet_that_bounce_trot_all_the_same(rate: float) -> None:
    """Simulated feet do as they lift off: without care for it a trot earned 0.07. Phases are late by up to a step."""
    bouncing = mean_scores(walking(pattern(rate, GAITS["trot"]), bounces=True), TROT_SCORES)
    assert bouncing["trot"].item() > 0.85


def test_a_new_episode_has_no_phases() -> None:
    term = members("reward")["trot"].target(TermSetup(2, torch.device("cpu"), 0.02))
    values = [term(s).clone() for _, s in walking(together([pattern(2.5, GAITS["trot"])] * 2))]
    term.reset(torch.tensor([True, False]))
    after = term(snapshot(2, command=WALK))
    assert values[-1].min() > 0.98
    assert after[0].item() == pytest.approx(math.exp(-3))
    assert after[1] > 0.9


@pytest.mark.parametrize("duty", [-1.0, 2.0])
def test_a_trot_of_three_legs_is_paid_a_quarter(duty: float) -> None:
    score = mean_scores(walking(pattern(2.5, GAITS["trot"], (0.5, 0.5, duty, 0.5))), TROT_SCORES)["trot"]
    assert score.item() == pytest.approx(math.exp(-1.5), rel=0.02)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.5])
def test_trembling_is_not_paid(share: float) -> None:
    scores = mean_scores(trembling(share, n=50, seconds=2.0), TROT_SCORES)
    assert scores["trot"].mean().item() < 0.1
    assert scores["gait"].mean().item() > 0.7


@pytest.mark.parametrize("duty", [0.35, 0.5])
def test_from_all_phases_there_is_a_way_up_to_the_trot(duty: float) -> None:
    """With timers that are compared as times it is a part of them (``docs/paper.md``)."""
    assert climbing(SCORES["trot"], duty, points=8) > 0.97


def test_a_trot_that_begins_is_paid_from_its_second_cycle_on() -> None:
    """Without a cycle behind it a foot has no phase: then neither a reward nor anything that is not finite."""
    score = SCORES["trot"]()
    values = [score(s).item() for _, s in steps(trotting(0.4), 1, 0, 60)]
    assert max(values[:10]) < 0.2
    assert min(values[40:]) > 0.98


def trotting(cycle: float) -> Callable[[int], torch.Tensor]:
    """Who touches the ground in a substep of a trot."""
    offset = torch.tensor([GAITS["trot"]])
    return lambda substep: (substep * PHYSICS_DT / cycle - offset + 1e-4) % 1.0 < 0.5


def test_feet_air_time_pays_most_when_the_phase_changes_every_mode_time() -> None:
    """Averaged over phases of length P, in small ticks, the pay per foot is largest at P = mode_time = 0.175 s."""
    pay = {}
    for length in (0.1, 0.15, 0.17, 0.175, 0.18, 0.2, 0.35):
        t = (torch.arange(2000) + 0.5) / 2000 * length
        swing, rest = t.unsqueeze(1) * torch.tensor([1.0, 0, 0, 1]), t.unsqueeze(1) * torch.tensor([0.0, 1, 1, 0])
        s = snapshot(2000, command=WALK, foot_air_time=swing, foot_contact_time=rest)
        pay[length] = evaluate("feet_air_time", s).mean().item() / 4
    assert max(pay, key=pay.__getitem__) == 0.175
    assert pay[0.175] == pytest.approx(0.175 / 2, rel=1e-3)
    assert pay[0.35] == pytest.approx(0.175 / 4, rel=1e-3)


def test_the_printed_air_time_variance_is_zero_for_every_gait() -> None:
    air = np.random.default_rng(0).uniform(0.0, 0.5, (1000, 4))
    value = evaluate("air_time_variance_literal", snapshot(1000, foot_last_air_time=air))
    assert value.abs().max() < 2e-6  # rounding of sixteen float32 differences
    assert evaluate("air_time_variance", snapshot(1000, foot_last_air_time=air)).min() > 0.0


def test_air_time_variance_is_numpys_unbiased_variance() -> None:
    air, contact = np.random.default_rng(1).uniform(0.0, 0.8, (2, 200, 4))
    value = evaluate("air_time_variance", snapshot(200, foot_last_air_time=air, foot_last_contact_time=contact))
    expected = sum(np.var(np.minimum(x, 0.5), axis=1, ddof=1) for x in (air, contact))
    np.testing.assert_allclose(value.numpy(), expected, rtol=1e-5)
