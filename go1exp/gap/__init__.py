"""Find where simulation and measurement disagree, and name the effect that is missing.

The public face: :func:`explain` names what is missing, :func:`check` takes a first look, :func:`compare` prepares
recordings for either, and ``apply`` writes an answer for training and proves it there. Names are imported when they are
first used, since most of them need the physics engine.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "explain": "stages.explain",
    "check": "stages.explain",
    "compare": "comparison",
    "apply": "stages",
    "Comparison": "comparison",
    "NotComparable": "comparison",
    "robot_of": "robots.fixed_base",
    "GapResult": "result",
    "GapSettings": "result",
}
"""Public name -> module of this package that has it."""

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "apply":
        return import_module(f"{__name__}.stages.apply")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
