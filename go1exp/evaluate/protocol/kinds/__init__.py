"""The protocols. Importing the package registers every kind, from this explicit list."""

from go1exp.evaluate.protocol.kinds import (
    corners,
    energy,
    gait,
    hardware,
    kicks,
    push_map,
    rate,
    recover,
    robogauge,
    sinusoid,
    terrain,
)

__all__ = [
    "corners",
    "energy",
    "gait",
    "hardware",
    "kicks",
    "push_map",
    "rate",
    "recover",
    "robogauge",
    "sinusoid",
    "terrain",
]
