"""Evaluations of runs from their folders: rows of the grid of commands, and of protocols."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from go1exp.config.schema.registry import ConfigError, members, unknown_name
from go1exp.evaluate.protocol.base import Chosen, Protocol, chosen
from go1exp.evaluate.quantities import AXES, COLUMNS, FELL, FILE, MOVING, ROBOT, Column, columns_of, rows_file
from go1exp.evaluate.report.study import Run, Study
from go1exp.mdp.measures import every_measure

GRID = "grid"
PROTOCOLS = "protocols"  # folder of other protocols in a run folder

MAIN = ("error_xy", "error_yaw", FELL.name)
"""Quantities of the grid that are compared by default: few, as each one raises the corrected p-values."""


@dataclass(frozen=True)
class RunRows:
    """The rows of one run."""

    table: dict[str, np.ndarray]  # columns (n,) by name
    settings: dict[str, object]  # of the evaluation, plain data; only equal ones are compared
    keys: tuple[str, ...]  # columns with the condition and the robot of a row
    protocol: Protocol | None  # None for the grid

    @property
    def sign(self) -> str:
        """Key that is equal for comparable runs."""
        return json.dumps([self.settings, self.keys], sort_keys=True)


@dataclass
class Evaluation:
    """One protocol, or the grid, of all runs that were evaluated with the same settings."""

    name: str  # grid, or the protocol's
    keys: tuple[str, ...]  # columns with the condition of a row
    columns: tuple[Column, ...]
    main: tuple[str, ...]  # names of the compared quantities
    runs: dict[Path, RunRows] = field(default_factory=dict)  # rows by run folder
    settings: dict[str, object] = field(default_factory=dict)


def names(run: Run) -> list[str]:
    """Return the evaluations that a run's folder holds."""
    of_protocols = sorted(p.stem for p in (run.folder / PROTOCOLS).glob("*.json") if rows_file(p).is_file())
    return [GRID, *of_protocols] if rows_file(run.folder / FILE).is_file() else of_protocols


def evaluations(study: Study) -> list[Evaluation]:
    """Return every evaluation that runs of a study have; exclusions are noted in the study."""
    known = Counter(name for run in study.runs for name in names(run))
    if old := [run.label for run in study.runs if (run.folder / FILE).is_file() and GRID not in names(run)]:
        study.notes.append(f"{_listed(old)}: eval.json without eval.parquet; eval=true makes both")
    made = [_evaluation(name, study) for name in [GRID, *sorted(set(known) - {GRID})] if name in known]
    for evaluation in made:
        if missing := [run.label for run in study.runs if evaluation.name not in names(run)]:
            how = "" if evaluation.name == GRID else f" protocol={evaluation.name}"
            study.notes.append(f"{evaluation.name}: no evaluation of {_listed(missing)}; eval=true{how} makes it")
    if not made:
        study.notes.append(f"no run has an evaluation; eval=true makes them ({len(study.runs)} runs)")
    return [evaluation for evaluation in made if evaluation.runs]


def check_figures(wanted: Sequence[str], known: Sequence[Evaluation], to_come: Sequence[Chosen | None] = ()) -> None:
    """Refuse quantities that no evaluation has, or of no better direction; raise ConfigError with nearest names."""
    columns = [c for each in known for c in each.columns]
    columns += [c for each in to_come for c in (each.protocol.columns() if each else _grid_columns())]
    if not columns:  # nothing is compared, and a note says so
        kinds = [cast(type[Protocol], entry.target) for entry in members("protocol").values()]
        columns = [*_grid_columns(), *(c for kind in kinds for c in kind.robot_columns)]
    better = {c.name for c in columns if c.better}
    if problems := [unknown_name("figures", name, better, "figure") for name in wanted if name not in better]:
        raise ConfigError(problems)


def _grid_columns() -> tuple[Column, ...]:
    return (*COLUMNS, *columns_of(every_measure()))


def _listed(labels: Sequence[str]) -> str:
    shown = ", ".join(labels[:3]) + ", ..." * (len(labels) > 3)
    return labels[0] if len(labels) == 1 else f"{len(labels)} runs ({shown})"


def _evaluation(name: str, study: Study) -> Evaluation:
    """Read one evaluation of all runs; keep the runs with the most frequent settings."""
    entries: dict[Path, RunRows] = {}
    for run in study.runs:
        if name not in names(run):
            continue
        file = run.folder / FILE if name == GRID else run.folder / PROTOCOLS / f"{name}.json"
        try:
            entries[run.folder] = _read(name, file)
        except ConfigError as error:
            why = error.problems[0] + (f" and {len(error.problems) - 1} more" if len(error.problems) > 1 else "")
            advice = f"go1exp eval protocol={name} makes it again"
            study.notes.append(f"{file}: excluded, its settings are not of this version ({why}); {advice}")
        except (OSError, ValueError, KeyError, TypeError) as error:
            study.notes.append(f"{file}: cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:100]})")
    if not entries:
        return Evaluation(name, (), (), ())
    usual = Counter(e.sign for e in entries.values()).most_common(1)[0][0]
    kept = {folder: e for folder, e in entries.items() if e.sign == usual}
    first = next(iter(kept.values()))
    if others := [run.label for run in study.runs if run.folder in entries and run.folder not in kept]:
        one, other = first.settings, next(e.settings for e in entries.values() if e.sign != usual)
        differ = ", ".join(k for k in {**one, **other} if one.get(k) != other.get(k)) or "columns of the rows"
        study.notes.append(f"{name}: {_listed(others)} excluded, evaluated with other settings ({differ}) than most")
    return _described(name, first, kept)


def _read(name: str, file: Path) -> RunRows:
    """Read an evaluation and its rows; raise ConfigError of an unknown protocol, other errors of a damaged file."""
    about = json.loads(file.read_text())
    if not isinstance(about, dict):
        raise TypeError("holds no evaluation")
    table, settings = _table(rows_file(file)), _settings(name, about)
    if name == GRID:
        if ROBOT not in table:
            raise ValueError(f"its rows have no column {ROBOT!r}")
        return RunRows(table, settings, tuple(key for key in AXES if key in table), None)
    if not isinstance(about.get("kind"), str) or not isinstance(about.get("settings"), dict):
        raise ConfigError(["it has no kind, or no settings, of a protocol"])
    protocol = chosen({name: {**about["settings"], "term": about["kind"]}})[0][0].protocol
    return RunRows(table, settings, tuple(key for key in (*protocol.keys, ROBOT) if key in table), protocol)


def _settings(name: str, about: Mapping[str, Any]) -> dict[str, object]:
    if name == GRID:
        commands = [entry["command"] for entry in about["commands"]]
        return {**about["settings"], "robot": about.get("robot", {}), "commands": commands}
    kept = ("kind", "settings", "rates", "robot")
    return {key: about[key] for key in kept if key in about}


def _table(file: Path) -> dict[str, np.ndarray]:
    """Return the columns of a file of rows; numbers as float64 with NaN where there is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file)
    except pa.ArrowInvalid as error:
        raise ValueError(str(error)) from None
    columns = {}
    for name in table.column_names:
        values = table[name].to_pylist()
        if any(isinstance(v, str | list) for v in values):
            columns[name] = np.array([json.dumps(v) if isinstance(v, list) else str(v) for v in values])
        else:
            columns[name] = np.array([np.nan if v is None else float(v) for v in values])
    return columns


def _described(name: str, first: RunRows, runs: dict[Path, RunRows]) -> Evaluation:
    """Return an evaluation with its columns and distinct rows; ``first`` is one of its files."""
    settings, protocol = first.settings, first.protocol
    if protocol is None:
        random = any(settings.get(key) for key in ("noise", "randomize", "push", "train_ground"))
        if not random:  # all robots of a command do the same: one row of each
            firsts = {f: e.table[ROBOT] == 0.0 for f, e in runs.items()}
            runs = {f: replace(e, table={k: v[firsts[f]] for k, v in e.table.items()}) for f, e in runs.items()}
        return Evaluation(name, AXES, _present(_grid_columns(), runs), MAIN, runs, settings)
    columns = _present(protocol.columns(), runs)
    known = {c.name for c in columns if c.better}
    main = [c.quantity for c in protocol.claims.values() if c.quantity in known]
    return Evaluation(name, protocol.keys, columns, tuple(dict.fromkeys([*main, FELL.name])), runs, settings)


def _present(columns: Sequence[Column], runs: Mapping[Path, RunRows]) -> tuple[Column, ...]:
    """Return the quantities that rows have, without phases and the time in motion."""
    names = {name for rows in runs.values() for name in rows.table} - {MOVING.name}
    return tuple(c for c in columns if c.how != "phase" and c.name in names)
