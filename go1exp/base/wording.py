"""Words that messages of all layers share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

Start = Literal["standing", "lying", "crouched", "sitting", "suspended"]
"""Initial pose of the simulated robot: in the nominal stance, on its belly, ..., or held above the ground."""

NOT_FOR_TRAINING = "Not for training."
"""How a file of effects says on its first line that training should not take it."""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 row``, ``2 rows``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Sequence[str], most: int = 3) -> str:
    """Return the first ``most`` names, and how many more there are."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
