"""The protocols. Importing the package registers every kind, from this explicit list."""

from __future__ import annotations

from go1exp.protocol.kinds import sinusoid

__all__ = ["sinusoid"]
