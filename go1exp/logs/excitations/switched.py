"""Motions with sudden changes: steps of the target, and actuators switched off. The robot is suspended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from go1exp.config.schema.registry import Annotated, Field, Fraction, Positive, PositiveRange, excitation
from go1exp.logs.excitations.motion import Motion, PerKind, always_on, check, glide, room

Joints = Annotated[int, Field(ge=1)]
"""A number of joints."""


@excitation("steps")
def steps(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    amplitude: PerKind = (0.25, 0.3, 0.3),
    large: PerKind = (0.35, 0.6, 0.6),
    hold: PositiveRange = (0.08, 0.6),
    mixed: PositiveRange = (0.5, 1.2),
    turn: PositiveRange = (0.25, 0.4),
    at_once: Joints = 2,
    overshoot: Fraction = 0.3,
    settle: Positive = 0.3,
) -> Motion:
    """Jump to random levels at random times; in between, a few joints at a time jump across their whole range.

    The edges show delay, lag and stiffness; the large jumps reach the limits of torque and speed (1.2 rad at a gain
    of 20 N m/rad needs 24 N m, a Go1 thigh gives 23.7). During a large jump the other joints rest at ``centre``: all
    joints together would need kilowatts, and legs could hit one another. Edges may fall on any command, not only
    on those of a policy at 50 Hz. Twelve joints need about 12 s until each has made its large jumps.

    Args:
        t: when commands are sent (T,), s.
        centre: angles to jump about (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives levels, times and turns.
        amplitude: farthest ordinary level to each side, rad, per kind of joint.
        large: half of a large jump, rad, per kind of joint.
        hold: shortest and longest time at an ordinary level, s.
        mixed: shortest and longest stretch of ordinary steps between turns, s.
        turn: shortest and longest time at each end of a large jump, s.
        at_once: joints that make a large jump together; they are far apart on the robot (Go1, two: front and rear leg
            of one side).
        overshoot: free space kept beyond either end, as a share of the largest jump, so that an underdamped joint does
            not hit its stop (a Go1 at gains of 20 and 0.5 overshoots by a third).
        settle: rest at ``centre`` before the first edge, s.

    Raises:
        ExcitationError: if ``centre`` lies outside ``limits``.
    """
    duration = check(t, centre, limits)
    joints = len(centre)
    small, wide = (_kept_free(a, centre, limits, overshoot) for a in (amplitude, large))
    edges = [[(0.0, float(c))] for c in centre]  # when each target jumps, s, and to which angle, rad
    now, turns = settle, _turns(rng, joints, at_once)

    def jump(group: list[int], angles: np.ndarray) -> None:
        for joint in group:
            edges[joint].append((now, float(angles[joint])))

    while now <= duration:
        end = now + rng.uniform(*mixed)
        for joint, jumps in enumerate(edges):
            jumps += _ordinary(rng, now, end, small[0][joint], small[1][joint], hold)
            jumps.append((end, float(centre[joint])))
        now = end + rng.uniform(*turn)
        group, side = next(turns), rng.choice((-1.0, 1.0))
        for sign in (side, -side):
            jump(group, wide[0] + sign * wide[1])
            now += rng.uniform(*turn)
        jump(group, centre)
        now += rng.uniform(*turn)
    target = np.empty((len(t), joints))
    for joint, jumps in enumerate(edges):
        times, levels = np.array(jumps).T
        target[:, joint] = levels[np.searchsorted(times, t - t[0], side="right") - 1]
    return always_on(np.clip(target, limits[:, 0], limits[:, 1]), "suspended")


def _ordinary(
    rng: np.random.Generator, begin: float, end: float, middle: float, half: float, hold: tuple[float, float]
) -> Iterator[tuple[float, float]]:
    """Yield random times from ``begin`` to ``end``, s, with levels up to ``half`` from ``middle``, rad."""
    at = begin + rng.uniform(0, hold[1])
    while at < end:
        yield at, float(middle + half * rng.uniform(-1, 1))
        at += rng.uniform(*hold)


def _kept_free(
    amplitude: tuple[float, ...], centre: np.ndarray, limits: np.ndarray, overshoot: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit jumps of 2 * ``amplitude``, with their overshoot, between the limits: middle and half jump (J,), rad."""
    beyond = 1 + 2 * overshoot
    middle, reach = room(np.resize(amplitude, len(centre)) * beyond, centre, limits)
    return middle, reach / beyond


def _turns(rng: np.random.Generator, joints: int, at_once: int) -> Iterator[list[int]]:
    """Yield groups of ``at_once`` joints without end, in random order; each joint is in one group of a round."""
    count = -(-joints // at_once)
    while True:
        for first in rng.permutation(count):
            yield list(range(int(first), joints, count))


@excitation("torque_off")
def torque_off(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    amplitude: PerKind = (0.3, 0.4, 0.4),
    off: PositiveRange = (0.8, 1.5),
    move: Positive = 0.6,
    settle: Positive = 0.4,
) -> Motion:
    """Take up a pose, switch the actuators off and let the joints swing; then switch on and go to the next pose.

    Without the actuators only the mechanism acts, so that friction is identifiable against the velocity gain. In two
    successive swings each joint starts once on either side of ``centre``, so that at least one starts away from where
    the joint hangs. Only whole swings are made; one takes up to 2 * ``move`` + ``settle`` + ``off[1]``. While the
    actuators are off the target goes to ``centre`` and waits there; :attr:`Motion.soft_start` asks for a blend from the
    measured angles.

    Args:
        t: when commands are sent (T,), s.
        centre: angles between the poses (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives poses and times.
        amplitude: farthest pose to each side, rad, per kind of joint; the nearest is 0.6 of it.
        off: shortest and longest time without actuators, s.
        move: time to go to a pose, and time at ``centre`` after the actuators are back, s.
        settle: rest in the pose, s.

    Raises:
        ExcitationError: if ``centre`` lies outside ``limits``.
    """
    duration = check(t, centre, limits)
    middle, half = room(amplitude, centre, limits)
    times, poses = [0.0], [centre]
    enabled = np.ones(len(t), dtype=bool)
    side = np.empty(0)
    while True:
        # every second swing is the mirror image of the one before
        side = -side if len(times) % 8 == 5 else rng.choice((-1.0, 1.0), len(centre))
        pose = middle + side * half * rng.uniform(0.6, 1, len(centre))
        free = rng.uniform(*off)
        leave = times[-1] + move + settle
        back = leave + free
        if back + move > duration:
            break
        times += [times[-1] + move, leave, leave + free / 2, back + move]
        poses += [pose, pose, centre, centre]
        enabled &= (t - t[0] < leave) | (t - t[0] >= back)
    if len(times) == 1:  # too short for one swing: the pose at rest
        times, poses = [0.0, 1.0], [centre, centre]
    target = glide(t - t[0], np.array(times), np.stack(poses))
    target = np.clip(target, limits[:, 0], limits[:, 1])
    return Motion(target, enabled, target[0].copy(), "suspended", soft_start=move / 2)
