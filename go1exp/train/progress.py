"""What a person sees while training: a bar in a terminal, a line now and then in a log file."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import Any

LINE_PERIOD = 15.0
"""Least time between two lines when there is no terminal, s."""


class Progress:
    """Steps per second, time left, return, KL, learning rate and terrain level of a training run."""

    def __init__(self, iteration: int, iterations: int, steps_per_iteration: int) -> None:
        self._first, self._last, self._size = iteration, iterations, steps_per_iteration
        self._start = time.monotonic()
        self._printed = -LINE_PERIOD
        self._bar: Any = None
        self._task: Any = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                BarColumn(bar_width=20),
                TimeRemainingColumn(),
                TextColumn("{task.description}"),
                console=Console(stderr=True),
            )
            self._task = self._bar.add_task("starting", total=iterations, completed=iteration)

    def __enter__(self) -> Progress:
        """Show the bar."""
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar's last state on the screen."""
        if self._bar:
            self._bar.stop()

    def update(self, iteration: int, metrics: dict[str, Any]) -> None:
        """Show the metrics of ``iteration``."""
        elapsed = time.monotonic() - self._start
        rate = (iteration - self._first) * self._size / max(elapsed, 1e-9)
        parts = [f"{rate:,.0f} steps/s"]
        for key, label, form in (
            ("rollout/return", "return", "{:.2f}"),
            ("rollout/length", "length", "{:.0f} steps"),
            ("train/kl", "KL", "{:.4f}"),
            ("train/learning_rate", "lr", "{:.1e}"),
            ("curriculum/terrain_level", "terrain", "{:.2f}"),
        ):
            if key in metrics and not math.isnan(metrics[key]):
                parts.append(f"{label} {form.format(metrics[key])}")
        text = "  ".join(parts)
        if self._bar:
            self._bar.update(self._task, completed=iteration, description=text)
        elif elapsed - self._printed >= LINE_PERIOD or iteration == self._last:
            self._printed = elapsed
            left = (self._last - iteration) * elapsed / max(iteration - self._first, 1)
            print(f"iteration {iteration}/{self._last}  {text}  {duration(left)} left", file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Return a duration as text, in seconds below two minutes."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"
