"""The protocols. Importing the package registers every kind, from this explicit list."""

from go1exp.evaluate.protocol.kinds import (  # noqa: F401
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
