"""An evaluation report as a table."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from go1exp.evaluate.bars import Verdict, judged
from go1exp.evaluate.rollout import AXES

HEADER = ("command x, y, yaw", "mean x, y, yaw", "RMSE x, y, yaw", "falls", "mean time s")

Show = Callable[[dict[str, Any]], str]
"""Writes one cell from the ``measures`` of a command."""


def _numbers(name: str, form: str, factor: float = 1.0) -> Show:
    """Return what writes the mean of a measure, or those of the four feet."""

    def show(measures: dict[str, Any]) -> str:
        entry = measures.get(name)
        if entry is None:
            return "-"
        means = entry["mean"] if isinstance(entry["mean"], list) else [entry["mean"]]
        if all(m is None for m in means):
            return "-"
        return " ".join("-" if m is None else format(factor * m, form) for m in means)

    return show


def _phases(measures: dict[str, Any]) -> str:
    """Write the phases of FL, RR and RL; that of FR is 0."""
    return " ".join(_numbers("touchdown_phase", ".2f")(measures).split(" ")[1:]) or "-"


def _gait(measures: dict[str, Any]) -> str:
    """Write the gait of most robots."""
    return next(iter(measures.get("gait") or {}), "-")


GAIT: dict[str, Show] = {
    "gait": _gait,
    "error": _numbers("trot_error", ".2f"),
    "Hz": _numbers("stride_rate", ".1f"),
    "phase FL RR RL": _phases,
    "duty FR FL RR RL": _numbers("duty_factor", ".2f"),
    "fly %": _numbers("flight_share", ".0f", 100.0),
    "clearance mm": _numbers("clearance", ".0f", 1000.0),
    "height m": _numbers("trunk_height", ".3f"),
    "pitch deg": _numbers("trunk_pitch", "+.1f", 180.0 / math.pi),
}
"""Columns of the table of gait figures."""

CONTACT: dict[str, Show] = {
    "heave m/s": _numbers("heave", ".2f"),
    "load % FR FL RR RL": _numbers("load_share", ".0f", 100.0),
    "slip %": _numbers("slip_share_all", ".0f", 100.0),
    "touchdown m/s": _numbers("touchdown_speed_p95", ".2f"),
    "peak BW": _numbers("peak_force_p95", ".1f"),
    "step rad": _numbers("target_step_p99", ".2f"),
    "tau %": _numbers("torque_share_p99", ".0f", 100.0),
    "qd %": _numbers("joint_speed_share_p99", ".0f", 100.0),
    "line %": _numbers("envelope_share_p99", ".0f", 100.0),
    "CoT": _numbers("cost_of_transport", ".2f"),
}
"""Columns of the table of contacts and effort."""

LEGEND = """error: of the touchdowns to a trot's, phase: after FR, both in cycles; feet: FR FL RR RL; pitch: nose down;
touchdown and peak (body weights): 95th percentile; step of the target in 20 ms; tau, qd, line: share of peak torque,
top speed and the motors' torque-speed line; step, tau, qd and line: 99th percentile; CoT: positive work / (m g way).
Means over n robots; the JSON has intervals and all measures."""


def _triple(values: Any) -> str:
    return ", ".join(f"{v:+.2f}" for v in values)


def rows(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return one row of text per command of a report of ``rollout.evaluate``."""
    lines: list[tuple[str, ...]] = []
    for c in report["commands"]:
        mean = _triple(c["mean"][a] for a in AXES) if c["mean"] else "-"
        rmse = ", ".join(f"{c['rmse'][a]:.2f}" for a in AXES) if c["rmse"] else "-"
        lines.append((_triple(c["command"]), mean, rmse, f"{c['falls']}/{c['episodes']}", f"{c['mean_time_s']:.1f}"))
    return lines


def _summary(report: dict[str, Any]) -> str:
    policy, settings = report["policy"], report["settings"]
    on = [name for name in ("noise", "randomize", "push", "train_ground") if settings[name]]
    rmse = ", ".join(f"{axis} {report['rmse'][axis]:.3f}" for axis in AXES) if report["rmse"] else "-"
    other = policy.get("controller")
    who = f"controller {other['name']}" if other else f"policy after {policy['num_timesteps'] / 1e6:.2f} M steps"
    return (
        f"{who}; RMSE over all: {rmse}; "
        f"falls {report['falls']} in {report['episodes']} episodes of {settings['duration_s']:g} s; "
        f"with {', '.join(on) if on else 'no noise, randomisation or pushes, on flat ground'}"
        + (f"; moved by {settings['engine']['name']}" if report.get("agreement") else "")
    )


def _laid(lines: list[tuple[str, ...]]) -> list[str]:
    """Lay cells out in columns."""
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return ["  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)) for line in lines]


def _short(command: Any) -> str:
    return " ".join(f"{v:+.1f}" if abs(10 * v - round(10 * v)) < 1e-9 else f"{v:+.2f}" for v in command)


def measure_tables(report: dict[str, Any]) -> list[list[tuple[str, ...]]]:
    """Return the tables of gait and of contact, each a header and one row per command; none without measures."""
    if not any(c.get("measures") for c in report["commands"]):
        return []
    tables = []
    for columns in (GAIT, CONTACT):
        lines: list[tuple[str, ...]] = [("command", *columns, "n")]
        for c in report["commands"]:
            cells = [show(c["measures"]) for show in columns.values()]
            lines.append((_short(c["command"]), *cells, str(c["distinct_falls"]["n"])))
        tables.append(lines)
    return tables


def _falls(report: dict[str, Any]) -> str:
    """Say how many of the robots that differ fell, with the interval, and how many do."""
    falls = report["distinct_falls"]
    same = report["episodes"] - falls["n"]
    repeats = "repeat another one and do not count"
    alike = f"; {same} of {report['episodes']} episodes {repeats}" if same else ""
    low, high = (100.0 * falls[k] for k in ("low", "high"))
    return f"falls {falls['count']} of {falls['n']} different robots (95 %: {low:.1f} to {high:.1f} %){alike}"


def _delay(report: dict[str, Any]) -> str:
    """Say how late targets may come."""
    margin = report["delay_margin"]
    runs = ", ".join(f"{ms} ms {f['count']} of {f['n']}" for ms, f in margin["falls"].items())
    held = "none: robots fall without any" if margin["ms"] is None else f"{margin['ms']} ms"
    return f"largest delay of the target without a fall: {held} (falls: {runs})"


def bars(report: dict[str, Any]) -> list[str]:
    """Say which of the bars for a policy (``evaluate/bars.py``) the report has a figure for and which it misses."""
    verdicts = judged(report)
    missed = [verdict for verdict in verdicts if not verdict.reached]
    if not verdicts:
        return []

    def worst(verdict: Verdict) -> str:
        value = "-" if verdict.worst is None else f"{verdict.worst:.3g}"
        command = ", ".join(f"{v:+g}" for v in verdict.command)
        return f"  {verdict.name}: {value}" + (f" at {command}" if command else "")

    head = f"bars for a policy (go1exp/evaluate/bars.py): {len(verdicts) - len(missed)} of {len(verdicts)} reached"
    return [head + ("; missed, worst command's mean:" if missed else ""), *map(worst, missed)]


def text(report: dict[str, Any]) -> str:
    """Return the report as text for a terminal; m/s and rad/s."""
    lines = _laid([HEADER, *rows(report)])
    for table in measure_tables(report):
        lines += ["", *_laid(table)]
    measured = any(c.get("measures") for c in report["commands"])
    if measured:
        lines += ["", LEGEND]
    lines += [""] + [
        line(report) for key, line in (("distinct_falls", _falls), ("delay_margin", _delay)) if key in report
    ]
    return "\n".join([*lines, *(bars(report) if measured else ()), _summary(report)])


def markdown(report: dict[str, Any]) -> str:
    """Return the report as a Markdown table."""
    lines = [f"| {' | '.join(line)} |" for line in [HEADER, ("---",) * len(HEADER), *rows(report)]]
    return "\n".join([*lines, "", _summary(report)])
