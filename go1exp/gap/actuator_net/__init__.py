"""Actuator nets: what an actuator makes of a command, learnt from recordings. ``fit`` is the way in.

Names are loaded at their first use: settings are checked before torch and SciPy are imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from go1exp.gap.actuator_net.dataset import SmoothMotion, smooth_motion
    from go1exp.gap.actuator_net.fitting import FitResult, fit
    from go1exp.gap.actuator_net.plots import plot
    from go1exp.gap.actuator_net.report import Report, text
    from go1exp.gap.actuator_net.settings import FitError, FitSettings

__all__ = [
    "FitError",
    "FitResult",
    "FitSettings",
    "Report",
    "SmoothMotion",
    "fit",
    "plot",
    "smooth_motion",
    "text",
]

_MODULES = {
    **dict.fromkeys(("FitResult", "fit"), "fitting"),
    "plot": "plots",
    **dict.fromkeys(("Report", "text"), "report"),
    **dict.fromkeys(("FitError", "FitSettings"), "settings"),
    **dict.fromkeys(("SmoothMotion", "smooth_motion"), "dataset"),
}
"""Name -> module of this package that defines it."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
