"""What came of a protocol, as plain data and as rows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from go1exp.base.files import replacing
from go1exp.evaluate.protocol.base import Chosen, Played
from go1exp.evaluate.protocol.claims import Verdict
from go1exp.evaluate.protocol.quantities import Row, plain


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


def as_json(result: Result) -> dict[str, Any]:
    """Return a result as plain data, without its rows."""
    verdicts = [
        {
            "claim": v.name,
            "verdict": v.word,
            **{k: w for k, w in dataclasses.asdict(v.claim).items() if w is not None},
            "figure": plain(v.figure, ""),
            "condition": dict(v.condition),
            "conditions": v.conditions,
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
