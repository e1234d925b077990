"""Motions on the ground: they load the joints with the weight of the robot and excite the contacts."""

from __future__ import annotations

import numpy as np

from go1exp.config.schema.registry import Annotated, Field, PositiveRange, excitation
from go1exp.logs.excitations.motion import ExcitationError, Motion, always_on, check, glide

Depth = Annotated[float, Field(gt=0, le=0.6)]
"""Share of the standing height; a leg cannot fold by more than about 0.6."""


@excitation("squat", smooth=True)
def squat(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    depth: Depth = 0.25,
    move: PositiveRange = (0.35, 1.5),
    rest: PositiveRange = (0.05, 0.4),
) -> Motion:
    """Lower the trunk and raise it again, feet where they are: strength, gains and friction under load, payload.

    Joints count in threes (hip, thigh, calf) with thigh and calf of one length, as on the Go1; each foot stays below
    the point it stands on. Where joints do not come in threes, each bends towards its farther limit instead.

    Args:
        t: when commands are sent (T,), s.
        centre: stance (J,), rad.
        limits: lowest and highest target (J, 2), rad; all legs go as low as the first one that meets a limit.
        rng: gives depths and times.
        depth: how far the hips sink at most, as a share of their height over the feet; the shallowest is half of it.
        move: shortest and longest time down or up, s.
        rest: shortest and longest rest at the turning points, s.

    Raises:
        ExcitationError: if ``centre`` lies outside ``limits``.
    """
    duration = check(t, centre, limits)
    shares = np.linspace(0, depth, 201)
    bent = np.stack([_lowered(centre, limits, share) for share in shares])
    # as a change from bent[0], so that share 0 is exactly the stance
    angles = centre + (bent - bent[0] + np.pi) % (2 * np.pi) - np.pi
    inside = np.all((angles >= limits[:, 0] - 1e-9) & (angles <= limits[:, 1] + 1e-9), axis=1)
    deepest = depth if inside.all() else shares[np.argmin(inside) - 1]
    times, levels = [0.0], [0.0]
    down = True
    while times[-1] <= duration:
        level = deepest * (rng.uniform(0.5, 1) if down else rng.uniform(0, 0.2))
        times += [times[-1] + rng.uniform(*move)]
        times += [times[-1] + rng.uniform(*rest)]
        levels += [level, level]
        down = not down
    share = glide(t - t[0], np.array(times), np.array(levels))
    target = np.stack([np.interp(share, shares, column) for column in angles.T], axis=1)
    return always_on(np.clip(target, limits[:, 0], limits[:, 1]), "ground")


def _lowered(centre: np.ndarray, limits: np.ndarray, share: float) -> np.ndarray:
    """Return joint angles (J,) with hips lower by ``share`` of their height, the feet where they were; links of 1."""
    if len(centre) % 3:
        toward = np.where(limits[:, 1] - centre > centre - limits[:, 0], limits[:, 1], limits[:, 0])
        return centre + share * (toward - centre)
    angles = centre.reshape(-1, 3).copy()
    thigh, calf = angles[:, 1], angles[:, 2]
    x = np.sin(thigh) + np.sin(thigh + calf)
    z = (np.cos(thigh) + np.cos(thigh + calf)) * (1 - share)
    # law of cosines with two links of equal length; the knee keeps its side
    bend = np.where(calf > 0, 1.0, -1.0) * 2 * np.arccos(np.clip(np.hypot(x, z) / 2, 0, 1))
    angles[:, 1], angles[:, 2] = np.arctan2(x, z) - bend / 2, bend
    return angles.reshape(-1)


@excitation("drop", smooth=True)
def drop(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    height: PositiveRange = (0.02, 0.08),
) -> Motion:
    """Fall a few centimetres onto the feet with the stance held: compliance and damping of contact and legs.

    Args:
        t: when commands are sent (T,), s.
        centre: stance (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives the height of this fall.
        height: lowest and highest fall, m.

    Raises:
        ExcitationError: if ``centre`` lies outside ``limits``, or the fall would be higher than 0.2 m.
    """
    check(t, centre, limits)
    if height[1] > HIGHEST_DROP:
        raise ExcitationError(f"height[1] = {height[1]:g} m: falls stay below {HIGHEST_DROP:g} m, to spare the legs")
    return always_on(np.tile(centre, (len(t), 1)), "ground", float(rng.uniform(*height)))


HIGHEST_DROP = 0.2  # m (chosen): a stiff leg of a Go1 reaches its torque limit at much lower falls
