"""``go1exp record import``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from go1exp.cli.app import App


def _task(container: dict[str, Any]) -> None:
    from go1exp import recording
    from go1exp.cli.files import mapping_of
    from go1exp.cli.settings import ImportSettings, parse
    from go1exp.importers import import_recordings

    settings = parse(ImportSettings, container)
    options = mapping_of(settings.options, "options")
    if settings.columns is not None:
        options["columns"] = mapping_of(settings.columns, "columns")
    recordings = import_recordings(settings.source, Path(settings.path), options)
    out = Path(settings.out)
    for r in recordings:
        recording.write(out / f"{r.meta.episode}.parquet", r)
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    print(f"{len(recordings)} recordings, {total:.0f} s, in {out}")
    for note in dict.fromkeys(r.meta.notes for r in recordings if r.meta.notes):
        print(f"note: {note}")


APP = App("record_import", _task, title="record import")
