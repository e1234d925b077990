"""A whole report as data, from folders to verdicts; the page, the files and the terminal show parts of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from go1exp.evaluate.report import curves as learning
from go1exp.evaluate.report.curves import Curve
from go1exp.evaluate.report.evaluations import Judged, check_figures, evaluations
from go1exp.evaluate.report.figures import Figure, Verdict, by_condition, compared, table
from go1exp.evaluate.report.groups import Group, baseline, groups
from go1exp.evaluate.report.runs import Study
from go1exp.evaluate.report.sensitivity import Sensitivity, sensitivities
from go1exp.evaluate.report.settings import ReportSettings
from go1exp.evaluate.statistics.compare import runs_that_can_tell


@dataclass(frozen=True)
class Outcome:
    """What came of one evaluation of all runs.

    Attributes:
        judged: the evaluation.
        figures: of all conditions together.
        by_condition: of each condition.
        verdicts: against the baseline; none of one group alone.
        can_tell: least number of runs in each group with which so many comparisons can tell anything; None for none.
        sensitivities: what goes with the main figures.
    """

    judged: Judged
    figures: list[Figure]
    by_condition: list[Figure]
    verdicts: list[Verdict]
    can_tell: int | None
    sensitivities: list[Sensitivity]


@dataclass(frozen=True)
class Report:
    """Everything that a report shows.

    Attributes:
        study: runs, and those that do not count.
        groups: of them.
        baseline: one of the groups.
        curves: of metrics.
        outcomes: of evaluations.
        settings: as asked for, plain data.
    """

    study: Study
    groups: list[Group]
    baseline: Group
    curves: list[Curve]
    outcomes: list[Outcome]
    settings: dict[str, Any]


def report(study: Study, settings: ReportSettings, plain: dict[str, Any]) -> Report:
    """Make the report of a study.

    Raises:
        ConfigError: if the baseline or a figure that is asked for is not there.
    """
    made = groups(study)
    first = baseline(made, settings.baseline)
    metrics: dict[Path, learning.Metrics] = {}
    for run in (run for group in made for run in group.runs):
        metrics[run.folder], remark = learning.read(run.folder, settings.curves)
        study.notes += [remark] if remark else []
    drawn, notes = learning.curves(made, metrics, settings.curves, settings.points)
    study.notes += notes
    outcomes = []
    evaluated = evaluations(study)
    check_figures(settings.figures or (), evaluated)
    for judged in evaluated:
        given = (settings.figures, settings.correction, settings.paired)
        verdicts = compared(judged, made, first, *given) if len(made) > 1 else []
        if not any(run.folder in judged.runs for run in first.runs):
            study.notes.append(f"{judged.name}: the baseline has none, so that nothing is compared with it")
        each = by_condition(judged, made)
        together = max(len(verdicts), 1) if settings.correction == "holm" else 1
        can_tell = runs_that_can_tell(settings.paired, together)
        outcomes.append(Outcome(judged, table(judged, made), each, verdicts, can_tell, sensitivities(judged, made)))
    return Report(study, made, first, drawn, outcomes, plain)
