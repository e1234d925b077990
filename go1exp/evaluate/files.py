"""The files of an evaluation on a grid of commands: what it came to, and what each robot came to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from go1exp.base.files import write_json
from go1exp.evaluate.protocol.result import write_rows

FILE = "eval.json"
"""In a run folder; the rows are beside it."""


def rows_file(report: Path) -> Path:
    """Return the file of the rows that belong to a report."""
    return report.with_suffix(".parquet")


def write(report: dict[str, Any], out: Path) -> None:
    """Write a report of ``evaluate`` as JSON, and its rows as Parquet beside it, unless ``out`` is no plain file."""
    rows = report.pop("rows")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, report)
    if out.is_file():
        write_rows(rows_file(out), rows, {"protocol": "grid"})
