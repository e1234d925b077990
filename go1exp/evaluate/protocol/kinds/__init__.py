"""The protocols. Importing the package registers every kind, from this explicit list."""

from __future__ import annotations

from go1exp.evaluate.protocol.kinds import energy, gait, kicks, push_map, rate, sinusoid, steady, terrain

__all__ = ["energy", "gait", "kicks", "push_map", "rate", "sinusoid", "steady", "terrain"]
