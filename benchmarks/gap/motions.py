"""The benchmark's own excitations of a suspended robot: targets (T, J) in rad, and whether the drives are on (T,).

They resemble what a user records, and are not those that the solver's package makes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d

from go1exp import robot

RATE = 500.0
"""Commands per second."""

CENTRE = np.tile([0.0, 0.95, -1.75], robot.NUM_LEGS)
"""Angles to move about, rad: room to all sides, and a calf well off its stop."""

HANGING = np.tile([0.0, 0.2, -1.0], robot.NUM_LEGS)
"""About where legs hang without drives, rad: targets wait there, so that drives come back without a blow."""

LOW, HIGH = robot.JOINT_POS_LIMITS.T + np.array([[0.12], [-0.12]])
AMPLITUDE = np.tile([0.35, 0.45, 0.4], robot.NUM_LEGS)

Motion = tuple[np.ndarray, np.ndarray]


def _within(target: np.ndarray) -> np.ndarray:
    return np.clip(target, LOW, HIGH)


def _centre(rng: np.random.Generator) -> np.ndarray:
    return CENTRE + rng.uniform(-0.1, 0.1, robot.NUM_JOINTS)


def _on(t: np.ndarray) -> np.ndarray:
    return np.ones(len(t), dtype=bool)


def chirp(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Sweep 0.25 to about 6 Hz with falling amplitude, no two joints alike."""
    first, last = rng.uniform(0.2, 0.4, 12), rng.uniform(4.5, 7.0, 12)
    s = (t / t[-1])[:, None]
    frequency = first + (last - first) * s**2
    angle = 2 * np.pi * t[-1] * (first * s + (last - first) * s**3 / 3) + rng.uniform(0, 2 * np.pi, 12)
    reach = np.minimum(AMPLITUDE, 3.5 / (2 * np.pi * frequency))
    start = np.minimum(t / 0.5, 1.0)[:, None]
    return _within(_centre(rng) + start * reach * np.sin(angle)), _on(t)


def steps(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Jump to random levels; one joint of each leg in turn jumps across its range, far enough to reach the limits."""
    centre = _centre(rng)
    target = np.tile(centre, (len(t), 1))
    for joint in range(12):
        at = rng.uniform(0.05, 0.3)
        while at < t[-1]:
            target[t >= at, joint] = centre[joint] + rng.uniform(-0.8, 0.8) * AMPLITUDE[joint]
            at += rng.uniform(0.12, 0.45)
    order, now = rng.permutation(12).reshape(3, 4), 0.4
    wide = np.tile([0.5, 0.6, 0.55], 4)
    for turn in range(10**6):
        if now > t[-1]:
            break
        mine = order[turn % 3]
        side = rng.choice((-1.0, 1.0), 4)
        for sign in (1.0, -1.0):
            end = now + rng.uniform(0.2, 0.3)
            target[np.ix_((t >= now) & (t < end), mine)] = CENTRE[mine] + sign * side * wide[mine]
            now = end
        now += rng.uniform(0.5, 0.8)
    return _within(target), _on(t)


def ramps(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Creep to and fro at 0.05 to 0.3 rad/s, rest now and then."""
    centre = _centre(rng)
    target = np.empty((len(t), 12))
    for joint in range(12):
        at, level, side = [0.0], [centre[joint]], rng.choice((-1.0, 1.0))
        while at[-1] < t[-1]:
            goal = centre[joint] + side * rng.uniform(0.05, 0.3)
            at.append(at[-1] + abs(goal - level[-1]) / np.exp(rng.uniform(np.log(0.05), np.log(0.3))))
            level.append(goal)
            if rng.random() < 0.4:
                at.append(at[-1] + rng.uniform(0.1, 0.5))
                level.append(goal)
            side = -side
        target[:, joint] = np.interp(t, at, level)
    return _within(target), _on(t)


def gait(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Trot in the air; targets change at 50 Hz, as a policy's do."""
    held = np.floor(t * 50.0 + 1e-6) / 50.0
    hz, leg = rng.uniform(1.5, 3.0), np.repeat([0.0, 0.5, 0.5, 0.0], 3)
    angle = 2 * np.pi * (hz * held[:, None] + leg + rng.uniform(-0.04, 0.04, 12))
    size = np.tile([0.08, 0.3, 0.3], 4) * rng.uniform(0.7, 1.2, 12)
    wave = np.sin(angle + np.tile([0.0, 0.0, 1.3], 4)) + 0.3 * np.sin(2 * angle + rng.uniform(0, 6, 12))
    start = np.minimum(held / 0.5, 1.0)[:, None]
    noise = rng.standard_normal((round(t[-1] * 50) + 2, 12)) * 0.02
    return _within(_centre(rng) + start * (size * wave + noise[(held * 50 + 0.5).astype(int)])), _on(t)


def swings(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Go to a pose, switch the drives off for a moment, let the legs swing, take them up again."""
    target, on = np.tile(CENTRE, (len(t), 1)), _on(t)
    now, pose = 0.2, CENTRE
    while now < t[-1]:
        goal = _within(_centre(rng) + rng.choice((-1.0, 1.0), 12) * rng.uniform(0.4, 1.0, 12) * AMPLITUDE)
        share = np.clip((t - now) / 0.4, 0.0, 1.0)[:, None]
        target = np.where(t[:, None] >= now, pose + share * (goal - pose), target)
        leave = now + rng.uniform(0.6, 0.75)
        now = leave + rng.uniform(0.3, 0.7)
        on &= (t < leave) | (t >= now)
        pose = HANGING
        target = np.where(t[:, None] >= leave, pose, target)
    return _within(target), on


def gentle(t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Move slowly and little, smoothly: torques and speeds far from any limit."""
    path = gaussian_filter1d(rng.standard_normal((len(t), 12)), 0.35 * RATE, axis=0)
    path *= 0.2 / np.abs(path).max(axis=0)
    return _within(_centre(rng) + np.minimum(t / 1.0, 1.0)[:, None] * path), _on(t)


MOTIONS: dict[str, Callable[[np.ndarray, np.random.Generator], Motion]] = {
    "chirp": chirp,
    "steps": steps,
    "ramps": ramps,
    "gait": gait,
    "swings": swings,
    "gentle": gentle,
}
