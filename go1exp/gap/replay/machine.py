"""What the gap workflow must know of a robot to replay it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

import go1exp.actuator
import go1exp.effects  # noqa: F401  (registers every effect)
from go1exp.drive import DriveSetup
from go1exp.schema.registry import Term, bind


class Machine(Protocol):
    """A robot that can be replayed.

    One that is not driven by the ideal PD law has ``drive() -> Term`` beside; one whose nominal parameters are known
    worse or better than the effects declare has ``tolerances``, by (effect, parameter).
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Joints that move together, equally many in each group; groups do not feel each other."""

    @property
    def base_probe(self) -> tuple[float, ...]:
        """Changes of a free base's first state by which its influence is measured; empty for one that is held."""

    def build(self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int) -> tuple[Any, DriveSetup]:
        """Return a backend with ``num`` held robots, and their drives."""


def pd() -> Term:
    """Return the ideal PD law."""
    term = bind("actuator", "pd", {}, "pd")[0]
    assert term is not None
    return term


def drive_of(machine: Machine) -> Term:
    """Return what turns a machine's commands into torques: the ideal PD law unless it says otherwise."""
    own = getattr(machine, "drive", None)
    return pd() if own is None else own()


_TOLERANCES: ContextVar[Mapping[tuple[str, str], float]] = ContextVar("tolerances")


@contextmanager
def tolerances_of(machine: Machine) -> Iterator[None]:
    """Let a machine's own tolerances count wherever one is asked for within the block."""
    token = _TOLERANCES.set(getattr(machine, "tolerances", {}))
    try:
        yield
    finally:
        _TOLERANCES.reset(token)


def tolerance(effect: str, parameter: str, declared: float) -> float:
    """Return the tolerance of a parameter of the machine at hand, ``declared`` unless the machine has its own."""
    return _TOLERANCES.get({}).get((effect, parameter), declared)
