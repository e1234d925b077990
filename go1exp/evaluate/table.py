"""An evaluation report as a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from go1exp.base.report.table import aligned
from go1exp.evaluate.criteria import Verdict, evaluated
from go1exp.evaluate.quantities import AXES, coarse_note

HEADER = ("command x, y, yaw", "mean x, y, yaw", "RMSE x, y, yaw", "falls", "mean time s")
Show = Callable[[Any], str]  # text of one cell from the entry of a measure in a report, which may be None
Columns = dict[str, tuple[str, Show]]  # header -> measure and its format
NO_FIGURE = "-"
FEET = "FR FL RR RL"
WIDTH = 120  # largest width of a table of further measures, in characters


def _numbers(form: str, factor: float = 1.0) -> Show:
    """Return the format of the mean of a measure, or of its four feet."""

    def show(entry: Any) -> str:
        if entry is None:
            return NO_FIGURE
        means = entry["mean"] if isinstance(entry["mean"], list) else [entry["mean"]]
        if all(m is None for m in means):
            return NO_FIGURE
        return " ".join(NO_FIGURE if m is None else format(factor * m, form) for m in means)

    return show


def _phases(entry: Any) -> str:
    """Return the phases of FL, RR and RL relative to FR."""
    return " ".join(_numbers(".2f")(entry).split(" ")[1:]) or NO_FIGURE


def _most(entry: Any) -> str:
    return next(iter(entry or {}), NO_FIGURE)


def _any(entry: Any) -> str:
    return _numbers(".3g")(entry) if entry is None or "mean" in entry else _most(entry)


GAIT: Columns = {
    "gait": ("gait", _most),
    "error": ("trot_error", _numbers(".2f")),
    "Hz": ("stride_rate", _numbers(".1f")),
    "phase FL RR RL": ("touchdown_phase", _phases),
    f"duty {FEET}": ("duty_factor", _numbers(".2f")),
    "fly %": ("flight_share", _numbers(".0f", 100.0)),
    "clearance mm": ("clearance", _numbers(".0f", 1000.0)),
    "height m": ("trunk_height", _numbers(".3f")),
    "pitch deg": ("trunk_pitch", _numbers("+.1f", 180.0 / math.pi)),
}
"""Columns of the table of gait figures."""

CONTACT: Columns = {
    "heave m/s": ("heave", _numbers(".2f")),
    f"load % {FEET}": ("load_share", _numbers(".0f", 100.0)),
    "slip %": ("slip_share_all", _numbers(".0f", 100.0)),
    "touchdown m/s": ("touchdown_speed_p95", _numbers(".2f")),
    "peak BW": ("peak_force_p95", _numbers(".1f")),
    "step rad": ("target_step_p99", _numbers(".2f")),
    "tau %": ("torque_share_p99", _numbers(".0f", 100.0)),
    "qd %": ("joint_speed_share_p99", _numbers(".0f", 100.0)),
    "line %": ("envelope_share_p99", _numbers(".0f", 100.0)),
    "CoT": ("cost_of_transport", _numbers(".2f")),
}
"""Columns of the table of contacts and effort."""

FIXED = frozenset(measure for columns in (GAIT, CONTACT) for measure, _ in columns.values())
"""Measures that these two tables show."""

JSON_ONLY = frozenset({"foot_load", "gait_clarity", "phase_consistency", "sink_p99", "slip_distance", "slip_share"})
"""Measures that the tables omit where the report has all measures of the package."""

LEGEND = """error: touchdown times relative to a trot, phase: relative to FR, in cycles; feet: FR FL RR RL; pitch: nose
down; touchdown and peak (body weights): 95th percentile; step: action rate over 20 ms; tau, qd, line: share of peak
torque, top speed and the torque-speed line; step, tau, qd and line: 99th percentile; CoT: positive work / (m g d)."""

MEANS = "Means over n robots; the JSON has intervals and all measures."


def _triple(values: Iterable[float]) -> str:
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
        f"falls {report['falls']} in {report['episodes']} episodes of {settings['seconds']:g} s; "
        f"with {', '.join(on) if on else 'no noise, randomisation or pushes, on flat ground'}"
        + (f"; moved by {settings['engine']['name']}" if report.get("agreement") else "")
        + (f"; {note}" if (note := coarse_note(report.get("physics_dt", 0.0))) else "")
    )


def _short(command: Sequence[float]) -> str:
    return " ".join(f"{v:+.1f}" if abs(10 * v - round(10 * v)) < 1e-9 else f"{v:+.2f}" for v in command)


def measure_tables(report: dict[str, Any]) -> list[list[tuple[str, ...]]]:
    """Return tables of gait, contact and further measures, a header and a row per command, without empty columns."""
    tables = []
    for columns in (GAIT, CONTACT):
        if filled := [column for column in _columns(report, columns) if {*column[1:]} != {NO_FIGURE}]:
            tables.append(_table(report, filled))
    return tables + _further(report)


def _further(report: dict[str, Any]) -> list[list[tuple[str, ...]]]:
    """Return tables of the measures that no fixed column shows, such as a user's; one, unless it were too wide."""
    names = dict.fromkeys(name for c in report["commands"] for name in c.get("measures", ()))
    hidden = FIXED | JSON_ONLY if names.keys() >= FIXED | JSON_ONLY else FIXED
    shown: Columns = {_title(report, name): (name, _any) for name in names if name not in hidden}
    tables: list[list[tuple[str, ...]]] = []
    taken: list[tuple[str, ...]] = []
    for column in _columns(report, shown):
        if taken and len(aligned(_table(report, [*taken, column]), 0)[0]) > WIDTH:
            tables.append(_table(report, taken))
            taken = []
        taken.append(column)
    return [*tables, _table(report, taken)] if taken else tables


def _title(report: dict[str, Any], name: str) -> str:
    """Return the header of a measure: its name, its unit where it has one, and the order of feet."""
    unit = report.get("units", {}).get(name, "")
    entries = [c["measures"].get(name) for c in report["commands"]]
    feet = any(isinstance(entry, dict) and isinstance(entry.get("mean"), list) for entry in entries)
    return " ".join([name, *([unit] if unit not in ("", "-", "name") else []), *([FEET] if feet else [])])


def _columns(report: dict[str, Any], columns: Columns) -> list[tuple[str, ...]]:
    """Return each column of a table: its header, and a cell per command."""
    measures = [c.get("measures", {}) for c in report["commands"]]
    return [(header, *(show(m.get(name)) for m in measures)) for header, (name, show) in columns.items()]


def _table(report: dict[str, Any], columns: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the rows of a table: the command, the cells of ``columns``, and the number of robots."""
    commands = ("command", *(_short(c["command"]) for c in report["commands"]))
    counts = ("n", *(str(c["distinct_falls"]["n"]) for c in report["commands"]))
    return list(zip(commands, *columns, counts, strict=True))


def _falls(report: dict[str, Any]) -> str:
    """Return the number of falls of distinct robots with its interval, and the number of repeats."""
    falls = report["distinct_falls"]
    same = report["episodes"] - falls["n"]
    alike = f"; {same} of {report['episodes']} episodes are repeats and excluded" if same else ""
    low, high = (100.0 * falls[k] for k in ("low", "high"))
    return f"falls {falls['count']} of {falls['n']} distinct robots (95 %: {low:.1f} to {high:.1f} %){alike}"


def _delay(report: dict[str, Any]) -> str:
    margin = report["delay_margin"]
    runs = ", ".join(f"{ms} ms {f['count']} of {f['n']}" for ms, f in margin["falls"].items())
    held = "none: robots fall without delay" if margin["ms"] is None else f"{margin['ms']} ms"
    return f"largest command delay without a fall: {held} (falls: {runs})"


def acceptance(report: dict[str, Any]) -> list[str]:
    """Return the acceptance criteria (``evaluate/criteria.py``) that the report has a figure for, and those missed."""
    verdicts = evaluated(report)
    missed = [verdict for verdict in verdicts if not verdict.met]
    if not verdicts:
        return []

    def worst(verdict: Verdict) -> str:
        value = "-" if verdict.worst is None else f"{verdict.worst:.3g}"
        command = ", ".join(f"{v:+g}" for v in verdict.command)
        return f"  {verdict.name}: {value}" + (f" at {command}" if command else "")

    met = len(verdicts) - len(missed)
    head = f"acceptance criteria (go1exp/evaluate/criteria.py): {met} of {len(verdicts)} met"
    return [head + ("; missed, worst command's mean:" if missed else ""), *map(worst, missed)]


def text(report: dict[str, Any]) -> str:
    """Return the report as text for a terminal; m/s and rad/s."""
    lines = aligned([HEADER, *rows(report)], 0)
    tables = measure_tables(report)
    for table in tables:
        lines += ["", *aligned(table, 0)]
    measured = any(c.get("measures") for c in report["commands"])
    if measured:
        fixed = len(tables) > len(_further(report))
        lines += ["", *([LEGEND] if fixed else []), MEANS]
    lines += [""] + [
        line(report) for key, line in (("distinct_falls", _falls), ("delay_margin", _delay)) if key in report
    ]
    return "\n".join([*lines, *(acceptance(report) if measured else ()), _summary(report)])
