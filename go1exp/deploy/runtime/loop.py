"""A loop at a fixed rate that counts every deadline.

Cycle k is due at start + k periods; its work must be done when cycle k + 1 is due. After a cycle that took too long,
the cycle that is due by then follows at once, so that a small delay costs little. Cycles whose time is over are left
out and count as missed: they are not made up for, and the phase of the loop stays.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

KEPT = 200_000
"""Newest cycles that are kept for the percentiles: 500 s at 400 Hz."""

REPORTED = 1_000
"""Newest cycles for the percentiles of a report in the loop: those of ``KEPT`` take longer than a cycle at 400 Hz."""


BETWEEN_S = 0.002
"""Period at which a clock lets something be done between two cycles, s: that of the Go1's packets."""


MARGIN_S = 0.00015
"""Time before an instant from which nothing more is prepared, s: one preparation takes less."""


class MonotonicClock:
    """The system's monotonic clock.

    Args:
        spin: time before each instant for which the core is kept busy instead of asleep, s; 0: not at all.
        meanwhile: called once at the beginning of that, for example a rehearsal of the work: after a sleep the caches
            are cold, and the first work takes two to three times as long.
        prepare: called again and again after it, until ``MARGIN_S`` before the instant: work that need not wait for it.
        between: called every ``BETWEEN_S`` while it sleeps, for example to send a command again; None: it sleeps
            through.
    """

    def __init__(
        self,
        spin: float = 0.0,
        meanwhile: Callable[[], None] = lambda: None,
        between: Callable[[], None] | None = None,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self._spin, self._meanwhile, self._between, self._prepare = spin, meanwhile, between, prepare

    def now(self) -> float:
        """Return the time, s; it never decreases."""
        return time.perf_counter()

    def sleep_until(self, when: float) -> None:
        """Return at ``when`` or a little later; at once if that has passed."""
        wake = when - self._spin
        while self._between is not None and wake - time.perf_counter() > BETWEEN_S:
            time.sleep(BETWEEN_S)
            self._between()
        left = wake - time.perf_counter()
        if left > 0:
            time.sleep(left)
        if self._spin and time.perf_counter() < when:
            self._meanwhile()
        while self._spin and self._prepare is not None and time.perf_counter() < when - MARGIN_S:
            self._prepare()
        while self._spin and time.perf_counter() < when:
            pass


@dataclass(frozen=True)
class Timing:
    """Timing of a loop; percentiles are over the newest ``KEPT`` cycles, in reports ``REPORTED``; all else over all.

    Attributes:
        cycles: number of cycles that ran.
        period_p50: time from one cycle's start to the next one's, median, s.
        period_p99: s.
        period_worst: s.
        work_p50: time that a cycle's work took, median, s.
        work_p99: s.
        work_worst: s.
        start_delay_worst: largest delay of a start after its due time, s.
        missed: missed deadlines: cycles that were not done when the next was due, and cycles that were left out.
        left_out: cycles that never ran.
    """

    cycles: int
    period_p50: float
    period_p99: float
    period_worst: float
    work_p50: float
    work_p99: float
    work_worst: float
    start_delay_worst: float
    missed: int
    left_out: int

    @property
    def missed_share(self) -> float:
        """Missed deadlines over all deadlines, those of the cycles that were left out included."""
        return self.missed / max(self.cycles + self.left_out, 1)

    def __str__(self) -> str:
        period = f"period p50 {1e3 * self.period_p50:.3f}, p99 {1e3 * self.period_p99:.3f}, "
        period += f"worst {1e3 * self.period_worst:.3f} ms"
        work = (
            f"work p50 {1e3 * self.work_p50:.3f}, p99 {1e3 * self.work_p99:.3f}, worst {1e3 * self.work_worst:.3f} ms"
        )
        return f"{self.cycles} cycles; {period}; {work}; missed {self.missed} ({100 * self.missed_share:.3f} %)"


class Deadlines:
    """Counts cycles of ``period`` s and deadlines of a loop; allocates memory only when it is built."""

    def __init__(self, period: float, kept: int = KEPT) -> None:
        self._period = period
        self._periods, self._work = np.zeros(kept), np.zeros(kept)
        self.cycles = self.missed = self.left_out = 0
        self._last_start = np.nan
        self._period_worst = self._work_worst = self._start_delay_worst = 0.0

    def note(self, due: float, start: float, end: float, left_out: int) -> None:
        """Count a cycle.

        Args:
            due: when it should have started, s.
            start: when it did.
            end: when its work was done.
            left_out: cycles that will be left out because this one took so long.
        """
        place = self.cycles % len(self._work)
        self._work[place] = end - start
        self._work_worst = max(self._work_worst, end - start)
        self._start_delay_worst = max(self._start_delay_worst, start - due)
        if self.cycles:
            since = start - self._last_start
            self._periods[(self.cycles - 1) % len(self._periods)] = since
            self._period_worst = max(self._period_worst, since)
        self._last_start = start
        self.cycles += 1
        self.left_out += left_out
        self.missed += left_out + (end > due + self._period)

    def timing(self, newest: int = KEPT) -> Timing:
        """Return the timing so far, with percentiles over at most the ``newest`` cycles that are kept."""
        periods = _last(self._periods, max(self.cycles - 1, 0), newest)
        work = _last(self._work, self.cycles, newest)
        p50, p99 = np.percentile(periods, [50, 99]) if len(periods) else (0.0, 0.0)
        w50, w99 = np.percentile(work, [50, 99]) if len(work) else (0.0, 0.0)
        return Timing(
            cycles=self.cycles,
            period_p50=float(p50),
            period_p99=float(p99),
            period_worst=self._period_worst,
            work_p50=float(w50),
            work_p99=float(w99),
            work_worst=self._work_worst,
            start_delay_worst=self._start_delay_worst,
            missed=self.missed,
            left_out=self.left_out,
        )


def _last(ring: np.ndarray, written: int, most: int) -> np.ndarray:
    """Return at most ``most`` of the newest numbers of a ring into which so many were ``written``."""
    count = min(written, len(ring), most)
    return ring[np.arange(written - count, written) % len(ring)]


def run(
    work: Callable[[float], bool],
    rate: float,
    seconds: float | None = None,
    clock: MonotonicClock | None = None,
    on_report: Callable[[Timing], None] | None = None,
    report_every: float = 1.0,
) -> Timing:
    """Call ``work(now)`` at a fixed rate until it returns False or the time is up; return the timing.

    Python's garbage collector is off meanwhile, because a collection takes milliseconds; ``work`` should not create
    reference cycles.

    Args:
        work: one cycle; gets the clock's time at its start, s.
        rate: cycles per second.
        seconds: duration, s; None: until ``work`` returns False.
        clock: one without spin if None.
        on_report: called with the timing every ``report_every`` s, after the work of a cycle.
        report_every: s.
    """
    clock = clock or MonotonicClock()
    period = 1.0 / rate
    deadlines = Deadlines(period)
    total = None if seconds is None else max(1, round(seconds * rate))
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        begin = clock.now()
        cycle, next_report = 0, begin + report_every
        while total is None or cycle < total:
            due = begin + cycle * period
            clock.sleep_until(due)
            start = clock.now()
            wanted = work(start)
            end = clock.now()
            # The cycle whose time it is at the end of this one; 1e-9: rounding must not skip a cycle.
            following = max(cycle + 1, math.floor((end - begin) / period + 1e-9))
            if total is not None:
                following = min(following, total)
            deadlines.note(due, start, end, following - cycle - 1)
            cycle = following
            if not wanted:
                break
            if on_report is not None and end >= next_report:
                on_report(deadlines.timing(REPORTED))
                next_report = end + report_every
    finally:
        if collecting:
            gc.enable()
    return deadlines.timing()
