"""Windows of legs in swing: a leg in the air is a suspended leg on a trunk that moves as the IMU says.

While its foot is in the air, a leg feels the ground only through the motion of the trunk, which the IMU measures: the
specific force and the rate of turn, in the trunk's own axes, are all that the leg's motion depends on. So nothing about
contact, attitude or velocity of the trunk has to be known. A foot is in the air where the torque of its leg leaves no
force on it, by inverse dynamics.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from go1exp import robot
from go1exp.gap.data.cutting import FIT_S, Place, cut, noise_of
from go1exp.gap.data.standing import IMU_BIAS_SD, IMU_DELAY_SD, LOADED, Log
from go1exp.gap.data.windows import PAST_S, Windows
from go1exp.gap.result import GapSettings
from go1exp.logs.recording import Recording, RecordingError
from go1exp.robot.config import RobotConfig
from go1exp.sim.physics.dynamics import LegDynamics, Legs

LONGEST_S, BURN_S = 0.25, 0.02  # longest windows, and what is replayed before them, s: a swing of a trot takes 0.2 s
SHORTEST_S = 0.05  # shortest time of a swing that is compared, s

AFTER_S, BEFORE_S = 0.006, 0.01
"""Time after lift-off, beside the half width of the smoothing, and before touch-down that is left out, s."""

SOONER_S = 0.016  # span in which a window begins where its initial state is known best, s
MOST_WINDOWS = 120  # windows beyond which more would only cost time
MOTION_S = 0.006  # half width of the smoothing of the trunk's motion, s (chosen)

NOISE_ROWS, NOISE_PIECES = 54, 6
"""Rows of a swing, and swings of a leg, from which the noise of its encoders can be read."""

AROUND_S = 0.01  # time before and after a window for which its trunk's motion is kept, s


@dataclass(frozen=True)
class TrunkMotion:
    """How a trunk moves, in its own axes."""

    t: np.ndarray  # (T,) clock, s
    force: np.ndarray  # (T, 3) specific force at the trunk's origin, m/s2
    turn: np.ndarray  # (T, 3) angular acceleration, rad/s2
    rate: np.ndarray  # (T, 3) angular velocity, rad/s

    @staticmethod
    def from_log(log: Log, site: np.ndarray) -> TrunkMotion:
        """Smooth the readings of an IMU that sits at ``site`` (3,) in the trunk, m."""
        rate, turn = _smooth(log.t, log.imu[:, :3], MOTION_S)
        sensed, _ = _smooth(log.t, log.imu[:, 3:], MOTION_S)
        return TrunkMotion(log.t, sensed - np.cross(turn, site) - np.cross(rate, np.cross(rate, site)), turn, rate)

    @functools.cached_property
    def values(self) -> np.ndarray:
        """(T, 9) force, angular acceleration and rate."""
        return np.concatenate([self.force, self.turn, self.rate], axis=1)


def _smooth(t: np.ndarray, values: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values (T, c) and their slopes by parabolas through the samples ``half`` s to each side."""
    period = float(np.median(np.diff(t)))
    size = 2 * max(round(half / period), 1) + 1
    value, slope = (savgol_filter(values, size, 2, deriv=d, delta=period, axis=0) for d in (0, 1))
    return value, slope


def foot_forces(config: RobotConfig, legs: Legs, log: Log, motion: TrunkMotion) -> np.ndarray:
    """Return the upward force on each foot (T, 4), N, that the torques of its leg leave, by inverse dynamics."""
    dynamics = LegDynamics(config)
    _, speeding = _smooth(log.t, log.qd, MOTION_S)
    up = log.attitude.as_matrix()[:, 2]
    forces = np.empty((len(log.t), robot.NUM_LEGS))
    for k in range(len(log.t)):
        needed = dynamics.torque(log.q[k], log.qd[k], speeding[k], motion.values[k])
        _, moves = legs.feet(log.q[k], up[k])
        forces[k] = legs.forces(moves, log.torque[k] - needed) @ up[k]
    return forces


def swings(t: np.ndarray, forces: np.ndarray) -> list[tuple[int, float, float]]:
    """Return (leg, begin, end) of each swing, s, in order, from the upward forces (T, 4), N, at times (T,), s."""
    made = []
    for leg, force in enumerate(forces.T):
        air = np.concatenate([[False], force < LOADED, [False]])
        up, down = (np.flatnonzero(air[1:] & ~air[:-1]), np.flatnonzero(air[:-1] & ~air[1:]) - 1)
        made += [(leg, float(t[a]), float(t[b])) for a, b in zip(up, down, strict=True)]
    return sorted(made, key=lambda swing: swing[1])


def places(air: Sequence[tuple[int, float, float]], begin: float, end: float) -> list[Place]:
    """Return where windows may be, from ``begin`` to ``end``, s: legs that swing nearly together share one."""
    usable = [
        (leg, max(a + FIT_S + AFTER_S, begin), min(b - BEFORE_S, a + FIT_S + AFTER_S + BURN_S + LONGEST_S))
        for leg, a, b in air
    ]
    least = BURN_S + SHORTEST_S + SOONER_S
    left = [s for s in usable if s[2] - s[1] >= least]
    made = []
    while left:
        first = left[0]
        share = [
            s for s in left if min(s[2], first[2]) - max(s[1], first[1]) >= max(least, 0.8 * (first[2] - first[1]))
        ]
        start, stop = max(s[1] for s in share), min(s[2] for s in share)
        if stop - start < least:  # three or more that overlap by pairs only
            share, start, stop = [first], first[1], first[2]
        left = [s for s in left if s not in share]
        if start + BURN_S + LONGEST_S + SOONER_S < end:
            joints = tuple(3 * s[0] + k for s in share for k in range(3))
            made.append(Place(start, start + SOONER_S, stop, joints))
    return made


@dataclass(frozen=True)
class SwingWindows(Windows):
    """Windows of legs in swing; the joints of the other legs have infinite noise."""

    # per window, times (K,) since the initial state, and force, angular acceleration and rate (K, 9) of the trunk, as
    # in :class:`TrunkMotion`
    carried: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def base_sd(self) -> np.ndarray:
        """(W, 7) standard deviations of what the IMU is off by: accelerometer m/s2, gyro rad/s, delay s."""
        off = (*(IMU_BIAS_SD[1],) * 3, *(IMU_BIAS_SD[0],) * 3, IMU_DELAY_SD)
        return np.tile(off, (len(self), 1))

    def by_quantity(self, values: np.ndarray) -> dict[str, float]:
        """Return the median of values (W, C, J) by quantity, of the joints that are compared."""
        known = np.isfinite(self.scale)
        return {name: float(np.median(values[:, c][known[:, c]])) for c, name in enumerate(self.quantities)}


def cut_swings(recordings: Sequence[Recording], settings: GapSettings, config: RobotConfig) -> SwingWindows:
    """Cut recordings of a Go1 with a free trunk into windows of legs in swing; RecordingError if there is none."""
    legs = Legs(config)
    logs = [Log.from_recording(r) for r in recordings]
    motions = [TrunkMotion.from_log(log, legs.imu_site) for log in logs]
    of_log = [
        places(swings(log.t, foot_forces(config, legs, log, motion)), log.t[0] + PAST_S, log.t[-1])
        for log, motion in zip(logs, motions, strict=True)
    ]
    if not any(of_log):
        shortest = FIT_S + AFTER_S + BURN_S + SHORTEST_S + SOONER_S + BEFORE_S
        raise RecordingError(f"no leg swings for {shortest:.2g} s or longer in these recordings; record walks")
    every = max(1, -(-sum(map(len, of_log)) // MOST_WINDOWS))
    of_log = [each[k % every :: every] for k, each in enumerate(of_log)]
    longest = max(place.end - place.first for each in of_log for place in each) - settings.burn_s
    suited = dataclasses.replace(settings, window_s=min(longest, settings.window_s))
    plain = cut(recordings, suited, places=of_log)
    scale, carried = plain.scale.copy(), []
    for c, name in enumerate(plain.quantities):
        scale[:, c] = np.where(
            plain.compared, _noise_in_air(recordings, logs, of_log, name, scale[:, c].min(axis=0)), np.inf
        )
    for number, begin in zip(plain.episode.tolist(), plain.begin.tolist(), strict=True):
        motion = motions[number]
        near = (motion.t > begin - AROUND_S) & (motion.t < begin + plain.length + AROUND_S)
        carried.append((motion.t[near] - begin, motion.values[near]))
    return SwingWindows(**vars(plain) | {"scale": scale}, carried=tuple(carried))


def _noise_in_air(
    recordings: Sequence[Recording],
    logs: Sequence[Log],
    of_log: Sequence[Sequence[Place]],
    quantity: str,
    otherwise: np.ndarray,
) -> np.ndarray:
    """Return the noise of a quantity (J,) from swings, or ``otherwise`` (J,) where they are too short or too few."""
    noise = np.array(otherwise)
    for joint in range(len(noise)):
        pieces = [
            r.joint(quantity)[(log.t >= place.first) & (log.t <= place.end), joint : joint + 1]
            for r, log, inside in zip(recordings, logs, of_log, strict=True)
            for place in inside
            if place.compared(len(noise))[joint]
        ]
        long = [piece for piece in pieces if len(piece) >= NOISE_ROWS]
        if len(long) >= NOISE_PIECES:
            noise[joint] = min(noise_of(long)[0], otherwise[joint])
    return noise


def for_swings(settings: GapSettings) -> GapSettings:
    """Return settings with windows that suit swings."""
    return dataclasses.replace(settings, window_s=min(settings.window_s, LONGEST_S), burn_s=BURN_S, torque=False)
