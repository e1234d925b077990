"""A protocol from settings to result: played, counted, judged, written."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from go1exp import __version__
from go1exp.files import replacing, write_json, write_text
from go1exp.measures.statistics import Interval, bootstrap_interval
from go1exp.protocol.base import Chosen, Played
from go1exp.protocol.claims import Verdict, judged
from go1exp.protocol.drivers import Driver, Progress
from go1exp.protocol.quantities import Derived, Row, about, distinct, plain, resampled, summary
from go1exp.protocol.stage import Setting, Stage


@dataclass(frozen=True)
class Rates:
    """What a command line says for all protocols.

    Attributes:
        seed: seed of everything random.
        policy_dt: another period of the policy, s; None keeps that of training.
        physics_dt: another physics step, s; None keeps that of training.
    """

    seed: int
    policy_dt: float | None = None
    physics_dt: float | None = None


@dataclass
class Result:
    """What came of one protocol with one driver.

    Attributes:
        chosen: the protocol.
        label: name of the driver.
        about: its origin, the robot, seed and rates: plain data.
        played: rows without repeats, curves, notes.
        repeats: rows that repeated another one and do not count.
        summary: figures with n and interval, by condition.
        verdicts: of its claims.
        seconds: what it took, s.
    """

    chosen: Chosen
    label: str
    about: dict[str, Any]
    played: Played
    repeats: int
    summary: list[dict[str, Any]]
    verdicts: list[Verdict]
    seconds: float


def play(
    chosen: Chosen,
    driver: Driver,
    rates: Rates,
    origin: dict[str, Any] | None = None,
    on_step: Progress = lambda done, total: None,
) -> Result:
    """Play a protocol and judge it; ``origin`` is what a report shall say beside that of the driver."""
    began, protocol = time.monotonic(), chosen.protocol
    setting = Setting(
        protocol.noise, protocol.randomize, protocol.trunk_velocity, rates.seed, rates.policy_dt, rates.physics_dt
    )
    stage = Stage(driver, setting, on_step)
    stage.expect(protocol.steps(stage))
    played = protocol.play(stage)
    rows = distinct(played.rows, protocol.keys, protocol.noise or protocol.randomize)
    repeats, played.rows = len(played.rows) - len(rows), rows
    figures = summarised(chosen, rows)
    stage.finished()
    told = {"driver": driver.about, "rates": dataclasses.asdict(rates), "go1exp": __version__, **(origin or {})}
    verdicts = judged(protocol.claims, figures)
    return Result(chosen, driver.label, told, played, repeats, figures, verdicts, time.monotonic() - began)


def summarised(chosen: Chosen, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return every figure of a protocol's rows with n and interval: by condition, then those of all robots together."""
    protocol = chosen.protocol
    entries = summary(rows, protocol.keys, protocol.columns())
    for derived in protocol.derived(rows):
        interval = thresholds(derived, rows)
        figures = {derived.name: plain(interval, derived.unit)}
        entries.append({"condition": dict(derived.condition), "n": interval.n, "figures": figures})
    return entries


def thresholds(derived: Derived, rows: Sequence[Row]) -> Interval:
    """Return a figure of all robots together with its interval."""
    n, some = resampled(about(rows, derived.condition))
    return bootstrap_interval(lambda robots: derived.of(some(robots)), n)


def as_json(result: Result) -> dict[str, Any]:
    """Return a result as plain data, without its rows."""
    verdicts = [
        {
            "claim": v.name,
            "verdict": v.word,
            **{k: w for k, w in dataclasses.asdict(v.claim).items() if w is not None},
            "figure": plain(v.figure, ""),
            "condition": dict(v.condition),
            "conditions": v.of,
        }
        for v in result.verdicts
    ]
    return {
        "protocol": result.chosen.key,
        "kind": result.chosen.kind,
        "subject": result.label,
        "settings": dataclasses.asdict(result.chosen.protocol),
        **result.about,
        "repeats": result.repeats,
        "seconds": round(result.seconds, 1),
        "notes": result.played.notes,
        "claims": verdicts,
        "summary": result.summary,
        "curves": result.played.curves,
    }


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.parquet, NAME.json and NAME.html into ``folder``, which is made if need be; return the files."""
    from go1exp.protocol.report.html import page

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{result.chosen.key}.{kind}" for kind in ("parquet", "json", "html")]
    write_rows(files[0], result.played.rows, {"protocol": result.chosen.key, "subject": result.label})
    write_json(files[1], finite(as_json(result)), indent=1, allow_nan=False)
    write_text(files[2], page(result))
    return files


def write_rows(file: Path, rows: Sequence[Row], about: dict[str, str]) -> None:
    """Write rows as Parquet, ``about`` as its metadata; a figure that is not defined is null."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [finite(row.get(name)) for row in rows] for name in names}
    table = pa.table(columns).replace_schema_metadata({f"go1exp.{k}": v for k, v in about.items()})
    with replacing(file) as partial:
        pq.write_table(table, partial)


def finite(value: Any) -> Any:
    """Return plain data for JSON: numbers that are not finite as None, NumPy's as Python's."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
