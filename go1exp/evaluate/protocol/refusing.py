"""Refuses protocols that are too long for the memory, or too short, before anything is played."""

from __future__ import annotations

import math

from go1exp.base import memory
from go1exp.base.wording import counted
from go1exp.config.schema.registry import ConfigError, TooLongError
from go1exp.evaluate.protocol.base import Chosen
from go1exp.evaluate.protocol.lengths import Length
from go1exp.evaluate.protocol.stage import Stage


def refuse(chosen: Chosen, stage: Stage) -> None:
    """Refuse a protocol that is too long or too short to be played, before anything of its size is made.

    Raises:
        ConfigError: if no step of the policy is left that counts; names the setting.
        TooLongError: if it does not fit into memory.
    """
    _refuse_too_long(chosen, stage)
    for length in chosen.protocol.lengths():
        dt = length.policy_dt or stage.policy_dt
        if stage.steps(length.seconds, dt) <= stage.steps(length.settle_s, dt):
            cause = length.causes[0]
            left = f"of these {length.seconds:g} s no step of the policy ({dt:g} s) is left"
            after = f" after the first {length.settle_s:g} s" if length.settle_s else ""
            raise ConfigError([f"protocol.{chosen.key}.{cause.key} = {cause.value:g}: {left}{after}"])


def _refuse_too_long(chosen: Chosen, stage: Stage) -> None:
    """Refuse a protocol whose robots do not fit into memory, before anything of that size is made.

    What fails for certain is refused, nothing else.

    Raises:
        TooLongError: names the setting, and the largest value of it that would fit.
    """
    available, lengths = memory.free(), chosen.protocol.lengths()
    if available is None or not lengths:
        return
    length = max(lengths, key=lambda one: _needed(one, stage))  # what mends the largest batch mends the others
    if (needed := _needed(length, stage)) > available:
        plain, recorded = stage.bytes_per_second(length)
        fitting = available / plain
        if length.recorded and length.settle_s < fitting:
            fitting = (available + length.settle_s * recorded) / (plain + recorded)
        raise TooLongError([_problem(chosen, length, needed, available, fitting)])


def _needed(length: Length, stage: Stage) -> float:
    """Return what a batch takes at least, B."""
    plain, recorded = stage.bytes_per_second(length)
    listening = max(length.seconds - length.settle_s, 0.0) if length.recorded else 0.0
    return length.seconds * plain + listening * recorded


def _problem(chosen: Chosen, length: Length, needed: float, available: float, fitting: float) -> str:
    """Word that a length needs too much: of the first setting that alone can mend it, or of all where none can."""
    path, robots = f"protocol.{chosen.key}", chosen.protocol.robots
    amounts = memory.too_much(needed, available)
    what = f"to play {length.seconds:g} s with {counted(length.robots, 'robot')} {amounts}"
    for cause in length.causes:
        if limit := cause.limit(fitting):
            return f"{path}.{cause.key} = {cause.value:g}: {what}; {limit} would fit"
    fewer = math.floor(robots * available / needed)
    if fewer:
        return f"{path}.robots = {robots}: {what}; {fewer} at most would fit"
    given = ", ".join(f"{cause.key} = {cause.value:g}" for cause in length.causes)
    return f"{path}: {given}, robots = {robots}: {what}; {0.994 * fitting:.3g} s at most would fit"
