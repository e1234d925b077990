"""Find where simulation and measurement disagree, and name the effect that is missing."""

from go1exp.gap.explain import explain
from go1exp.gap.result import EXIT_CODES, Candidate, Floors, GapResult, GapSettings, Localisation, NamedEffect, Overlay

__all__ = [
    "EXIT_CODES",
    "Candidate",
    "Floors",
    "GapResult",
    "GapSettings",
    "Localisation",
    "NamedEffect",
    "Overlay",
    "explain",
]
