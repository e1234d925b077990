"""Smooth motions over a range of frequencies and speeds. All except the gait need a suspended robot.

Joints differ in phase, frequency and level, so that forces between joints are identifiable.
"""

from __future__ import annotations

import numpy as np

from go1exp.config.schema.registry import Annotated, Field, Fraction, NonNegative, Positive, PositiveRange, excitation
from go1exp.logs.excitations.motion import Motion, PerKind, always_on, check, ease, swing

Lines = Annotated[int, Field(ge=1, le=64)]
"""Number of sines in a sum."""


@excitation("chirp", smooth=True)
def chirp(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    band: PositiveRange = (0.1, 10.0),
    amplitude: PerKind = (0.3, 0.4, 0.4),
    speed: Positive = 8.0,
    fade: Positive = 1.0,
) -> Motion:
    """Sweep the frequency up, logarithmically: inertia, damping, delay and lag each act in a part of the band.

    0.1 to 10 Hz over 20 s at low gains is the sweep of PACE (arXiv 2509.06342). Joints differ in phase and a
    little in frequency.

    Args:
        t: when commands are sent (T,), s.
        centre: angles to swing about (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives the phases, and first and last frequency of each joint.
        band: first and last frequency, Hz.
        amplitude: swing to each side at low frequency, rad, per kind of joint.
        speed: highest target speed, rad/s; the amplitude falls as the frequency grows, to stay below it.
        fade: time over which the swing grows from nothing, s.

    Raises:
        ExcitationError: if the command rate cannot carry the band, or ``centre`` lies outside ``limits``.
    """
    from scipy import signal  # slow to import, and settings are checked first

    duration = check(t, centre, limits, band[1]) or 1.0
    joints = len(centre)
    octaves = np.log(band[1] / band[0])
    first = band[0] * np.exp(octaves * rng.uniform(0, SWEEP_SPREAD, joints))
    last = band[1] * np.exp(-octaves * rng.uniform(0, SWEEP_SPREAD, joints))
    phase = rng.uniform(0, 360, joints)
    time = t - t[0]
    wave = [
        signal.chirp(time, f, duration, g, "logarithmic", phi) for f, g, phi in zip(first, last, phase, strict=True)
    ]
    fastest = 2 * np.pi * first * (last / first) ** (time[:, None] / duration) * np.resize(amplitude, joints)
    wave_in_reach = np.stack(wave, axis=1) / np.hypot(1, fastest / speed)
    return always_on(swing(t, wave_in_reach, amplitude, centre, limits, fade), "suspended")


SWEEP_SPREAD = 0.04
"""Sweeps begin and end up to this share of the (logarithmic) band inside it, so that phases between joints change."""


@excitation("multisine", smooth=True)
def multisine(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    band: PositiveRange = (0.15, 8.0),
    lines: Lines = 10,
    corner: Positive = 1.5,
    amplitude: PerKind = (0.3, 0.4, 0.4),
    fade: Positive = 1.0,
) -> Motion:
    """Add sines of many frequencies at once: the whole band in every window; each joint has different lines.

    No line is near 2 to 5 times another of the same joint, so that the harmonics of friction and saturation do not
    coincide with a line. Phases are the best of eight random draws (Schroeder's rule needs evenly spaced lines).

    Args:
        t: when commands are sent (T,), s.
        centre: angles to swing about (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives frequencies and phases.
        band: lowest and highest frequency, Hz.
        lines: number of sines per joint.
        corner: lines above this frequency have equal amplitude of speed, those below equal amplitude of angle, Hz.
        amplitude: largest swing to each side, rad, per kind of joint.
        fade: time over which the swing grows from nothing, s.

    Raises:
        ExcitationError: if the command rate cannot carry the band, or ``centre`` lies outside ``limits``.
    """
    check(t, centre, limits, band[1])
    wave = np.empty((len(t), len(centre)))
    for joint in range(len(centre)):
        frequency = _spaced_lines(rng, band, lines)
        weight = 1 / np.hypot(1, frequency / corner)
        sines = 2 * np.pi * np.outer(t - t[0], frequency)
        draws = [(sines + rng.uniform(0, 2 * np.pi, lines)) for _ in range(8)]
        sums = [np.sin(angle) @ weight for angle in draws]
        # the lowest crest factor: the most energy within a given range of angles
        best = min(sums, key=lambda x: float(np.max(np.abs(x))))
        wave[:, joint] = best / np.max(np.abs(best))
    return always_on(swing(t, wave, amplitude, centre, limits, fade), "suspended")


def _spaced_lines(rng: np.random.Generator, band: tuple[float, float], lines: int) -> np.ndarray:
    """Draw one frequency from each of ``lines`` equal parts (in octaves) of ``band``, apart from low multiples, Hz."""
    edges = np.geomspace(*band, lines + 1)
    chosen = np.empty(lines)
    for k in range(lines):
        draws = np.exp(rng.uniform(np.log(edges[k]), np.log(edges[k + 1]), 64))
        ratio = draws[:, None, None] / chosen[None, :k, None]
        distance = np.abs(ratio / np.arange(2, 6) - 1).reshape(64, -1).min(axis=1, initial=1.0)
        chosen[k] = draws[np.argmax(distance > 0.05) if np.any(distance > 0.05) else np.argmax(distance)]
    return chosen


@excitation("slow_ramps")
def slow_ramps(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    amplitude: PerKind = (0.3, 0.4, 0.4),
    speed: Positive = 0.2,
    slowest: Fraction = 0.3,
    hold: NonNegative = 0.8,
) -> Motion:
    """Creep up and down, turn back early and rest: dry friction, stiction, backlash and static errors.

    Args:
        t: when commands are sent (T,), s.
        centre: angles to move about (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives turning points, speeds and rests.
        amplitude: farthest turning point to each side, rad, per kind of joint; nearest is a third of it.
        speed: highest speed, rad/s.
        slowest: lowest speed as a share of ``speed``.
        hold: longest rest, s; half of the turns rest.

    Raises:
        ExcitationError: if ``centre`` lies outside ``limits``.
    """
    duration = check(t, centre, limits)
    target = np.empty((len(t), len(centre)))
    amplitudes = np.resize(amplitude, len(centre))
    for joint in range(len(centre)):
        down, up = np.minimum(amplitudes[joint], np.abs(limits[joint] - centre[joint]))
        times, levels = [0.0], [float(centre[joint])]
        side = rng.choice((-1.0, 1.0))
        while times[-1] <= duration:
            reach = rng.uniform(1 / 3, 1) * (up if side > 0 else down)
            level = float(centre[joint] + side * reach)
            pace = speed * rng.uniform(max(slowest, 1e-3), 1)
            rest = rng.uniform(0, hold) if rng.uniform() < 0.5 else 0.0
            times += [times[-1] + max(abs(level - levels[-1]) / pace, 1e-3)]
            times += [times[-1] + rest + 1e-3]  # a rest of 1 ms where there is none keeps the times apart
            levels += [level, level]
            side = -side
        target[:, joint] = np.interp(t - t[0], times, levels)
    return always_on(np.clip(target, limits[:, 0], limits[:, 1]), "suspended")


@excitation("gait", smooth=True)
def gait(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    stride_hz: Positive = 2.5,
    stride: Positive = 0.25,
    lift: Positive = 0.5,
    sway: NonNegative = 0.06,
    fade: Positive = 1.0,
) -> Motion:
    """Trot: feet go back on the ground and forward in the air, diagonal legs together, strides of changing length.

    Joints count in threes (hip, thigh, calf), limbs in the order FR, FL, RR, RL. The foot goes back while the thigh
    angle grows, as on the Go1; the calf bends towards the side where it has more room.

    Args:
        t: when commands are sent (T,), s.
        centre: stance (J,), rad.
        limits: lowest and highest target (J, 2), rad.
        rng: gives the phase at the start, small phases between the joints, and the lengths of the strides.
        stride_hz: steps of one leg per second.
        stride: longest swing of a thigh to each side, rad.
        lift: bend of a calf at mid-swing, rad.
        sway: swing of a hip to each side, rad.
        fade: time over which the gait grows out of the stance, s.

    Raises:
        ExcitationError: if the command rate cannot carry the gait, or ``centre`` lies outside ``limits``.
    """
    check(t, centre, limits, 3 * stride_hz)  # the lifted calf has lines up to there
    joint = np.arange(len(centre))
    kind, limb = joint % 3, joint // 3
    opposite = np.array([0.0, 0.5, 0.5, 0.0])[limb % 4]  # of a cycle
    time = t - t[0]
    slow, start = rng.uniform(0.15, 0.5, len(centre)), rng.uniform(0, 2 * np.pi, len(centre))  # Hz, rad
    length = 0.75 + 0.25 * np.sin(2 * np.pi * np.outer(time, slow) + start)
    cycle = (stride_hz * time + rng.uniform())[:, None] + opposite + rng.uniform(-0.03, 0.03, len(centre))
    angle = 2 * np.pi * cycle
    in_air = np.sin(angle) < 0
    bend = np.where(limits[:, 1] - centre > centre - limits[:, 0], 1.0, -1.0)
    shapes = np.stack([sway * np.sin(angle), -stride * np.cos(angle), lift * bend * np.sin(angle) ** 2 * in_air])
    excursion = length * shapes[kind, :, joint].T
    reach = np.maximum(np.abs(excursion).max(axis=0), 1e-9)
    toward = np.where(excursion > 0, limits[:, 1] - centre, centre - limits[:, 0]).min(axis=0)
    fit = np.minimum(1, toward / reach)
    target = centre + ease(time / fade)[:, None] * fit * excursion
    return always_on(np.clip(target, limits[:, 0], limits[:, 1]), "either")
