"""Velocity and position of a legged robot's trunk from its IMU, joints and contacts: a Kalman filter in C++.

``make_filter(go1())`` gives the compiled filter; ``sample`` builds its input. The runtime on the robot uses this
package, so it imports nothing but NumPy and pydantic.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from go1exp.config.schema.registry import Expected
from go1exp.deploy.estimation import readings
from go1exp.deploy.estimation.config import ChainLeg, FilterConfig, from_json, go1, load, scaler, to_json
from go1exp.deploy.estimation.readings import WIDTH, Status, sample
from go1exp.robot import GRAVITY

if TYPE_CHECKING:
    from types import ModuleType

    from go1exp.deploy.estimation import _kalman

__all__ = ["GRAVITY", "WIDTH", "EstimatorError", "FilterConfig", "Filters", "Status", "from_json", "go1", "load"]
__all__ += ["make_filter", "sample", "scaler", "to_json"]

SOURCES = ("force", "torque", "height")
"""The order of ``Source`` in ``cpp/kalman.hpp``."""


class EstimatorError(Expected):
    """The compiled filter is missing or cannot be loaded."""


def compiled() -> ModuleType:
    """Return the compiled module; raise EstimatorError if it was not built, or was built for another Python."""
    try:
        return importlib.import_module("go1exp.deploy.estimation._kalman")
    except ImportError as error:
        folder = Path(__file__).parent
        built = [f.name for f in sorted(folder.glob("_kalman.*")) if f.suffix in (".so", ".pyd", ".dylib")]
        why = f"{', '.join(built)} does not load: {error}" if built else f"no _kalman extension in {folder.name}/"
        raise EstimatorError(
            f"the Kalman filter is not built for this Python ({why}). Install a C++17 compiler (Debian: g++ and "
            "python3-dev), then `make setup`, or `pip install -e .` in the checkout; its build brings pybind11 and "
            "Eigen (cmeel-eigen) with it"
        ) from error


def make_filter(config: FilterConfig) -> _kalman.Filter:
    """Return the compiled filter with these settings, not yet started.

    Raises:
        EstimatorError: if the extension is missing.
    """
    settings = compiled().Settings()
    values = {name: getattr(config, name) for name in FilterConfig.__dataclass_fields__}
    values |= {"legs": compiled_legs(config), "contact_source": SOURCES.index(config.contact_source)}
    for name, value in values.items():
        setattr(settings, name, value)
    return compiled().Filter(settings)


def compiled_legs(config: FilterConfig) -> list[_kalman.Leg]:
    """Return the compiled legs; ``foot(q)`` returns position (3,), m, Jacobian (3, 3), m/rad, and ``turning`` (3, 3).

    ``turning`` maps joint velocities to the angular velocity of the foot's link relative to the trunk.

    Raises:
        EstimatorError: if the extension is missing.
    """
    make = compiled().Leg
    return [
        make.chain(leg.hip, leg.lengths)
        if isinstance(leg, ChainLeg)
        else make.polynomial(leg.centre, leg.scale, np.array([leg.x, leg.y, leg.z]))
        for leg in config.legs
    ]


COLUMNS = {name: getattr(readings, name.upper()) for name in ("quat", "gyro", "acc", "q", "qd", "foot_force")}
"""Names of readings and their columns in a sample."""


class Filters:
    """Filters with the settings of the Go1, updated together."""

    def __init__(self, count: int) -> None:
        """Make ``count`` filters; raise EstimatorError if the filter is not built."""
        self._filters = [make_filter(go1()) for _ in range(count)]

    def update(self, t: float, measured: Mapping[str, np.ndarray]) -> None:
        """Update with one sample of every robot: time, s, and readings (N, ...) by the names of ``COLUMNS``."""
        rows = np.full((len(self._filters), WIDTH), np.nan)
        rows[:, readings.T] = t
        for name, columns in COLUMNS.items():
            rows[:, columns] = measured[name]
        for one, row in zip(self._filters, rows, strict=True):
            one.update(row)

    def restart(self, robot: int) -> None:
        """Initialise one robot's filter with its next sample."""
        self._filters[robot].reset()

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) velocities of the trunks in their own frames, m/s; zero before the first sample."""
        return np.array([one.velocity_b if one.running else np.zeros(3) for one in self._filters])
