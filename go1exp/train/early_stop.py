"""Ends a training by a rule on one of its metrics: good enough, or no better for long."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
        for k, value in _logged(run, rule.figure or ""):
            if k <= iteration:
                self._take(k, value)

    def reason(self, iteration: int, metrics: Mapping[str, Any]) -> str:
        """Return why training shall end after ``iteration`` with these metrics; empty if it shall go on."""
        rule = self._rule
        if rule.figure is None:
            return ""
        if rule.figure not in metrics:
            self._warn_once(rule.figure, metrics)
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

    def _warn_once(self, figure: str, metrics: Mapping[str, Any]) -> None:
        """Say that the rule waits for a metric that there is not; those of an evaluation come later than others."""
        if not self._warned and not figure.startswith(EVALUATED):
            self._warned = True
            warnings.warn(unknown_name("stop.figure", figure, metrics, "metric"), stacklevel=2)

    def note(self, iteration: int, reason: str) -> None:
        """Leave in the run folder that the run is complete, and by which rule."""
        write_json(self._run / FILE, {"iteration": iteration, "reason": reason, "rule": dataclasses.asdict(self._rule)})

    def _take(self, iteration: int, value: float) -> None:
        good = -value if self._rule.better == "lower" else value
        if math.isfinite(good) and (not self._since or good > self._best + self._rule.least):
            self._best, self._since = good, iteration


def _logged(run: Path, figure: str) -> list[tuple[int, float]]:
    """Return iteration and value of each row that has one; those of evaluations have a file of their own."""
    evaluated = figure.startswith(EVALUATED)
    file, figure = run / (ROWS if evaluated else "metrics.csv"), figure.removeprefix(EVALUATED)
    if not figure or not file.is_file():
        return []
    with file.open(newline="") as opened:
        rows = list(csv.DictReader(opened))
    return [(int(row["iteration"]), float(row[figure])) for row in rows if row.get(figure)]


def ended(run: Path, rule: StopRule) -> str:
    """Return why a run was ended by this rule; empty if it was not."""
    try:
        content = json.loads((run / FILE).read_text())
        same = StopRule(**content["rule"]) == rule
        return f"stopped early after iteration {content['iteration']}: {content['reason']}" if same else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""
