"""A whole report as data, from folders to verdicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from go1exp.evaluate.report import curves as learning
from go1exp.evaluate.report.curves import Curve
from go1exp.evaluate.report.evaluations import Evaluation, check_figures, evaluations
from go1exp.evaluate.report.results import Figure, Sensitivity, Verdict, by_condition, compared, figures, sensitivities
from go1exp.evaluate.report.settings import ReportSettings
from go1exp.evaluate.report.study import Group, Study, baseline, groups
from go1exp.evaluate.statistics.compare import runs_for_significance


@dataclass(frozen=True)
class Outcome:
    """Results of one evaluation of all runs.

    Attributes:
        evaluation: of all runs.
        figures: quantities over all conditions.
        by_condition: quantities of each condition.
        verdicts: comparisons with the baseline; none for a single group.
        runs_required: least number of runs per group with which a difference can be significant; None for none.
        sensitivities: correlates of the main quantities.
    """

    evaluation: Evaluation
    figures: list[Figure]
    by_condition: list[Figure]
    verdicts: list[Verdict]
    runs_required: int | None
    sensitivities: list[Sensitivity]


@dataclass(frozen=True)
class Report:
    """Content of a report.

    Attributes:
        study: included and excluded runs.
        groups: of the included runs.
        baseline: one of the groups.
        curves: of metrics.
        outcomes: of evaluations.
        settings: as requested, plain data.
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
        ConfigError: if the requested baseline or quantity does not exist.
    """
    made = groups(study)
    first = baseline(made, settings.baseline)
    metrics = {}
    for run in (run for group in made for run in group.runs):
        metrics[run.folder], remark = learning.read(run.folder, settings.curves)
        study.notes += [remark] if remark else []
    drawn, notes = learning.curves(made, metrics, settings.curves, settings.points)
    study.notes += notes
    outcomes = []
    evaluated = evaluations(study)
    check_figures(settings.figures or (), evaluated)
    for each in evaluated:
        given = (settings.figures, settings.correction, settings.paired)
        verdicts = compared(each, made, first, *given) if len(made) > 1 else []
        if not any(run.folder in each.runs for run in first.runs):
            study.notes.append(f"{each.name}: the baseline has none, so that nothing is compared with it")
        together = max(len(verdicts), 1) if settings.correction == "holm" else 1
        runs_required = runs_for_significance(settings.paired, together)
        conditions, correlates = by_condition(each, made), sensitivities(each, made)
        outcomes.append(Outcome(each, figures(each, made), conditions, verdicts, runs_required, correlates))
    return Report(study, made, first, drawn, outcomes, plain)
