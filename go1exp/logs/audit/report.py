"""The result of an audit, as data and as text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from go1exp.base.report.table import aligned
from go1exp.base.wording import counted

Verdict = Literal["ok", "suspect", "bad"]
ORDER: tuple[Verdict, ...] = ("ok", "suspect", "bad")


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst of ``verdicts``; ``ok`` if there are none."""
    return max(verdicts, key=ORDER.index, default="ok")


@dataclass(frozen=True)
class Finding:
    """One result of one check."""

    check: str  # ``rate``, ``repeats``, ``sign``, ``delay``, ..
    channel: str  # column, or ``t``, or ``all`` where it concerns the whole recording
    verdict: Verdict  # ``ok`` for information, else a flaw
    size: float | None  # the number compared with the limits, or None
    unit: str  # of ``size``
    message: str  # a sentence


@dataclass(frozen=True)
class Channel:
    """One column in numbers; None where a number is undefined."""

    name: str  # column
    verdict: Verdict  # worst of the findings about it
    unit: str  # of ``low``, ``high``, ``step`` and ``noise``
    low: float  # smallest value
    high: float  # largest value
    step: float | None = None  # quantisation; 0 where values are continuous
    noise: float | None = None  # standard deviation between samples, an upper bound while the joint moves fast
    repeats: float | None = None  # share of stale samples while the channel moves
    delay_ms: float | None = None  # delay from command to response, ms, of the columns ``q_J``
    delay_sd_ms: float | None = None  # its standard error, ms


@dataclass(frozen=True)
class AuditReport:
    """The audit of one recording."""

    episode: str  # its name
    samples: int  # number of rows
    duration: float  # s
    rate_hz: float  # one over the median step of ``t``
    channels: tuple[Channel, ...]  # one line for each column, ``t`` first
    findings: tuple[Finding, ...]  # flaws first, then facts
    torque_off: tuple[tuple[float, float], ...] = ()  # stretches with actuators off, (start, end) in s
    still: tuple[tuple[float, float], ...] = ()  # stretches in which no joint moves, (start, end) in s
    # numbers of the few rows that their neighbours rule out; the other checks are without them
    impossible: tuple[int, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict."""
        return worst(f.verdict for f in self.findings)

    def by_check(self, check: str) -> list[Finding]:
        """Return the findings of one check."""
        return [f for f in self.findings if f.check == check]

    @property
    def flaws(self) -> list[Finding]:
        """The findings that are not ``ok``."""
        return [f for f in self.findings if f.verdict != "ok"]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values that JSON can hold."""
        plain = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}
        stretches = {key: [list(stretch) for stretch in plain[key]] for key in ("torque_off", "still")}
        return {"verdict": self.verdict, **plain, **stretches}

    def text(self) -> str:
        """Return a table of the channels, and below it the findings, one to a line."""
        counts = {v: sum(c.verdict == v for c in self.channels) for v in ORDER}
        channels = ", ".join(f"{counted(n, 'channel')} {v}" for v, n in counts.items() if n)
        stretches = (("actuators off", self.torque_off), ("still", self.still))
        head = ("channel", "verdict", "unit", "low", "high", "step", "noise", "repeats", "delay ms")
        lines = [
            f"{self.episode}: {self.verdict}",
            f"{self.samples} samples, {self.duration:.2f} s at {self.rate_hz:.4g} Hz; {channels}",
            *(f"{name}: {_stretches(those)}" for name, those in stretches if those),
            "",
            *aligned([head, *map(_row, self.channels)], 3),
        ]
        return "\n".join([*lines, *(["", *_grouped(self.findings)] if self.findings else [])])


def _grouped(findings: tuple[Finding, ...]) -> list[str]:
    """One line for each finding; channels with the same message share a line."""
    same: dict[tuple[str, str, str], list[str]] = {}
    for f in findings:
        same.setdefault((f.verdict, f.check, f.message), []).append(f.channel)
    lines = []
    for (verdict, check, message), channels in same.items():
        shown = ", ".join(channels[:3]) + (f" and {len(channels) - 3} more" if len(channels) > 3 else "")
        lines.append(f"{verdict:<7}  {check:<10}  {shown}: {message}")
    return lines


def _row(c: Channel) -> tuple[str, ...]:
    delay = "" if c.delay_ms is None else f"{c.delay_ms:.1f} ± {c.delay_sd_ms or 0:.1f}"
    step = "" if c.step is None else "-" if c.step == 0 else f"{c.step:.3g}"
    noise = "" if c.noise is None else f"{c.noise:.2g}"
    repeats = "" if c.repeats is None else f"{c.repeats:.1%}"
    return (c.name, c.verdict, c.unit, f"{c.low:.4g}", f"{c.high:.4g}", step, noise, repeats, delay)


def _stretches(stretches: tuple[tuple[float, float], ...]) -> str:
    shown = ", ".join(f"{a:.2f}-{b:.2f}" for a, b in stretches[:6])
    rest = f" and {len(stretches) - 6} more" if len(stretches) > 6 else ""
    return f"{shown}{rest} s ({sum(b - a for a, b in stretches):.1f} s)"
