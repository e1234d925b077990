"""``controller=mpc``: a convex programme for the forces of the standing feet, footholds for the others.

After Di Carlo, Wensing, Katz, Bledt, Kim, "Dynamic Locomotion in the MIT Cheetah 3 Through Convex Model-Predictive
Control" (IROS 2018).
"""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.forces import ForcePlan, Problem
from go1exp.evaluate.controller.gait import Clock, Feet, footholds, solved, way
from go1exp.evaluate.controller.settings import MpcSettings
from go1exp.evaluate.controller.state import Ground, Smoothed, frame, heading, matrix, roll_pitch_yaw, skew, wrapped
from go1exp.evaluate.controller.types import Command, Sensed
from go1exp.robot.messages import LowCmd
from go1exp.sim.physics.dynamics import Kinematics

LIMIT = robot.per_joint(robot.EFFORT_LIMIT)
LOW, HIGH = robot.JOINT_POS_LIMITS.T
MOST_CHANGE = 0.6  # largest difference between a target and the joint's angle, rad
MOST_SPEED = 25.0  # largest commanded joint velocity of a swinging leg, rad/s


STANDING = LowCmd(
    robot.NOMINAL_STANCE,
    np.full(robot.NUM_JOINTS, 60.0),
    np.full(robot.NUM_JOINTS, 2.0),
    feedforward=np.zeros(robot.NUM_JOINTS),
)
"""The nominal stance, before the first step: 60 N m/rad and 2 N m s/rad hold the trunk to some millimetres (chosen)."""

BUILT = ("settings", "period", "_kin", "_plan", "_every")
"""Attributes that no step changes, or that each one computes from the readings."""


class Mpc:
    """Model predictive controller of one robot, called every ``period`` s.

    Its world frame has z up and x at zero heading of the IMU. Positions in it are the integrated velocity: only
    differences within a stride matter, so drift does not.
    """

    def __init__(self, settings: MpcSettings, inertia: str = "merged") -> None:
        """Build the robot's model (``RobotConfig.inertia``) and the programme; raise SolverError without a solver."""
        self.settings, self.period = settings, settings.period
        self._kin = Kinematics(inertia)
        self._plan = ForcePlan(settings.force, self._kin.mass, self._kin.composite_inertia())
        self._every = max(round(settings.force.every / settings.period), 1)
        gait, stance, smoothing = settings.gait, settings.stance, settings.smoothing
        self._clock = Clock(gait.offsets, gait.duty, gait.period)
        self._smoothed = Smoothed(smoothing, settings.period)
        self._ground = Ground(stance, smoothing.height, settings.period)
        self._feet = Feet(stance.contact_force, settings.period)
        self.reset()

    def reset(self) -> None:
        """Reset: the next call is the first one."""
        for part in (self._clock, self._smoothed, self._ground, self._feet):
            part.restart()
        self._since_plan, self._first, self._stands = 0, True, round(self.settings.stand / self.period)
        self._command: Command = (0.0, 0.0, 0.0)
        self._place, self._lag, self._heading = np.zeros(3), np.zeros(2), 0.0
        self._forces = np.zeros((robot.NUM_LEGS, 3))

    def save(self) -> dict[str, Any]:
        """Return a copy of its state."""
        return copy.deepcopy({name: value for name, value in vars(self).items() if name not in BUILT})

    def load(self, state: dict[str, Any]) -> None:
        """Restore what ``save`` returned."""
        vars(self).update(copy.deepcopy(state))

    def step(self, command: Command, sensed: Sensed) -> LowCmd:
        """Return the motors' command until the next call."""
        if self._stands:
            self._stands -= 1
            return STANDING
        self._sense(sensed)
        changed = self._feet.update(self._clock, sensed.foot_force, self._kin.feet)
        self._ground.update(self._feet.anchor - self._place, self._feet.down, self._velocity)
        command = self._level(self._ramped(command))
        self._lead(command)
        if changed or self._since_plan >= self._every:
            self._push(command)
            self._since_plan = 0
        self._since_plan += 1
        self._first = False
        return self._joint_commands(command)

    def _sense(self, sensed: Sensed) -> None:
        now = self._smoothed
        now.update(sensed)
        self._rotation = matrix(now.quat)
        self._roll, self._pitch, self._yaw = roll_pitch_yaw(self._rotation)
        self._turned = heading(self._yaw)
        self._velocity, self._rate = self._rotation @ now.velocity_b, self._rotation @ sensed.gyro
        if self._first:
            self._heading = self._yaw
        else:
            self._place += self.period * self._velocity
            self._clock.advance(self.period)
        self._kin.update(self._place, now.quat, now.joint_pos, self._velocity, sensed.gyro, sensed.joint_vel)
        self._ahead = self._turned.T @ self._velocity  # in the axes of the heading, like the command

    def _slope(self) -> tuple[float, float]:
        """Return the rise of the ground per m ahead and to the left."""
        a, b = (self._turned[:2, :2].T @ self._ground.gradient).tolist()
        return a, b

    def _ramped(self, command: Command) -> Command:
        """Return the command with limited rate of change: after a jump from rest the first steps would be too long."""
        limits = self.settings.ramp.speed, self.settings.ramp.speed, self.settings.ramp.turn
        moved = (
            before + max(-self.period * most, min(self.period * most, wanted - before))
            for before, wanted, most in zip(self._command, command, limits, strict=True)
        )
        x, y, yaw = self._command = tuple(moved)  # type: ignore[assignment]
        return x, y, yaw

    def _level(self, command: Command) -> Command:
        """Return the horizontal part of a velocity that is commanded along the ground."""
        x, y, yaw = command
        a, b = self._slope()
        rise = (a * x + b * y) / max(math.hypot(x, y), 1e-9)
        share = 1.0 / math.sqrt(1.0 + rise * rise)
        return share * x, share * y, yaw

    def _lead(self, command: Command) -> None:
        """Advance the reference position and heading, within their largest distance from the robot."""
        x, y, yaw = command
        force = self.settings.force
        self._lag += self.period * (np.array([x, y]) - self._ahead[:2])
        length = math.hypot(*self._lag.tolist())
        if length > force.max_lag:
            self._lag *= force.max_lag / length
        off = wrapped(self._heading + self.period * yaw - self._yaw)
        self._heading = self._yaw + max(-force.max_turn_lag, min(force.max_turn_lag, off))

    def _push(self, command: Command) -> None:
        """Plan the forces of the feet, in axes of the heading whose origin is the ground below the trunk."""
        turn, force = self._turned.T, self.settings.force
        slope = self._slope()
        trunk = np.array([0.0, 0.0, self._ground.height])
        offset, rate = turn @ (self._kin.com - self._place), turn @ self._rate
        com = trunk + offset
        state = np.array([[self._roll, self._pitch, 0.0], com, rate, self._ahead + skew(rate) @ offset])
        stands = self._clock.schedule(force.steps, force.dt)
        stands[0] = self._feet.down
        stands[~stands.any(1)] = True  # the programme needs forces also in a flight phase
        # The present arms also for later intervals: with arms along the reference the robot falls at 2 m/s.
        arms = (self._kin.feet - self._place) @ self._turned + (trunk - com)
        problem = Problem(
            state=state,
            reference=self._reference(command, com, offset, slope),
            arms=np.broadcast_to(arms, (force.steps, *arms.shape)),
            stands=stands,
            ground=frame(*slope),
            attitude=turn @ self._rotation,
        )
        forces = self._plan.solve(problem)
        if forces is not None:  # else the last ones go on
            self._forces = forces[0] @ turn

    def _reference(
        self, command: Command, com: np.ndarray, offset: np.ndarray, slope: tuple[float, float]
    ) -> np.ndarray:
        """Return the wanted states (K, 4, 3) of ``Problem``: the commanded velocity, parallel to the ground."""
        x, y, yaw = command
        a, b = slope
        force = self.settings.force
        t = force.dt * np.arange(1, force.steps + 1)
        c, s = np.cos(yaw * t), np.sin(yaw * t)
        wanted = np.zeros((force.steps, 4, 3))
        wanted[:, 0] = math.atan(b), -math.atan(a), wrapped(self._heading - self._yaw)
        wanted[:, 0, 2] += yaw * t
        wanted[:, 2, 2] = yaw
        vx, vy = c * x - s * y, s * x + c * y
        wanted[:, 3] = np.column_stack([vx, vy, a * vx + b * vy])
        wanted[:, 1, :2] = com[:2] + self._lag + force.dt * np.cumsum(wanted[:, 3, :2], axis=0)
        upright = self.settings.height * math.sqrt(1.0 + a * a + b * b)  # vertical, of a height along the normal
        wanted[:, 1, 2] = offset[2] + upright + wanted[:, 1, :2] @ slope
        return wanted

    def _joint_commands(self, command: Command) -> LowCmd:
        """Return torques for the standing legs, and targets for the swinging ones."""
        kin, swing = self._kin, self.settings.swing
        down = self._feet.down
        # Standing legs: the weight of the leg, and tau = -J' f; their targets are their angles.
        torque = (kin.bias.reshape(-1, 3) - down[:, None] * (self._forces[:, None] @ kin.jacobians)[:, 0]).copy()
        target = self._smoothed.joint_pos.reshape(-1, 3).copy()
        kp, kd = np.zeros((4, 3)), np.full((4, 3), self.settings.stance.kd)
        legs = np.flatnonzero(~down)
        if len(legs):
            place, velocity = self._swing(command, legs)
            feet = kin.feet[legs]
            moving = self._velocity + (feet - self._place) @ skew(self._rate).T  # a foot that is fixed to the trunk
            errors = np.empty((len(legs), 3, 2))
            errors[:, :, 0], errors[:, :, 1] = place - feet, velocity - moving
            change = solved(kin.jacobians[legs], errors)
            target[legs] += np.clip(change[:, :, 0], -MOST_CHANGE, MOST_CHANGE)
            # The joint velocity in the torque: kd brakes differences only.
            torque[legs] += swing.kd * np.clip(change[:, :, 1], -MOST_SPEED, MOST_SPEED)
            kp[legs], kd[legs] = swing.kp, swing.kd
        within, forward = np.clip(target.ravel(), LOW, HIGH), np.clip(torque.ravel(), -LIMIT, LIMIT)
        return LowCmd(within, kp.ravel(), kd.ravel(), feedforward=forward)

    def _swing(self, command: Command, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return reference positions (n, 3), m, and velocities (n, 3), m/s, of the feet ``legs`` in the world."""
        swing, clock, overdue = self.settings.swing, self._clock, self._feet.overdue[legs]
        duration = (1.0 - clock.duty) * clock.period
        share = clock.swing_share()[legs]
        share[share < 0.0] = 1.0  # overdue: the swing has ended
        left, stance = (1.0 - share) * duration, clock.duty * clock.period
        below = footholds(swing.velocity_gain, self._ahead, command, left, stance, legs)
        end = np.empty((len(legs), 3))
        end[:, :2] = below
        end[:, 2] = below @ self._slope() + (robot.FOOT_RADIUS - swing.depth - self._ground.height)
        place, velocity = way(self._feet.lift[legs], end @ self._turned.T + self._place, swing.height, share, duration)
        if overdue.any():
            further = overdue * swing.reach_speed
            place[:, 2] -= np.minimum(further, swing.reach)
            velocity[:, 2] -= swing.reach_speed * ((overdue > 0.0) & (further < swing.reach))
        return place, velocity
