"""Ends a training by a rule on one of its metrics: good enough, or no better for long."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path

from go1exp.base.files import write_json
from go1exp.config.schema.registry import unknown_name
from go1exp.config.schema.training import EVALUATED, ROWS, StopRule

FILE = "stopped_early.json"
"""In the run folder: the rule that ended it, at which iteration and why."""


class EarlyStop:
    """Watches a metric; a run that goes on from a checkpoint looks at the logged rows up to there again."""

    def __init__(self, rule: StopRule, run: Path, iteration: int) -> None:
        self._rule, self._run = rule, run
        self._best, self._since = -math.inf, 0
        self._warned = False
        (run / FILE).unlink(missing_ok=True)
        for k, value in logged(run, rule.figure) if rule.figure else ():
            if k <= iteration:
                self._take(k, value)

    def reason(self, iteration: int, metrics: Mapping[str, float]) -> str:
        """Return why training shall end after ``iteration`` with these metrics; empty if it shall go on."""
        rule = self._rule
        if rule.figure is None:
            return ""
        if rule.figure not in metrics:
            if not self._warned and not rule.figure.startswith(EVALUATED):  # those come later than others
                self._warned = True
                warnings.warn(unknown_name("stop.figure", rule.figure, metrics, "metric"), stacklevel=2)
            return ""
        value = float(metrics[rule.figure])
        self._take(iteration, value)
        good = -value if rule.better == "lower" else value
        if rule.at is not None and good >= (-rule.at if rule.better == "lower" else rule.at):
            return f"{rule.figure} = {value:.4g} reached stop.at = {rule.at:g}"
        waited = iteration - self._since
        if rule.patience is not None and self._since and waited >= rule.patience:
            return f"{rule.figure} is no better than {abs(self._best):.4g} since iteration {self._since}"
        return ""

    def note(self, iteration: int, reason: str) -> None:
        """Leave in the run folder that the run is complete, and by which rule."""
        write_json(self._run / FILE, {"iteration": iteration, "reason": reason, "rule": dataclasses.asdict(self._rule)})

    def _take(self, iteration: int, value: float) -> None:
        good = -value if self._rule.better == "lower" else value
        if math.isfinite(good) and (not self._since or good > self._best + self._rule.least):
            self._best, self._since = good, iteration


def file_of(figure: str) -> str:
    """Return the file of a run folder that has a figure: those of evaluations have one of their own."""
    return ROWS if figure.startswith(EVALUATED) else "metrics.csv"


def logged(run: Path, figure: str) -> Iterator[tuple[int, float]]:
    """Yield iteration and value of each row that has a finite one; a row half written has none yet."""
    try:
        text = (run / file_of(figure)).read_text()
    except OSError:
        return
    for row in csv.DictReader(text[: text.rfind("\n") + 1].splitlines()):
        try:
            iteration, value = int(row["iteration"]), float(row[figure.removeprefix(EVALUATED)] or "nan")
        except (KeyError, ValueError, TypeError):
            continue
        if math.isfinite(value):
            yield iteration, value


def ended(run: Path, rule: StopRule) -> str:
    """Return why a run was ended by this rule; empty if it was not."""
    try:
        content = json.loads((run / FILE).read_text())
        same = StopRule(**content["rule"]) == rule
        return f"stopped early after iteration {content['iteration']}: {content['reason']}" if same else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""
