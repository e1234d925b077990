"""What evaluations of runs came to: rows of the grid of commands, and of protocols, as their folders hold them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.config.schema.registry import ConfigError, unknown_name
from go1exp.evaluate.quantities import FELL, MOVING, ROBOT, Column, columns_of
from go1exp.evaluate.report.runs import Run, Study
from go1exp.evaluate.rows import COLUMNS, FILE, KEYS, rows_file
from go1exp.mdp.measures import every_measure

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.base import Chosen, Protocol

GRID = "grid"
PROTOCOLS = "protocols"
"""Folder of other protocols in a run folder."""

MAIN = ("error_xy", "error_yaw", FELL.name)
"""Figures of the grid that are compared, unless others are asked for: few, as each takes its share of the level."""

UNJUDGED = (MOVING.name,)
"""Figures of rows that say how long they are, and nothing of a policy."""

Rows = Mapping[str, Any]


@dataclass(frozen=True)
class Evaluated:
    """The rows of one run.

    Attributes:
        table: columns (n,) by name.
        settings: of the evaluation, plain data: only equal ones are compared.
    """

    table: dict[str, NDArray[Any]]
    settings: dict[str, Any]


@dataclass
class Judged:
    """One protocol, or the grid, of all runs that were evaluated alike.

    Attributes:
        name: grid, or the protocol's.
        keys: columns that say the condition of a row.
        columns: figures.
        main: names of those that are compared.
        runs: rows by run folder.
        settings: what all of these were evaluated with.
    """

    name: str
    keys: tuple[str, ...]
    columns: tuple[Column, ...]
    main: tuple[str, ...]
    runs: dict[Path, Evaluated] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)


def names(run: Run) -> list[str]:
    """Return the evaluations that a run's folder holds."""
    of_protocols = sorted(p.stem for p in (run.folder / PROTOCOLS).glob("*.json") if rows_file(p).is_file())
    return [GRID, *of_protocols] if rows_file(run.folder / FILE).is_file() else of_protocols


def evaluations(study: Study) -> list[Judged]:
    """Return every evaluation that runs of a study have; what is left out is noted in the study."""
    known = Counter(name for run in study.runs for name in names(run))
    old = [run.label for run in study.runs if (run.folder / FILE).is_file() and GRID not in names(run)]
    if old:
        study.notes.append(f"{_listed(old)}: eval.json without eval.parquet, of an older version; eval=true makes both")
    made = [_judged(name, study) for name in [GRID, *sorted(set(known) - {GRID})] if name in known]
    for judged in made:
        lacking = [run.label for run in study.runs if judged.name not in names(run)]
        if lacking:
            study.notes.append(f"{judged.name}: no evaluation of {_listed(lacking)}" + _advice(judged.name))
    if not made:
        study.notes.append(f"no run has an evaluation; eval=true makes them ({len(study.runs)} runs)")
    return [judged for judged in made if judged.runs]


def check_figures(wanted: Sequence[str], judged: Sequence[Judged], to_come: Sequence[Chosen | None] = ()) -> None:
    """Refuse figures that no evaluation has, and those without a better direction.

    Args:
        wanted: names.
        judged: evaluations that runs have.
        to_come: protocols that will be played, None for the grid.

    Raises:
        ConfigError: with each of them, and the nearest or all that there are.
    """
    columns = [c for each in judged for c in each.columns]
    columns += [c for each in to_come for c in (each.protocol.columns() if each else _grid_columns())]
    if not columns:  # nothing is compared, and a note says so
        return
    known = {c.name for c in columns if c.better}
    problems = [unknown_name("figures", name, known, "figure") for name in wanted if name not in known]
    if problems:
        raise ConfigError(problems)


def _grid_columns() -> tuple[Column, ...]:
    return (*COLUMNS, *columns_of(every_measure(), robot.LEGS))


def _advice(name: str) -> str:
    return "; eval=true makes it" if name == GRID else f"; eval=true protocol={name} makes it"


def _listed(labels: Sequence[str]) -> str:
    return (
        labels[0] if len(labels) == 1 else f"{len(labels)} runs ({', '.join(labels[:3])}{', ...' * (len(labels) > 3)})"
    )


@dataclass(frozen=True)
class _File:
    """One file of an evaluation: its rows, the protocol that was played (None: the grid), the key columns it has."""

    evaluated: Evaluated
    protocol: Protocol | None
    keys: tuple[str, ...]

    @property
    def sign(self) -> str:
        """What is the same in files that may be compared."""
        return json.dumps([self.evaluated.settings, self.keys], sort_keys=True)


def _judged(name: str, study: Study) -> Judged:
    """Read one evaluation of all runs and keep those with the settings that most have."""
    entries: dict[Path, _File] = {}
    for run in study.runs:
        if name not in names(run):
            continue
        file = run.folder / FILE if name == GRID else run.folder / PROTOCOLS / f"{name}.json"
        try:
            entries[run.folder] = _read(name, file)
        except ConfigError as error:
            why = error.problems[0] + (f" and {len(error.problems) - 1} more" if len(error.problems) > 1 else "")
            advice = f"go1exp eval protocol={name} makes it again"
            study.notes.append(f"{file}: left out, its settings are not of this version ({why}); {advice}")
        except (OSError, ValueError, KeyError, TypeError) as error:
            study.notes.append(f"{file}: cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:100]})")
    if not entries:
        return Judged(name, (), (), ())
    usual = Counter(e.sign for e in entries.values()).most_common(1)[0][0]
    kept = {folder: e for folder, e in entries.items() if e.sign == usual}
    first = next(iter(kept.values()))
    others = [run.label for run in study.runs if run.folder in entries and run.folder not in kept]
    if others:
        other = next(e for e in entries.values() if e.sign != usual)
        differ = _differing(first.evaluated.settings, other.evaluated.settings) or "columns of the rows"
        study.notes.append(f"{name}: {_listed(others)} left out, evaluated with other settings ({differ}) than most")
    return _described(name, first, {folder: e.evaluated for folder, e in kept.items()})


def _read(name: str, file: Path) -> _File:
    """Read a file of an evaluation, and its rows beside it.

    Raises:
        ConfigError: if its protocol is none of this version.
        OSError, ValueError, KeyError, TypeError: if it is damaged.
    """
    about = json.loads(file.read_text())
    if not isinstance(about, dict):
        raise TypeError("holds no evaluation")
    evaluated = Evaluated(_table(rows_file(file)), _settings(name, about))
    if name == GRID:
        if ROBOT not in evaluated.table:
            raise ValueError(f"its rows have no column {ROBOT!r}")
        return _File(evaluated, None, tuple(key for key in KEYS if key in evaluated.table))
    from go1exp.evaluate.protocol.base import chosen

    if not isinstance(about.get("kind"), str) or not isinstance(about.get("settings"), dict):
        raise ConfigError(["it has no kind, or no settings, of a protocol"])
    protocol = chosen({name: {**about["settings"], "term": about["kind"]}})[0][0].protocol
    return _File(evaluated, protocol, tuple(key for key in (*protocol.keys, ROBOT) if key in evaluated.table))


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    return ", ".join(k for k in {**one, **other} if one.get(k) != other.get(k))


def _settings(name: str, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what decides whether two evaluations may be compared."""
    if name == GRID:
        commands = [entry["command"] for entry in about["commands"]]
        return {**about["settings"], "robot": about.get("robot", {}), "commands": commands}
    kept = ("kind", "settings", "rates", "robot")
    return {key: about[key] for key in kept if key in about}


def _table(file: Path) -> dict[str, NDArray[Any]]:
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
        textual = any(isinstance(v, str | list) for v in values)
        columns[name] = (
            np.array([json.dumps(v) if isinstance(v, list) else str(v) for v in values])
            if textual
            else np.array([np.nan if v is None else float(v) for v in values])
        )
    return columns


def _described(name: str, first: _File, runs: dict[Path, Evaluated]) -> Judged:
    """Return an evaluation with its columns, and its rows without repeats; ``first`` is one of its files."""
    settings, protocol = first.evaluated.settings, first.protocol
    if protocol is None:
        random = any(settings.get(key) for key in ("noise", "randomize", "push", "train_ground"))
        distinct = {f: e if random else _first_robots(e) for f, e in runs.items()}
        return Judged(name, KEYS, _present(_grid_columns(), runs), MAIN, distinct, settings)
    columns = _present(protocol.columns(), runs)
    known = {c.name for c in columns if c.better}
    main = [c.quantity for c in protocol.claims.values() if c.quantity in known]
    return Judged(name, protocol.keys, columns, tuple(dict.fromkeys([*main, FELL.name])), runs, settings)


def _present(columns: Sequence[Column], runs: Mapping[Path, Evaluated]) -> tuple[Column, ...]:
    """Return the figures that rows have, without those that say nothing of a policy."""
    return tuple(
        c
        for c in columns
        if c.how != "phase" and c.name not in UNJUDGED and any(c.name in e.table for e in runs.values())
    )


def _first_robots(evaluated: Evaluated) -> Evaluated:
    """Return one row of each command: without anything random all robots do the same."""
    first = evaluated.table[ROBOT] == 0.0
    return Evaluated({name: values[first] for name, values in evaluated.table.items()}, evaluated.settings)


def draws(evaluated: Evaluated) -> dict[str, NDArray[np.float64]]:
    """Return what was drawn for the robot of each row, (n,) by name."""
    from go1exp.evaluate.rows import DRAW

    return {name.removeprefix(DRAW): v for name, v in evaluated.table.items() if name.startswith(DRAW)}
