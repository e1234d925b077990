"""The audit of one recording, and of several recordings of one robot together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import go1exp.logs.audit.commands as commands
import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.related as related
import go1exp.logs.audit.signals as signals
import go1exp.logs.audit.single as single
from go1exp.base.wording import listed
from go1exp.logs.audit.commands import Delay
from go1exp.logs.audit.copies import copies
from go1exp.logs.audit.impossible import impossible, without
from go1exp.logs.audit.report import ORDER, AuditReport, Channel, Finding, worst
from go1exp.logs.audit.signals import Log, finding
from go1exp.logs.recording import Recording, problems

SHORTEST = 20  # fewest rows of a recording that are checked (chosen: a median step and its spread need about as many)


def audit(recording: Recording) -> AuditReport:
    """Look for what is wrong with a recording; nothing is corrected and nothing is raised.

    A few impossible rows are named and left out of the other checks, but for those of the clock.
    A recording that cannot be computed with (no clock, values that are not finite, a clock that runs backward) gets
    only the findings about its format.
    """
    lines = (line.partition(": ") for line in problems(recording))  # channel: message
    format_findings = [Finding("format", channel, "bad", None, "", message) for channel, _, message in lines]
    if not _computable(recording):
        return _report(recording, format_findings, ())
    excluded = impossible(recording)
    few = excluded.rows.mean() <= limits.MOST_IMPOSSIBLE
    log = Log(without(recording, excluded.rows) if few and excluded.findings else excluded.unwrapped)
    findings, measured = _run_checks(log)
    findings = [*excluded.findings, *single.clock(Log(recording)), *findings]
    off, still = _times(log, ~log.on), _times(log, log.still)
    if off:
        total = sum(b - a for a, b in off)
        stretches = "1 stretch" if len(off) == 1 else f"{len(off)} stretches"
        findings.append(finding("torque_off", "torque_enable", "ok", total, "s", f"actuators off in {stretches}"))
    if (share := float(log.still.mean())) > limits.STILL_SHARE:
        findings.append(
            finding("still", "all", "suspect", share, "", "no joint moves: nothing can be learned from this")
        )
    # A format error is not repeated where a check has already called the same channel bad.
    named = {f.channel for f in findings if f.verdict == "bad"}
    findings += [f for f in format_findings if f.channel not in named]
    left_out = tuple(map(int, np.flatnonzero(excluded.rows))) if few else ()
    report = _report(recording, findings, _channel_table(log, findings, measured), off, still)
    return replace(report, impossible=left_out)


Measured = tuple[dict[str, float], dict[str, float], dict[str, Delay]]
"""What the checks measured of each channel, by its name: share of repeats, noise floor, delay."""


def _run_checks(log: Log) -> tuple[list[Finding], Measured]:
    """Run every check; findings come in the order in which the report prints those of equal verdict."""
    stale_findings, repeats = single.stale(log)
    noise_findings, floors = single.noise(log, repeats)
    delay_findings, delays = commands.timing(log)
    findings = [
        *stale_findings,
        *single.resolution(log),
        *noise_findings,
        *single.dead(log),
        *single.frozen(log),
        *single.saturation(log),
        *single.ranges(log),
        *related.attitude_length(log),
        *related.speed(log),
        *related.torque(log),
        *related.rotation(log),
        *related.gravity(log),
        *copies(log),
        *commands.order_and_sign(log),
        *delay_findings,
    ]
    return findings, (repeats, floors, delays)


def _channel_table(log: Log, findings: list[Finding], measured: Measured) -> tuple[Channel, ...]:
    repeats, floors, delays = measured
    table = []
    for name, values in log.recording.channels.items():
        verdict = worst(f.verdict for f in findings if f.channel in (name, log.quantity.get(name)))
        numbers = float(values.min()), float(values.max()), log.steps.get(name), floors.get(name), repeats.get(name)
        delay = delays.get(name)
        after = (None, None) if delay is None else (delay.time * 1e3, delay.error * 1e3)
        table.append(Channel(name, verdict, log.unit(name), *numbers, *after))
    return tuple(table)


def _computable(recording: Recording) -> bool:
    channels = recording.channels
    t = channels.get("t")
    if t is None or np.ndim(t) != 1 or len(t) < SHORTEST:
        return False
    plain = all(isinstance(v, np.ndarray) and v.shape == t.shape and v.dtype.kind in "fb" for v in channels.values())
    return plain and all(np.isfinite(v).all() for v in channels.values()) and bool(np.all(np.diff(t) > 0))


def _times(log: Log, flags: np.ndarray) -> tuple[tuple[float, float], ...]:
    return tuple((float(log.t[a]), float(log.t[b - 1])) for a, b in signals.stretches(flags))


def _report(
    recording: Recording,
    findings: list[Finding],
    table: tuple[Channel, ...],
    off: tuple[tuple[float, float], ...] = (),
    still: tuple[tuple[float, float], ...] = (),
) -> AuditReport:
    t = np.asarray(recording.channels.get("t", []), dtype=float)
    steps = np.diff(t) if t.ndim == 1 else np.empty(0)
    middle = float(np.median(steps)) if len(steps) else 0.0
    if t.ndim == 1 and len(t) < SHORTEST:
        message = f"{len(t)} samples are too few for an audit; at least {SHORTEST} are needed"
        findings = [*findings, finding("length", "all", "suspect", len(t), "samples", message)]
    ranked = sorted(findings, key=lambda f: -ORDER.index(f.verdict))
    duration = float(t[-1] - t[0]) if t.ndim == 1 and len(t) else 0.0
    rate = 1 / middle if middle > 0 else 0.0
    return AuditReport(recording.meta.episode, len(t), duration, rate, table, tuple(ranked), off, still)


# ---------------------------------------------------------------------- several recordings

EXCEPTION = 3  # times as many recordings that must agree before others are exceptions


@dataclass(frozen=True)
class CommandDelay:
    """After how long the joints of one recording answer, s, and the standard error of it, s."""

    episode: str
    time: float
    error: float

    @property
    def measured(self) -> str:
        """In words."""
        return f"{1e3 * self.time:.1f} ± {1e3 * self.error:.1f} ms"

    def __str__(self) -> str:
        return f"{self.measured} ({self.episode})"

    def differs_from(self, other: CommandDelay) -> bool:
        """Return whether two recordings differ by more than one robot's can."""
        return abs(self.time - other.time) - 2 * float(np.hypot(self.error, other.error)) > limits.DELAY_RECORDINGS

    @property
    def ahead(self) -> bool:
        """Return whether joints respond before the command."""
        return self.time + 2 * self.error < -limits.DELAY


def command_delays(reports: Sequence[AuditReport]) -> list[CommandDelay]:
    """Return the delay of commands of each recording that shows it at enough of its joints: their median."""
    known = []
    for report in reports:
        angles = [c for c in report.channels if c.name.startswith("q_") and not c.name.startswith("q_target")]
        pairs = [(c.delay_ms, c.delay_sd_ms) for c in angles if c.delay_ms is not None and c.delay_sd_ms is not None]
        if pairs and len(pairs) >= limits.DELAY_JOINTS * len(angles):
            time, error = np.median(np.array(pairs) * 1e-3, axis=0)
            known.append(CommandDelay(report.episode, float(time), float(error)))
    return known


def clock_flaws(reports: Sequence[AuditReport]) -> dict[str, str]:
    """Return what is wrong with recordings whose commands have a clock that is not that of the readings, by episode.

    A robot answers its commands after the same time in every recording, up to what gains and motion change of it. Where
    recordings differ by more, or joints respond before the command, commands and readings were not stamped by
    one clock. Single recordings are named where ``EXCEPTION`` times as many agree. Otherwise all are: a clock that is
    set anew for each recording is so in those that do not show it, too.
    """
    known = command_delays(reports)
    groups = [[other for other in known if not one.differs_from(other)] for one in known if not one.ahead]
    agreeing = [one for one in max(groups, key=len, default=[]) if not one.ahead]
    apart = [one for one in known if one not in agreeing]
    if not apart:
        return {}
    why = "commands and readings have clocks of their own"
    if len(agreeing) >= EXCEPTION * len(apart):
        usual = f"{1e3 * float(np.median([one.time for one in agreeing])):.1f} ms in the others"
        return {one.episode: f"joints answer their commands after {one}, {usual}: {why}" for one in apart}
    ordered = sorted(known, key=lambda one: one.time)
    ends = " to ".join(str(one) for one in dict.fromkeys((ordered[0], ordered[-1])))
    measured = {one.episode: f"after {one.measured}" for one in known}
    each = {report.episode: measured.get(report.episode, "after an unknown time") for report in reports}
    return {
        name: f"joints answer their commands {time}, in these logs after {ends}: {why}" for name, time in each.items()
    }


EPOCH_S = 1e8  # times beyond which are counted since 1970 (chosen: three years)
SAME_RATE = 1.02  # ratio of two rates up to which they are one (chosen)
SAME_JITTER = 3.0  # the same of the jitter, as a share of a step (chosen)
LITTLE_JITTER = 0.01  # share of a step below which jitter is alike (chosen)


@dataclass(frozen=True)
class _Clock:
    """How a recording is stamped."""

    rate_hz: float
    jitter: float  # share of a step; 0 if steps were counted
    since_1970: bool

    def __str__(self) -> str:
        steps = f"steps vary by {self.jitter:.1%}" if self.jitter else "counted steps"
        return f"{self.rate_hz:.4g} Hz, {steps}" + (", seconds since 1970" if self.since_1970 else "")

    def like(self, other: _Clock) -> bool:
        """Return whether two recordings may be of one logger."""
        few, many = (f(max(one.jitter, LITTLE_JITTER) for one in (self, other)) for f in (min, max))
        alike = (bool(self.jitter), self.since_1970) == (bool(other.jitter), other.since_1970)
        slow, fast = sorted((self.rate_hz, other.rate_hz))
        return alike and fast <= SAME_RATE * slow and many <= SAME_JITTER * few


def clock_kinds(reports: Sequence[AuditReport]) -> str:
    """Return which clock each recording has: rate, jitter and origin; empty if all have one of a kind."""
    kinds: list[tuple[_Clock, list[str]]] = []
    for report in reports:
        size = next((f.size for f in report.by_check("jitter")), None)
        if size is None or not report.channels:
            continue  # no clock to speak of: the audit has said so
        share = size * 1e-3 * report.rate_hz
        clock = _Clock(report.rate_hz, share if share >= limits.COUNTED else 0.0, report.channels[0].low > EPOCH_S)
        names = next((names for kind, names in kinds if kind.like(clock)), None)
        if names is None:
            kinds.append((clock, names := []))
        names.append(report.episode)
    if len(kinds) < 2:
        return ""
    return "The logs have different clocks: " + "; ".join(f"{listed(n)}: {kind}" for kind, n in kinds) + "."
