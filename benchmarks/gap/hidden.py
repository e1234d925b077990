"""The robots that ``benchmarks/closed_loop.py`` hides, and their recordings: suspended, and standing.

Every one is also a little wrong everywhere, within the tolerances (``cases.background``).
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.gap import cases, logger
from benchmarks.gap.motions import RATE
from benchmarks.gap.simulate import Episode, simulate
from benchmarks.gap.truth import Truth, apply
from benchmarks.gap.walking import KD, KP, PERIOD, Ground, Policy, follow, recorded, squat, walk
from go1exp import robot
from go1exp.logs.recording import Recording

HUNG_DT, WALK_DT = 2.5e-4, 5e-4
"""Steps of the physics of suspended and of walking robots, s; an error at half of the latter is the same within 1 %."""

HUNG_GAINS = ((KP, KD), (35.0, 1.2), (KP, KD), (35.0, 0.6))
"""Of suspended robots, one recording after the other."""

FOR_NETS = ("chirp", "steps", "gait", "chirp", "steps", "gait", "ramps")
"""Motions of the recordings for a net, the drives always on."""

STANDING_GAINS = (35.0, 0.6)
"""Gains of a robot that squats, N m/rad and N m s/rad."""

REPORTED = 0.1
"""Standard deviation of the torque that these robots report, N m: a net is fitted to it."""

EVERY = tuple(range(robot.NUM_JOINTS))
CALVES = EVERY[2::3]


@dataclass(frozen=True)
class Secret:
    """What one robot hides.

    Attributes:
        about: it, in words, for the table.
        effects: names of ``known.LIBRARY`` with their values.
        joints: at which.
        payload: kg.
        ground: what it walks on; None for the nominal ground.
        outside: an effect beyond the library with its parameters, at all joints.
    """

    about: str
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    joints: tuple[int, ...] = EVERY
    payload: float = 0.0
    ground: Ground | None = None
    outside: dict[str, dict[str, float]] = field(default_factory=dict)


SECRETS = {
    "friction": Secret("dry friction 0.8 N m", {"coulomb": {"bound": 0.8}}),
    "late": Secret("torque 12 ms late", {"torque_delay": {"delay": 0.012}}),
    "weak": Secret("drives at 60 %", {"strength": {"scale": 0.6}}),
    "weak_calves": Secret("calves at 50 %", {"strength": {"scale": 0.5}}, CALVES),
    "lag": Secret("torque follows in 15 ms", {"lag": {"time": 0.015}}),
    "payload": Secret("5 kg on the trunk", payload=5.0),
    "soft_ground": Secret("feet of 0.1 s on the ground", ground=Ground(time_constant=0.1)),
    "friction_weak": Secret(
        "dry friction 0.6 N m, drives at 75 %", {"coulomb": {"bound": 0.6}, "strength": {"scale": 0.75}}
    ),
    "friction_late": Secret(
        "dry friction 0.5 N m, torque 8 ms late", {"coulomb": {"bound": 0.5}, "torque_delay": {"delay": 0.008}}
    ),
    "outside": Secret("position error 20 ms late, not in the library", outside={"delayed_error": {"delay": 0.02}}),
}
"""Name in tables -> what it hides. All sizes are chosen so that they spoil the walk clearly."""


@dataclass(frozen=True)
class Hidden:
    """A robot to record and to walk with.

    Attributes:
        truth: the robot.
        ground: under it.
        on: (J,) joints on which effects beyond the library act.
    """

    truth: Truth
    ground: Ground
    on: np.ndarray


def nominal(ground: Ground) -> Hidden:
    """Return the robot of which the model is right."""
    return Hidden(Truth(), ground, np.zeros(robot.NUM_JOINTS, dtype=bool))


def make(name: str, seed: int, ground: Ground) -> Hidden:
    """Return a robot of ``SECRETS``; the same seed gives the same one, whatever others there are."""
    secret, truth = SECRETS[name], Truth()
    cases.background(truth, _rng(name, seed, 0), None)
    joints = np.array(secret.joints)
    for effect, values in secret.effects.items():
        apply(truth, effect, {key: np.full(len(joints), value) for key, value in values.items()}, joints)
    truth.payload = secret.payload
    truth.outside |= secret.outside
    return Hidden(truth, secret.ground or ground, np.full(robot.NUM_JOINTS, bool(secret.outside)))


def record_hung(hidden: Hidden, name: str, seed: int, count: int, seconds: float) -> list[Recording]:
    """Return ``count`` recordings of the suspended robot, the last one a repetition of another."""
    rng = _rng(name, seed, 1)
    drawn = cases.experiment(cases.EVERYTHING, count, seconds, rng)
    gains = {e.name: HUNG_GAINS[k % len(HUNG_GAINS)] for k, e in enumerate(drawn)}
    return _hung(hidden, [_with_gains(e, *gains[e.repeat_of or e.name]) for e in drawn], rng)


def record_for_net(hidden: Hidden, name: str, seed: int, count: int, seconds: float) -> list[Recording]:
    """Return ``count`` more recordings of the suspended robot, all different and with the gains of the walk."""
    rng = _rng(name, seed, 3)
    drawn = cases.experiment(FOR_NETS, count + 1, seconds, rng)
    return _hung(hidden, [_with_gains(e, KP, KD) for e in drawn[:-1]], rng)


def _with_gains(episode: Episode, kp: float, kd: float) -> Episode:
    return dataclasses.replace(episode, kp=kp, kd=kd)


def _hung(hidden: Hidden, episodes: Sequence[Episode], rng: np.random.Generator) -> list[Recording]:
    samples = simulate(hidden.truth, episodes, HUNG_DT, rng, hidden.on)
    writer = _logger(rng)
    return [
        Recording(logger.meta(e), logger.log(writer, samples, k, e.target, e.on, rng)) for k, e in enumerate(episodes)
    ]


def record_ground(
    hidden: Hidden, name: str, seed: int, count: int, seconds: float, policy: Policy, commands: np.ndarray
) -> list[Recording]:
    """Return ``count`` recordings of squats, and one of a walk for each of ``commands`` (N, 3), up to a fall."""
    rng = _rng(name, seed, 2)
    t = np.arange(round(seconds * RATE)) / RATE
    targets = np.stack([squat(t, rng) for _ in range(count)], axis=1)
    squats = follow(hidden.truth, hidden.ground, targets, [STANDING_GAINS] * count, HUNG_DT, rng, hidden.on)
    walked = walk(hidden.truth, hidden.ground, policy, commands, seconds, HUNG_DT, rng, hidden.on, keep=True)
    assert walked.rows is not None
    writer = _logger(rng)
    ends = walked.fell * round(PERIOD * RATE)
    made = [
        recorded(squats, k, len(t), writer, logger.described(f"squat_{k}", "squat", STANDING_GAINS, None), rng)
        for k in range(count)
    ]
    return made + [
        recorded(walked.rows, k, int(end), writer, logger.described(f"walk_{k}", "policy", (KP, KD), None), rng)
        for k, end in enumerate(ends)
        if end >= RATE  # less than a second tells nothing
    ]


def evaluated(
    hidden: Hidden, policy: Policy, commands: Sequence[tuple[float, float, float]], n: int, seconds: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tracking error (C n,) of ``n`` walks with each of C commands, m/s, and whether the robot fell.

    First poses, noise and commands are those of the seed, whatever robot and policy. The error is the RMS of what the
    trunk's velocity misses, after ``SETTLED``; the yaw rate counts by the speed of a point ``LEVER`` from the centre. A
    robot that has fallen lies still: from there on it misses its whole command.
    """
    command = np.repeat(np.array(commands, dtype=float), n, axis=0)
    rng = np.random.default_rng([seed, 3])
    walked = walk(hidden.truth, hidden.ground, policy, command, seconds, WALK_DT, rng, hidden.on)
    steps = len(walked.velocity)
    lying = np.arange(steps)[:, None] >= walked.fell
    velocity = np.where(lying[..., None], 0.0, walked.velocity)
    missed = ((velocity - command) * (1.0, 1.0, LEVER))[round(SETTLED / PERIOD) :]
    return np.sqrt((missed**2).sum(axis=-1).mean(axis=0)), walked.fell < steps


LEVER = 0.25
"""m; about from the trunk's centre to a foot."""

SETTLED = 1.0
"""s, from a stand to the commanded velocity."""


def _rng(name: str, seed: int, part: int) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode()), part])


def _logger(rng: np.random.Generator) -> logger.Logger:
    return dataclasses.replace(logger.draw(rng), torque_noise=REPORTED)
