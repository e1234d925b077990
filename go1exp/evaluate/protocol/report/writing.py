"""The files of a protocol: rows, numbers, page."""

from __future__ import annotations

from pathlib import Path

from go1exp.base.files import write_json, write_text
from go1exp.evaluate.protocol.playing import Result, as_json
from go1exp.evaluate.protocol.report.html import page
from go1exp.evaluate.rows import finite, write_rows


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.parquet, NAME.json and NAME.html into ``folder``, which is made if need be; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{result.chosen.key}.{kind}" for kind in ("parquet", "json", "html")]
    write_rows(files[0], result.played.rows, {"protocol": result.chosen.key, "subject": result.label})
    write_json(files[1], finite(as_json(result)), indent=1, allow_nan=False)
    write_text(files[2], page(result))
    return files
