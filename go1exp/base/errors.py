"""Failures that are answers, for every layer: also for the runtime on the robot, which loads nothing but NumPy."""

from __future__ import annotations


class Expected(RuntimeError):
    """Base of failures whose message says all there is to say; the command line prints it without a traceback."""
