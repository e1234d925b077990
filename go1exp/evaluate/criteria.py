"""Acceptance criteria of a policy before it goes on a robot, and the verdicts of a report on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]  # one command of a report of ``rollout.evaluate``


def _forward(low: float, high: float) -> Callable[[Row], bool]:
    return lambda row: low <= row["command"][0] <= high and not any(row["command"][1:])


def _moving(row: Row) -> bool:
    return any(row["command"])


def _alone(axis: int, size: float) -> Callable[[Row], bool]:
    """Return whether a command is this one alone, in either direction."""
    others = [k for k in range(3) if k != axis]
    return lambda row: math.isclose(abs(row["command"][axis]), size) and not any(row["command"][k] for k in others)


def _slow(row: Row) -> bool:
    """Return whether one axis alone is commanded between 0.1 and 0.3, m/s or rad/s."""
    commanded = [abs(v) for v in row["command"] if v]
    return len(commanded) == 1 and 0.1 <= commanded[0] <= 0.3


def _measure(name: str) -> Callable[[Row], list[float | None]]:
    """Return a function that reads the mean of a measure, or those of its four feet."""

    def read(row: Row) -> list[float | None]:
        entry = (row.get("measures") or {}).get(name)
        if entry is None:
            return []
        return entry["mean"] if isinstance(entry["mean"], list) else [entry["mean"]]

    return read


def _rmse(*axes: str) -> Callable[[Row], list[float | None]]:
    return lambda row: [row["rmse"][axis] for axis in axes] if row["rmse"] else [None]


def _answer(row: Row) -> list[float | None]:
    """Return the velocity along the command over the command."""
    if not row["mean"]:
        return [None]
    reached = sum(c * v for c, v in zip(row["command"], row["mean"].values(), strict=True))
    return [reached / sum(c * c for c in row["command"])]


ROBOT = (
    "actuator=pd",
    "contact=elliptic",
    "effect=[coulomb,command_delay]",
    "effect.coulomb.bound=0.2",
    "effect.command_delay.delay=0.01",
)
"""Robot on which all policies are evaluated, as overrides of ``go1exp eval``, with ``noise=true randomize=true``."""


@dataclass(frozen=True)
class Criterion:
    """Limits of one figure, for every command that it is about, and for each foot or axis by itself."""

    name: str
    about: Callable[[Row], bool]
    read: Callable[[Row], list[float | None]]
    low: float = -math.inf
    high: float = math.inf


CRITERIA = (
    Criterion("trot error", _forward(0.5, 2.0), _measure("trot_error"), high=0.10),
    Criterion("load share", _moving, _measure("load_share"), low=0.15),
    Criterion("clearance", _forward(0.5, 2.0), _measure("clearance"), low=0.030),
    Criterion("stride rate", _forward(0.5, 2.0), _measure("stride_rate"), low=2.0, high=3.2),
    Criterion("touchdown speed", _forward(1.0, 1.0), _measure("touchdown_speed_p95"), high=1.0),
    Criterion("peak force", _forward(1.0, 1.0), _measure("peak_force_p95"), high=2.5),
    Criterion("slip", _moving, _measure("slip_share_all"), high=0.08),
    Criterion("RMSE xy", lambda row: math.hypot(*row["command"][:2]) <= 1.5, _rmse("x", "y"), high=0.08),
    Criterion("RMSE yaw", lambda row: True, _rmse("yaw"), high=0.10),
    Criterion("commanded 2.0 m/s", _forward(2.0, 2.0), _answer, low=0.95),
    Criterion("commanded 1.8 rad/s", _alone(2, 1.8), _answer, low=0.95),
    Criterion("commanded 3.0 m/s", _forward(3.0, 3.0), _answer, low=0.90),
    Criterion("commanded 0.1 to 0.3", _slow, _answer, low=0.70),
    Criterion("falls", lambda row: True, lambda row: [float(row["distinct_falls"]["count"])], high=0.0),
)
"""Chosen limits: m, m/s, rad/s, Hz, cycles, body weights, shares; of means over the robots of a command."""

LEAST_DELAY_MS = 30  # further command delay at which no robot may fall, ms


@dataclass(frozen=True)
class Verdict:
    """A criterion and a report: the worst value over commands, feet and axes, None if a robot never showed one."""

    name: str
    worst: float | None
    command: tuple[float, ...]
    met: bool


def evaluated(report: dict[str, Any]) -> list[Verdict]:
    """Return a verdict on each criterion that the report has a command and a figure for."""
    verdicts = []
    for criterion in CRITERIA:
        values = [
            (v, tuple(row["command"]))
            for row in report["commands"]
            if criterion.about(row)
            for v in criterion.read(row)
        ]
        if values:
            worst, command = max(values, key=lambda pair: _excess(criterion, pair[0]))
            verdicts.append(Verdict(criterion.name, worst, command, _excess(criterion, worst) <= 0.0))
    if "delay_margin" in report:
        ms = report["delay_margin"]["ms"]
        verdicts.append(Verdict("delay", ms, (), ms is not None and ms >= LEAST_DELAY_MS))
    return verdicts


def missed(report: dict[str, Any]) -> set[str]:
    """Return the names of the criteria that the report does not meet."""
    return {verdict.name for verdict in evaluated(report) if not verdict.met}


def _excess(criterion: Criterion, value: float | None) -> float:
    """Return by how much a value lies outside the limits; infinite without one."""
    return math.inf if value is None else max(criterion.low - value, value - criterion.high)
