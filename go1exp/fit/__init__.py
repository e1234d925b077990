"""Actuator nets: what a drive makes of a command, learnt from recordings. ``fit`` is the way in."""

from __future__ import annotations

from go1exp.fit.fitting import FitResult, fit
from go1exp.fit.net import ActuatorNet, NetFileError, load
from go1exp.fit.plots import plot
from go1exp.fit.report import Report, text
from go1exp.fit.settings import FitError, FitSettings
from go1exp.fit.smoothing import SmoothMotion, smooth_motion

__all__ = [
    "ActuatorNet",
    "FitError",
    "FitResult",
    "FitSettings",
    "NetFileError",
    "Report",
    "SmoothMotion",
    "fit",
    "load",
    "plot",
    "smooth_motion",
    "text",
]
