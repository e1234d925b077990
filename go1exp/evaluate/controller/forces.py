"""Forces of the feet on the ground over a short horizon: the convex programme of Di Carlo et al. (2018).

The robot is one rigid body of mass m and inertia I about its centre of mass. Small roll and pitch make its equations
linear (eq. 14 to 16 there)::

    d(roll, pitch, yaw)/dt = R' omega       R_w I R_w' d omega/dt = sum of r_i x f_i
    dp/dt = v                               m dv/dt = sum of f_i + m g

with R the rotation by the heading. Over an interval forces are constant, so that angles and positions are sums of
known numbers times forces: the matrices of the condensed programme need no product over the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from go1exp.base.errors import Expected
from go1exp.robot import GRAVITY

if TYPE_CHECKING:
    from go1exp.evaluate.controller.settings import ForceSettings


class SolverError(Expected):
    """The solver of quadratic programmes is not installed."""


def solver() -> ModuleType:
    """Return the module of the solver; raise SolverError if it is not installed."""
    try:
        import daqp
    except ImportError as error:
        raise SolverError("controller=mpc: needs daqp, which is not installed; pip install 'go1exp[mpc]'") from error
    return daqp


@dataclass(frozen=True)
class Problem:
    """One programme, in a frame that is horizontal and has the robot's heading at the first instant."""

    # (4, 3) roll-pitch-yaw rad, position of the centre of mass m, angular velocity rad/s, velocity m/s
    state: np.ndarray
    reference: np.ndarray  # (K, 4, 3) the same, wanted at the end of each interval
    arms: np.ndarray  # (K, 4, 3) from the wanted centre of mass to each foot, in each interval, m
    stands: np.ndarray  # (K, 4) bool: the feet that push in each interval
    ground: np.ndarray  # (3, 3) columns are two tangents and the normal of the ground
    attitude: np.ndarray  # (3, 3) rotation of the trunk for its inertia


@dataclass(frozen=True)
class Structure:
    """Parts of a programme that depend on the schedule alone; n foot intervals, three columns each."""

    interval: np.ndarray  # (n,) of each
    foot: np.ndarray  # (n,) of each
    column_interval: np.ndarray  # (3 n,) interval of each column
    places: np.ndarray  # (3 n, 3 n) sum over the horizon of products of two columns' shares in a place
    speeds: np.ndarray  # (3 n, 3 n) the same of their shares in a speed
    A: np.ndarray  # (4 n, 3 n) rows of the friction pyramids
    upper: np.ndarray  # (7 n,) upper bounds of forces and rows
    lower: np.ndarray  # (7 n,) lower bounds
    sense: np.ndarray  # (7 n,) the solver's kinds of bounds: all may be active


MOST_STRUCTURES = 500  # largest number of cached structures; a gait repeats some tens of schedules


class ForcePlan:
    """Builds and solves the quadratic programme."""

    def __init__(self, settings: ForceSettings, mass: float, inertia: np.ndarray) -> None:
        """Compute what does not depend on the state; raise SolverError if the solver is not installed.

        ``mass``, kg, and ``inertia`` (3, 3) about the centre of mass, trunk frame, kg m2, are the robot's as one body.
        """
        self._solve = solver().solve
        self.settings, self._mass = settings, mass
        steps, dt = settings.steps, settings.dt
        after = np.arange(1, steps + 1)[:, None] - np.arange(steps)[None, :]  # ends of intervals, from their starts
        begun = after > 0
        speed, place = dt * begun, dt**2 * (after - 0.5) * begun
        self._speed, self._place = speed, place
        self._inverse = np.linalg.inv(inertia)
        self._structure = lru_cache(MOST_STRUCTURES)(self._structured)
        self._speed_speed, self._place_place = speed.T @ speed, place.T @ place
        self._times = dt * np.arange(1, steps + 1)[:, None]
        weights = settings.weights
        self._weights = np.array([weights.attitude, weights.position, weights.angular_velocity, weights.velocity])
        mu = settings.friction
        self._cone = np.array([[1.0, 0.0, -mu], [-1.0, 0.0, -mu], [0.0, 1.0, -mu], [0.0, -1.0, -mu]])

    def programme(self, problem: Problem) -> tuple[np.ndarray, ...]:
        """Return H, g, A, upper and lower bounds of: minimise x' H x / 2 + g' x, lower <= (x, A x) <= upper.

        x are the forces of the standing feet in the axes of the ground, interval by interval, foot by foot.
        """
        settings, structure = self.settings, self._structure(problem.stands.tobytes())
        column_interval, n = structure.column_interval, len(structure.interval)
        rotation = problem.attitude
        inverse = rotation @ self._inverse @ rotation.T
        # Columns: accelerations and angular accelerations of each force component.
        r = problem.arms[structure.interval, structure.foot]
        turn = inverse @ _crossed(r, problem.ground)
        push = np.tile(problem.ground / self._mass, (1, n))
        q_angle, q_place, q_turn, q_speed = self._weights
        free, angles = self._drift(problem)
        H = structure.places * (turn.T @ (q_angle[:, None] * turn) + push.T @ (q_place[:, None] * push))
        H += structure.speeds * (turn.T @ (q_turn[:, None] * turn) + push.T @ (q_speed[:, None] * push))
        H *= 2.0
        H.flat[:: 3 * n + 1] += 2.0 * settings.effort
        by_place, by_speed = self._place.T @ angles, self._speed.T @ free
        g = (turn * (q_angle * by_place[:, :3] + q_turn * by_speed[:, :3])[column_interval].T).sum(0)
        g += (push * (q_place * by_place[:, 3:] + q_speed * by_speed[:, 3:])[column_interval].T).sum(0)
        g = 2.0 * g - 2.0 * settings.effort * self._share(problem, structure.interval)
        return H, g, structure.A, structure.upper, structure.lower

    def _drift(self, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (K, 6) of (angular velocity, velocity) and of (angles, place) without any force."""
        angles, place, turn, speed = problem.state
        t, wanted = self._times, problem.reference
        fall = np.array([0.0, 0.0, -GRAVITY])
        rates = np.concatenate([np.broadcast_to(turn, wanted[:, 2].shape), speed + t * fall], axis=1)
        places = np.concatenate([angles + t * turn, place + t * speed + 0.5 * t**2 * fall], axis=1)
        return rates - wanted[:, 2:].reshape(-1, 6), places - wanted[:, :2].reshape(-1, 6)

    def _share(self, problem: Problem, interval: np.ndarray) -> np.ndarray:
        """Return the reference forces (3 n,) of the effort: the weight, shared by the standing feet."""
        weight = problem.ground.T @ np.array([0.0, 0.0, self._mass * GRAVITY])
        count = problem.stands.sum(1)[interval]
        return np.asarray((weight[None, :] / count[:, None]).ravel())

    def _structured(self, stands: bytes) -> Structure:
        """Return the structure of a schedule, the bytes of (K, 4) bool."""
        interval, foot = np.nonzero(np.frombuffer(stands, dtype=bool).reshape(-1, 4))
        n, column_interval = len(interval), np.repeat(interval, 3)
        both = (column_interval[:, None], column_interval[None, :])
        A = np.zeros((n, 4, n, 3))
        A[np.arange(n), :, np.arange(n)] = self._cone
        most = self.settings.max_force
        upper = np.concatenate([np.tile([most, most, most], n), np.zeros(4 * n)])
        lower = np.concatenate([np.tile([-most, -most, 0.0], n), np.full(4 * n, -1e30)])
        return Structure(
            interval=interval,
            foot=foot,
            column_interval=column_interval,
            places=self._place_place[both],
            speeds=self._speed_speed[both],
            A=A.reshape(4 * n, 3 * n),
            upper=upper,
            lower=lower,
            sense=np.zeros(7 * n, dtype=np.intc),
        )

    def solve(self, problem: Problem) -> np.ndarray | None:
        """Return the forces (K, 4, 3) on the feet, N, in the problem's frame; None if the solver found none."""
        H, g, A, upper, lower = self.programme(problem)
        x, _, flag, _ = self._solve(H, g, A, upper, lower, self._structure(problem.stands.tobytes()).sense)
        if flag < 1:
            return None
        forces = np.zeros((*problem.stands.shape, 3))
        forces[problem.stands] = np.asarray(x).reshape(-1, 3) @ problem.ground.T
        return forces


def _crossed(r: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the moments (3, 3 n) of unit forces along the columns of ``axes`` (3, 3) at each arm ``r`` (n, 3)."""
    a = axes.T
    moments = np.empty((len(r), 3, 3))  # arm, axis, component
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        moments[:, :, k] = r[:, i, None] * a[None, :, j] - r[:, j, None] * a[None, :, i]
    return np.asarray(moments.reshape(-1, 3).T)
