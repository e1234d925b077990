"""``controller=mpc``: forces of standing feet by a convex programme, swinging feet to footholds (Di Carlo et al. 2018)."""

from __future__ import annotations

import math

import numpy as np

from go1exp import robot
from go1exp.controller.forces import Body, ForcePlan, Problem
from go1exp.controller.gait import Clock
from go1exp.controller.kinematics import Kinematics
from go1exp.controller.settings import MpcSettings
from go1exp.controller.smoothing import Smoothed
from go1exp.controller.swing import HIPS, solved, way
from go1exp.controller.types import Command, Drive, Sensed

LEGS = robot.NUM_LEGS


class Mpc:
    """Walks one robot.

    The world of this controller is the attitude's: z up, heading as the IMU has it; places are the integrated velocity,
    of which only differences over a stride matter.
    """

    def __init__(self, settings: MpcSettings, inertia: str = "merged") -> None:
        """Build the model of the robot (``RobotConfig.inertia``) and the programme.

        Raises:
            go1exp.controller.forces.SolverError: if the solver is not installed.
        """
        self.settings, self.period = settings, settings.period
        self._kin = Kinematics(inertia)
        self._body: Body = self._kin.body()
        self._plan = ForcePlan(settings.force, self._body)
        self._clock = Clock(settings.gait.offsets, settings.gait.duty)
        self._every = max(round(settings.force.every / settings.period), 1)
        self._limit = robot.per_joint(robot.EFFORT_LIMIT)
        self._smoothed = Smoothed(settings.smoothing, settings.period)
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next call is the first one."""
        self._clock.restart()
        self._smoothed.restart()
        self._tick, self._started = 0, False
        self._place = np.zeros(3)
        self._lag, self._heading = np.zeros(2), 0.0
        self._lift, self._anchor = np.zeros((LEGS, 3)), np.zeros((LEGS, 3))
        self._hold = np.zeros((LEGS, 3))
        self._down = np.ones(LEGS, dtype=bool)
        self._planned = np.ones(LEGS, dtype=bool)
        self._overdue = np.zeros(LEGS)
        self._forces = np.zeros((LEGS, 3))
        self._slope, self._level = np.zeros(2), 0.0

    def step(self, command: Command, sensed: Sensed) -> Drive:
        """Return what the drives are told until the next call."""
        self._sense(sensed)
        fast = command[0] >= self.settings.gait.fast_speed
        self._clock.period = self.settings.gait.fast_period if fast else self.settings.gait.period
        if self._started:
            self._clock.advance(self.period)
        changed = self._touch(sensed.foot_force)
        self._look_at_ground()
        self._lead(command)
        if changed or self._tick % self._every == 0:
            self._push(command)
            self._tick = 0
        self._tick += 1
        self._started = True
        return self._drive(command)

    # ------------------------------------------------------------------ what is known

    def _sense(self, sensed: Sensed) -> None:
        """Smooth the readings and put the model where they say."""
        now = self._smoothed
        now.update(sensed)
        self._rotation = _matrix(now.quat)
        self._velocity = self._rotation @ now.velocity_b
        self._rate = self._rotation @ sensed.gyro
        if self._started:
            self._place += self.period * self._velocity
        self._kin.update(self._place, now.quat, now.joint_pos, self._velocity, sensed.gyro, sensed.joint_vel)
        R = self._rotation
        self._yaw = math.atan2(R[1, 0], R[0, 0])
        self._roll, self._pitch = math.atan2(R[2, 1], R[2, 2]), -math.asin(max(-1.0, min(1.0, R[2, 0])))
        c, s = math.cos(self._yaw), math.sin(self._yaw)
        self._turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if not self._started:
            self._heading = self._yaw
            self._anchor[:] = self._kin.feet
            self._lift[:] = self._hold[:] = self._kin.feet
            self._level = float(self._kin.feet[:, 2].mean()) - robot.FOOT_RADIUS

    def _touch(self, force: np.ndarray) -> bool:
        """Decide which feet stand; return whether that has changed."""
        touches = force > self.settings.stance.contact_force
        planned, share = self._clock.stands(), self._clock.swing_share()
        begins_swing = self._planned & ~planned
        self._planned = planned
        self._lift[begins_swing] = self._kin.feet[begins_swing]
        before = self._down.copy()
        early = ~planned & touches & (share > 0.5)
        self._down = (self._down & ~begins_swing) | early | (planned & touches)
        self._overdue = np.where(planned & ~self._down, self._overdue + self.period, 0.0)
        if not self._started:
            self._down = planned.copy()
        landed = self._down & ~before
        self._anchor[self._down] = self._kin.feet[self._down]
        return bool((self._down != before).any() or landed.any())

    def _look_at_ground(self) -> None:
        """Lay a plane through the places where the feet last stood: height of the ground and its slope."""
        stance = self.settings.stance
        feet = self._anchor - self._place
        flat = feet @ self._turned  # heading frame
        share = min(self.period / stance.slope_time, 1.0)
        if stance.slope:
            design = np.column_stack([np.ones(LEGS), flat[:, :2]])
            _, *slope = np.linalg.lstsq(design, flat[:, 2], rcond=None)[0]
            self._slope += share * (np.clip(slope, -1.0, 1.0) * 1.0 - self._slope)
            steepest, most = float(np.hypot(*self._slope)), math.tan(stance.max_slope)
            if steepest > most:
                self._slope *= most / steepest
        # Height below the trunk's origin of the ground, from the feet that stand now.
        down = self._down if self._down.any() else np.ones(LEGS, dtype=bool)
        below = float((flat[down, 2] - flat[down, :2] @ self._slope).mean()) - robot.FOOT_RADIUS
        self._below = self._smoothed.height(
            -below, self._velocity[2] - self._slope @ (self._turned.T @ self._velocity)[:2]
        )
        a, b = self._slope
        normal = np.array([-a, -b, 1.0]) / math.sqrt(a * a + b * b + 1.0)
        first = np.array([1.0, 0.0, a]) / math.sqrt(1.0 + a * a)
        second = np.array([normal[1] * first[2] - normal[2] * first[1], normal[2] * first[0] - normal[0] * first[2],
                           normal[0] * first[1] - normal[1] * first[0]])  # fmt: skip
        self._ground = np.column_stack([first, second, normal])

    def _lead(self, command: Command) -> None:
        """Move the wanted place and heading on."""
        wanted = np.array(command[:2])
        here = (self._turned.T @ self._velocity)[:2]
        force = self.settings.force
        self._lag += self.period * (wanted - here)
        length = float(np.hypot(*self._lag))
        if length > force.max_lag:
            self._lag *= force.max_lag / length
        self._heading += self.period * command[2]
        off = (self._heading - self._yaw + math.pi) % (2.0 * math.pi) - math.pi
        self._heading = self._yaw + max(-force.max_turn_lag, min(force.max_turn_lag, off))

    # ------------------------------------------------------------------ feet on the ground

    def _push(self, command: Command) -> None:
        """Plan the forces of the feet."""
        force = self.settings.force
        turn = self._turned.T
        offset = turn @ (self._kin.com - self._place)
        com = np.array([0.0, 0.0, self._below]) + offset
        rate, velocity = turn @ self._rate, turn @ self._velocity
        velocity = velocity + np.array([rate[1] * offset[2] - rate[2] * offset[1],
                                        rate[2] * offset[0] - rate[0] * offset[2],
                                        rate[0] * offset[1] - rate[1] * offset[0]])  # fmt: skip
        state = np.array([[self._roll, self._pitch, 0.0], com, rate, velocity])
        t = force.dt * np.arange(1, force.steps + 1)
        reference = np.zeros((force.steps, 4, 3))
        a, b = self._slope
        # Roll and pitch of a trunk parallel to the ground.
        reference[:, 0] = [math.atan2(b, 1.0), -math.atan2(a, 1.0), self._heading - self._yaw]
        reference[:, 0, 2] += t * command[2]
        heading = t * command[2]
        c, s = np.cos(heading), np.sin(heading)
        vx, vy = c * command[0] - s * command[1], s * command[0] + c * command[1]
        reference[:, 3, 0], reference[:, 3, 1], reference[:, 3, 2] = vx, vy, a * vx + b * vy
        reference[:, 2, 2] = command[2]
        way_to = np.cumsum(reference[:, 3], axis=0) * force.dt
        reference[:, 1] = way_to
        reference[:, 1, :2] += com[:2] + self._lag
        reference[:, 1, 2] = (
            offset[2] + self.settings.height * math.sqrt(1 + a * a + b * b) + reference[:, 1, :2] @ self._slope
        )
        stands = self._clock.schedule(force.steps, force.dt)
        stands[0] = self._down
        empty = ~stands.any(1)
        stands[empty] = True
        feet = (self._kin.feet - self._place) @ self._turned + [0.0, 0.0, self._below]
        arms = feet[None] - com - 0.0 * way_to[:, None]
        upright = turn @ self._rotation
        problem = Problem(state, reference, arms, stands, self._ground, upright)
        forces = self._plan.solve(problem)
        if forces is not None:
            self._forces = forces[0] @ self._turned.T

    # ------------------------------------------------------------------ what the drives are told

    def _drive(self, command: Command) -> Drive:
        """Return forces of standing feet as torques, and targets for the swinging ones."""
        kin, settings = self._kin, self.settings
        q = self._smoothed.joint_pos
        target, kp, kd = q.copy(), np.zeros(12), np.full(12, settings.stance.kd)
        torque = kin.bias.copy()
        stance = np.repeat(self._down, 3)
        pushes = -(kin.jacobians.transpose(0, 2, 1) @ self._forces[:, :, None])[:, :, 0].ravel()
        torque[stance] += pushes[stance]
        flying = np.flatnonzero(~self._down)
        if len(flying):
            place, velocity = self._swing(command, flying)
            trunk = self._velocity + _cross(self._rate, kin.feet[flying] - self._place)
            turned = kin.jacobians[flying]
            change = solved(turned, np.stack([place - kin.feet[flying], velocity - trunk], axis=-1))
            columns = (3 * flying[:, None] + np.arange(3)).ravel()
            target[columns] += np.clip(change[..., 0].ravel(), -0.6, 0.6)
            kp[columns], kd[columns] = settings.swing.kp, settings.swing.kd
            torque[columns] += settings.swing.kd * np.clip(change[..., 1].ravel(), -25.0, 25.0)
        target = np.clip(target, robot.JOINT_POS_LIMITS[:, 0], robot.JOINT_POS_LIMITS[:, 1])
        return Drive(target, kp, kd, np.clip(torque, -self._limit, self._limit))

    def _swing(self, command: Command, legs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the swinging feet ``legs`` are to be now, and how fast they are to move, in the world."""
        swing, clock = self.settings.swing, self._clock
        duration = (1.0 - clock.duty) * clock.period
        share = clock.swing_share()[legs]
        share = np.where(share < 0.0, 1.0, share)  # overdue: the swing has ended
        left = (1.0 - share)[:, None] * duration
        wanted = self._turned @ np.array([command[0], command[1], 0.0])
        hips = HIPS[legs] @ self._turned.T
        rate = np.array([0.0, 0.0, command[2]])
        flat = np.array([self._velocity[0], self._velocity[1], 0.0])
        moving = flat + _cross(rate, hips)
        end = self._place + hips + moving * (left + 0.5 * clock.stance_time) + swing.velocity_gain * (flat - wanted)
        local = (end - self._place) @ self._turned
        end[:, 2] = self._place[2] - self._below + local[:, :2] @ self._slope + robot.FOOT_RADIUS - swing.depth
        place, velocity = way(self._lift[legs], end, swing.height, share, duration)
        late = self._overdue[legs]
        place[:, 2] -= np.minimum(late * swing.reach_speed, swing.reach)
        velocity[:, 2] -= np.where((late > 0) & (late * swing.reach_speed < swing.reach), swing.reach_speed, 0.0)
        return place, velocity


def _cross(w: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return w (3,) x r (n, 3)."""
    return np.stack(
        [w[1] * r[:, 2] - w[2] * r[:, 1], w[2] * r[:, 0] - w[0] * r[:, 2], w[0] * r[:, 1] - w[1] * r[:, 0]], 1
    )


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion w-x-y-z."""
    w, x, y, z = (float(v) for v in quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
