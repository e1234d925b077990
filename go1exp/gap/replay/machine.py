"""What the gap workflow must know of a robot to replay it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import go1exp.actuator
import go1exp.effects  # noqa: F401  (registers every effect)
from go1exp.drive import DriveSetup
from go1exp.effects.tolerances import Tolerances
from go1exp.schema.registry import Term, bind


class Machine(Protocol):
    """A robot that can be replayed.

    One that is not driven by the ideal PD law has ``drive() -> Term`` beside.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Joints that move together, equally many in each group; groups do not feel each other."""

    @property
    def tolerances(self) -> Tolerances:
        """How far the nominal parameters may be off."""

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
