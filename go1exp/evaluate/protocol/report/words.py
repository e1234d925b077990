"""Figures, conditions and falls in words, for the pages and for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from go1exp.evaluate.protocol.ground import UNITS
from go1exp.evaluate.protocol.playing import Result

KEYS: dict[str, tuple[str, str]] = {
    "x": ("x", "m/s"),
    "y": ("y", "m/s"),
    "yaw": ("yaw", "rad/s"),
    "amplitude": ("amplitude", "x m/s, y m/s, yaw rad/s"),
    "period": ("period", "s"),
    "impulse": ("impulse", "N s"),
    "direction_deg": ("direction", "deg"),
    "rate_hz": ("rate", "Hz"),
    "delay_ms": ("delay", "ms"),
    "speed": ("speed", "m/s"),
}
"""Word and unit of what conditions are made of; of others, the key itself without a unit."""

COMMAND = ("x", "y", "yaw")


def condition_text(condition: Mapping[str, Any]) -> str:
    """Write a condition; of a command, the axes that are not zero."""
    return ", ".join(_value(k, v, condition) for k, v in _telling(condition).items()) or "all"


def _telling(condition: Mapping[str, Any]) -> dict[str, Any]:
    """Return a condition without axes of zero velocity, unless it would then say nothing of its command."""
    if not any(condition.get(axis) for axis in COMMAND):
        return dict(condition)
    return {k: v for k, v in condition.items() if v or k not in COMMAND}


def _value(key: str, value: Any, condition: Mapping[str, Any]) -> str:
    word, unit = KEYS.get(key, (key.replace("_", " "), ""))
    if key == "difficulty":
        unit = UNITS.get(str(condition.get("ground")), "")
    text = f"{value:.4g}" if isinstance(value, float) else str(value).replace("_", " ")
    return f"{word} {text} {unit}".rstrip() if key != "amplitude" else f"{word} {text}"


def keys_text(keys: Sequence[str]) -> str:
    """Write what conditions are made of, with units, such as rate (Hz), delay (ms)."""
    named = [KEYS.get(k, (k.replace("_", " "), "")) for k in keys]
    return ", ".join(f"{word} ({unit})" if unit else word for word, unit in named)


def number(value: float) -> str:
    """Write a number with three digits; what is zero but for rounding is 0."""
    if abs(value) < 1e-9:
        return "0"
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def interval_text(estimate: float | None, low: float | None, high: float | None) -> str:
    """Write a figure with its interval."""
    if estimate is None or estimate != estimate:
        return "–"
    if low is None or high is None or low != low:
        return number(estimate)
    return f"{number(estimate)} [{number(low)}, {number(high)}]"


def falls(result: Result) -> str:
    """Say in a line how many robots fell."""
    rows = result.played.rows
    minutes = sum(row["moving_s"] for row in rows) / 60.0
    count, left = (sum(bool(row[k]) for row in rows) for k in ("fell", "left_map"))
    noun = "fall" if count == 1 else "falls"
    return f"{count} {noun}, {left} left the map, in {minutes:.1f} moving robot-minutes ({len(rows)} rows)."
