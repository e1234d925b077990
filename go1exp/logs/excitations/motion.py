"""What an excitation returns, and the shapes that all excitations are made of.

Every shape is a function of continuous time: random draws do not depend on the command rate, so the same seed gives
the same motion at 50 Hz and at 500 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from go1exp.config.schema.registry import Expected, Positive

PerKind = Annotated[tuple[Positive, ...], Field(min_length=1)]
"""One value for each joint of a limb (Go1: hip, thigh, calf), repeated over the limbs; a single one fits all joints."""


class ExcitationError(Expected):
    """An excitation that cannot be made for this robot or command rate; the message says what would be right."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion to command.

    Attributes:
        target: joint angles (T, J), rad; row i is in force from ``t[i]`` to ``t[i + 1]``.
        torque_enable: (T,) bool; false while the actuators are off.
        start: joint angles (J,) at t = 0, rad.
        support: ``suspended``, on the ``ground``, or ``either``.
        height: height of the base above its standing height at the start, m; for drops.
        soft_start: each time the actuators come back on, the player should blend from the measured angles to ``target``
            within this time, s. Without that the joints are pulled back at once. ``target`` rests at the centre
            meanwhile; the command in force differs from it only during the blend.
    """

    target: np.ndarray
    torque_enable: np.ndarray
    start: np.ndarray
    support: Literal["suspended", "ground", "either"]
    height: float = 0.0
    soft_start: float = 0.0


def always_on(target: np.ndarray, support: Literal["suspended", "ground", "either"], height: float = 0.0) -> Motion:
    """Return a motion with actuators on throughout that starts at its first target."""
    return Motion(target, np.ones(len(target), dtype=bool), target[0].copy(), support, height)


def check(t: np.ndarray, centre: np.ndarray, limits: np.ndarray, fastest_hz: float = 0.0) -> float:
    """Return the duration of ``t``, s; ExcitationError for a centre outside or a rate too low for ``fastest_hz``."""
    for joint in np.flatnonzero((centre < limits[:, 0]) | (centre > limits[:, 1])):
        low, high = limits[joint]
        raise ExcitationError(f"joint {joint}: the centre {centre[joint]:g} rad must lie in [{low:g}, {high:g}] rad")
    if len(t) > 1 and fastest_hz:
        rate = 1 / float(np.median(np.diff(t)))
        if 2 * fastest_hz >= rate:
            raise ExcitationError(
                f"{fastest_hz:g} Hz cannot be commanded at {rate:.4g} Hz; stay below {rate / 2:.4g} Hz (half the rate)"
            )
    return float(t[-1] - t[0])


def room(
    amplitude: tuple[float, ...] | np.ndarray, centre: np.ndarray, limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle (J,), near a limit not ``centre``, and half swing (J,), rad, of swings that fit the limits."""
    half = np.minimum(np.resize(amplitude, len(centre)), (limits[:, 1] - limits[:, 0]) / 2)
    return np.clip(centre, limits[:, 0] + half, limits[:, 1] - half), half


def ease(x: np.ndarray) -> np.ndarray:
    """Rise from 0 at x = 0 to 1 at x = 1 with least jerk (Flash and Hogan 1985): speed and acceleration start at 0."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def glide(t: np.ndarray, times: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Pass smoothly through ``levels`` (K, ...) at ``times`` (K,), at rest at each; constant before and after."""
    k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    share = ease((t - times[k]) / (times[k + 1] - times[k]))
    share = share.reshape(-1, *[1] * (levels.ndim - 1))
    return levels[k] + share * (levels[k + 1] - levels[k])


def swing(
    t: np.ndarray,
    wave: np.ndarray,
    amplitude: tuple[float, ...],
    centre: np.ndarray,
    limits: np.ndarray,
    fade: float,
) -> np.ndarray:
    """Scale ``wave`` (T, J), within ±1, to joint angles; the swing grows from ``centre`` over the first ``fade`` s."""
    middle, half = room(amplitude, centre, limits)
    grow = ease((t - t[0]) / fade)[:, None]
    return np.clip(centre + grow * (middle - centre + half * wave), limits[:, 0], limits[:, 1])
