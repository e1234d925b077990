"""Makes the list of episodes to record from the user's settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field

from go1exp import robot
from go1exp.base import memory
from go1exp.base.wording import counted
from go1exp.config.schema.registry import STRICT, ConfigError, Gain, Positive, Term
from go1exp.logs.excitations import Motion
from go1exp.logs.record.sensors import SensorConfig

SOFT_LIMIT = 0.95  # share of the joint ranges that motions may use


MOTION_BYTES = 8 * (1 + robot.NUM_JOINTS)  # A row of a motion: its time, and the targets of all joints

ROW_BYTES = MOTION_BYTES + (4 + 8) * (4 * robot.NUM_JOINTS + 14)
"""Lower bound of a row of a recording: motion, what is true, what the logger writes (measured: 1400 B)."""


@dataclass(frozen=True)
class Episode:
    """One recording to make."""

    name: str  # unique in its set
    excitation: str  # name of the motion
    motion: Motion  # what to command, at the logger's rate
    kp: float  # position gain, N m/rad
    kd: float  # velocity gain, N m s/rad
    hang: tuple[float, float] | None  # roll and pitch at which a held trunk hangs, rad; None on the ground
    repeat_of: str | None  # name of the episode that this one repeats
    seed: int  # seed of the logger's noise


@dataclass(frozen=True)
class RecordingConfig:
    """Settings of a set of recordings.

    Attributes:
        gains: pairs of kp (N m/rad) and kd (N m s/rad); every motion is recorded with each pair.
        seconds: length of a recording, s.
        seeds: seeds of the motions; one recording of each.
        repeats: times that the first recording of each pair of gains is repeated under the same commands.
        support: suspended, ground, or auto, which is what the motion asks for and otherwise suspended.
        hang: pairs of roll and pitch of a suspended trunk, rad; every suspended motion is recorded at each.
        seed: seed of the logger's noise, of drawn effects and of a policy's commands.
        sensors: the logger.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    gains: tuple[tuple[Gain, Gain], ...]
    seconds: Positive
    seeds: tuple[Annotated[int, Field(ge=0)], ...]
    repeats: Annotated[int, Field(ge=0)]
    support: Literal["auto", "suspended", "ground"]
    hang: tuple[tuple[float, float], ...]
    seed: Annotated[int, Field(ge=0)]
    sensors: SensorConfig

    def empty(self) -> list[str]:
        """Return what is wrong with lists that are empty: nothing would be recorded."""
        lists = ("gains", "seeds", "hang")
        return [f"{name} = []: at least one is needed" for name in lists if not getattr(self, name)]


def make_motion(term: Term, seconds: float, rate_hz: float, seed: int) -> Motion:
    """Return an excitation's motion for the Go1 about its nominal stance; ConfigError if shorter than a sample."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    if not len(t):
        raise ConfigError([f"seconds = {seconds:g}: shorter than a sample of the motion at {rate_hz:g} Hz"])
    return term(t, robot.NOMINAL_STANCE.copy(), robot.soft_limits(SOFT_LIMIT), np.random.default_rng(seed))


def refuse_too_long(config: RecordingConfig, key: str, count: int, each: int = 1, others: int = 0) -> None:
    """Raise ConfigError if so many recordings do not fit into memory, by ``key`` if fewer of it would.

    Args:
        config: settings of the recordings.
        key: the setting that says how many recordings there are.
        count: its value.
        each: recordings for each of it.
        others: recordings that there are without it; if none, a recording is needed that ``key`` asks for.
    """
    recordings = others + each * count
    rate = config.sensors.rate_hz * ROW_BYTES  # B/s
    one = config.seconds * rate  # B, of a recording
    available = memory.free()
    if available is None or recordings * one <= available:
        return
    fitting = (int(available / one) - others) // each  # of the key
    made, much = counted(recordings, "recording"), memory.too_much(recordings * one, available)
    if fitting >= (0 if others else 1) and count > fitting:
        raise ConfigError([f"{key} = {count}: {made} of {config.seconds:g} s: it {much}; {fitting} at most would fit"])
    most = max(available / rate / recordings, 0.0)
    raise ConfigError([f"seconds = {config.seconds:g}: with {made} it {much}; {int(most)} s at most would fit"])


def episodes(terms: Sequence[Term], config: RecordingConfig) -> list[Episode]:
    """Return an episode for each combination of motion, seed, base and gain set, and then the repetitions.

    The first episode of each gain set is repeated. ConfigError if a motion cannot be made on the wanted base, two
    episodes would have one name, or so many do not fit into memory.
    """
    if terms:  # as many as there are at least: where a motion is suspended is not known yet
        sets = len(config.gains)
        refuse_too_long(config, "repeats", config.repeats, sets, sets * len(terms) * len(config.seeds))
    planned: list[Episode] = []
    for term in terms:
        for seed in config.seeds:
            motion = make_motion(term, config.seconds, config.sensors.rate_hz, seed)
            if config.support != "auto" and motion.support not in ("either", config.support):
                raise ConfigError([f"support = {config.support!r}: {term.key} is for a robot that is {motion.support}"])
            support = motion.support if config.support == "auto" else config.support
            for base in (None,) if support == "ground" else config.hang:
                for kp, kd in config.gains:
                    name = f"{term.key}_kp{kp:g}_kd{kd:g}_{seed}"
                    if base is not None and len(config.hang) > 1:
                        name += f"_roll{base[0]:g}_pitch{base[1]:g}"
                    planned.append(
                        Episode(name, term.entry.name, motion, kp, kd, base, None, _seed(config, len(planned)))
                    )
    twice = sorted({e.name for e in planned if [f.name for f in planned].count(e.name) > 1})
    if twice:
        raise ConfigError(
            [f"{name}: two recordings of this name; leave out one, or record them into two folders" for name in twice]
        )
    pairs = dict.fromkeys((e.kp, e.kd) for e in planned)
    firsts = [next(e for e in planned if (e.kp, e.kd) == gains) for gains in pairs]
    for e in firsts:
        for k in range(config.repeats):
            name = f"{e.name}_repeat{k + 1}"
            again = Episode(name, e.excitation, e.motion, e.kp, e.kd, e.hang, e.name, _seed(config, len(planned)))
            planned.append(again)
    return planned


def _seed(config: RecordingConfig, index: int) -> int:
    return int(np.random.SeedSequence([config.seed, index]).generate_state(1)[0])
