"""``go1exp report``."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from go1exp.cli.app import App, announce, parse, spinner
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.report.settings import ReportSettings

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.base import Chosen
    from go1exp.evaluate.report.results import Report
    from go1exp.evaluate.report.study import Study


def _task(container: dict[str, object]) -> None:
    container = dict(container)
    protocols = _protocols(container.pop("protocol"), bool(container.get("eval")))
    settings = parse(ReportSettings, container)
    folder = Path(settings.folder or Path(settings.folders[0]) / "report")
    if folder.exists() and not folder.is_dir():
        raise ConfigError([f"folder = {str(folder)!r}: is a file"])

    from go1exp.evaluate.report.study import study

    runs = study(settings.folders, settings.unfinished)
    if settings.eval:
        _evaluate(runs, settings, protocols)
    from go1exp.evaluate.report.results import report

    made = report(runs, settings, dataclasses.asdict(settings))
    announce("writing the report")

    from go1exp.evaluate.report.writing import write

    files = write(made, folder)
    print("\n".join(lines(made)))
    print(f"written to {files[0]}; {files[1].name} and {len(files) - 2} CSV files beside it")
    if settings.wandb:
        from go1exp.evaluate.report.tables import plain_rows
        from go1exp.train.metrics import log_tables

        log_tables(plain_rows(made), files[0], settings.project, settings.wandb, folder)


def _protocols(given: object, asked: bool) -> list[Chosen | None]:
    """Return what ``eval=true`` plays, None for the grid; raise ConfigError with every problem."""
    import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
    from go1exp.evaluate.protocol.base import chosen

    protocols, grid = chosen(given)
    if protocols and not asked:
        names = ",".join(c.key for c in protocols)
        raise ConfigError([f"protocol=[{names}]: is what eval=true plays; the report shows whatever runs have played"])
    return [*([None] if grid else []), *protocols]


def _evaluate(runs: Study, settings: ReportSettings, protocols: Sequence[Chosen | None]) -> None:
    import go1exp.mdp.measures  # noqa: F401  (registers them)
    from go1exp.evaluate.report.evaluating import evaluate_missing, missing
    from go1exp.evaluate.report.evaluations import check_figures, evaluations

    if settings.figures:  # before hours of evaluations
        check_figures(settings.figures, evaluations(dataclasses.replace(runs, notes=[])), protocols)

    def on_run(number: int, count: int, label: str) -> Callable[[int, int], None]:
        print(f"evaluating {number}/{count}: {label}", file=sys.stderr, flush=True)
        return spinner(1, f"evaluating {number}/{count}")

    runs.notes += evaluate_missing(missing(runs.runs, protocols), settings.evaluation, on_run)


def lines(made: Report) -> list[str]:
    """Return the lines for a terminal: groups, excluded runs, remarks, verdicts."""
    from go1exp.base.report.table import interval_text, number
    from go1exp.base.wording import counted
    from go1exp.evaluate.report.tables import about_baseline
    from go1exp.evaluate.statistics.runs import ORDER

    runs = sum(len(g.runs) for g in made.groups)
    text_lines = [f"{counted(runs, 'run')} in {counted(len(made.groups), 'group')}; {about_baseline(made)}"]
    text_lines += [f"  {counted(len(g.runs), 'run'):>8}  {g.name}" for g in made.groups]
    text_lines += [f"excluded: {a.label}: {a.state} ({a.cause})" for a in made.study.absent]
    text_lines += [f"note: {note}" for note in made.study.notes]
    for outcome in made.outcomes:
        clear = [v for v in outcome.verdicts if v.word != "no significant difference"]
        if outcome.verdicts:
            words = ", ".join(f"{sum(v.word == word for v in outcome.verdicts)} {word}" for word in ORDER)
            text_lines.append(f"{outcome.evaluation.name}: {words}")
        for v in clear:
            d = v.difference.estimate
            change = interval_text(d.estimate, d.low, d.high)
            text_lines.append(
                f"  {v.word:7} {v.group}: {v.column.name} {number(v.first)} -> {number(v.other)}, difference {change},"
                f" p {number(v.adjusted_p)}, n {d.n}"
            )
    return text_lines


APP = App("report", _task, ReportSettings)
