"""``go1exp tune``."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from pathlib import Path

from go1exp.base.errors import FAILED
from go1exp.cli import hydra_main, train
from go1exp.cli.app import App, parse
from go1exp.cli.verbs import command
from go1exp.config.compose import compose_checked
from go1exp.config.schema.registry import ConfigError
from go1exp.train.sweep.tune import Range, Search, TuneSettings

FORMS = "key=interval(low,high), key=tag(log,interval(low,high)), key=range(first,end) or key=choice(a,b)"


def _ranges(space: Sequence[str]) -> dict[str, Range]:
    """Return what each key is drawn from; raise ConfigError with every entry that is no range of a key."""
    ranges: dict[str, Range] = {}
    problems = []
    for text in space:
        try:
            key, bounds = hydra_main.sweep_range(text)
            drawn = Range(**bounds)
            if reason := _empty(drawn):
                problems.append(f"space: {text!r}: {reason}")
            ranges[key] = drawn
        except (ValueError, TypeError):
            problems.append(f"space: {text!r} is none of {FORMS}")
    if problems or not ranges:
        raise ConfigError(problems or [f"space: is empty; give entries such as {FORMS}"])
    return ranges


def _empty(drawn: Range) -> str | None:
    """Return why nothing can be drawn from a range, which Optuna would refuse at the first trial; None if it can."""
    if drawn.choices:
        return None
    if not -math.inf < drawn.low <= drawn.high < math.inf:
        return "is empty; its second number must be the larger one, and both finite"
    return "a logarithm needs numbers above 0" if drawn.log and drawn.low <= 0 else None


def _tune(container: dict[str, object]) -> int | None:
    settings = parse(TuneSettings, container)
    ranges = _ranges(settings.space)
    if importlib.util.find_spec("optuna") is None:
        raise ConfigError(["needs the package optuna: pip install 'go1exp[tune]'"])

    from go1exp.config.schema.training import EVALUATED

    def planned(overrides: Sequence[str], run: Path) -> None:
        job = train.resolved(compose_checked("train", overrides), list(overrides), run)
        train.check(job)
        train.plan(job)

    lowest = [f"{key}={drawn.example}" for key, drawn in ranges.items()]
    job = train.resolved(compose_checked("train", [*settings.overrides, *lowest]), lowest, Path(settings.out))
    if settings.metric.startswith(EVALUATED) and not job.config.eval.every:
        raise ConfigError([f"metric = {settings.metric!r}: needs evaluations; add eval.every=50 to overrides"])
    train.check(job)
    best = Search(settings, ranges, planned).run()
    if best is None:
        return FAILED
    drawn = [f"{key}={value}" for key, value in best.params.items()]
    print(f"best: trial {best.number}, {settings.metric} = {best.value:.5g}")
    print(f"now: {command('train', *settings.overrides, *drawn)}")
    return None


APP = App("tune", _tune, TuneSettings)
