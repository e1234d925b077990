"""``go1exp record import``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli.app import App

if TYPE_CHECKING:
    from go1exp.logs.recording import Recording

NAMED = 3
"""Most files that a note names."""


def _task(container: dict[str, Any]) -> None:
    from go1exp.base.wording import counted
    from go1exp.cli.files import mapping_of
    from go1exp.cli.logs import writable
    from go1exp.cli.settings import ImportSettings, parse
    from go1exp.logs import recording
    from go1exp.logs.importers import import_recordings

    settings = parse(ImportSettings, container)
    options = mapping_of(settings.options, "options")
    if settings.columns is not None:
        options["columns"] = mapping_of(settings.columns, "columns")
    recordings = import_recordings(settings.source, Path(settings.path), options)
    _refuse_one_name(settings.path, [r.meta.episode for r in recordings])
    out = writable(settings.out)
    files = [out / f"{r.meta.episode}.parquet" for r in recordings]
    if present := [file.name for file in files if file.exists()]:
        print(f"note: {out} holds {_listed(present)} of an earlier call; new ones replace them (or: out=FOLDER)")
    for file, r in zip(files, recordings, strict=True):
        recording.write(file, r)
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    print(f"{counted(len(recordings), 'recording')}, {total:.0f} s, in {out}")
    for note in [*_wrong_steps(recordings), *dict.fromkeys(r.meta.notes for r in recordings if r.meta.notes)]:
        print(f"note: {note}")


def _refuse_one_name(path: str, names: Sequence[str]) -> None:
    """Raise RecordingError if two recordings of one call have one name: the second would replace the first."""
    from go1exp.logs.recording import RecordingError

    twice = [name for name, times in Counter(names).items() if times > 1]
    if twice:
        raise RecordingError(
            f"{path}: two files in it would both be {twice[0]}.parquet; "
            "import each of their folders with an out of its own"
        )


def _wrong_steps(recordings: Sequence[Recording]) -> list[str]:
    """Return what is wrong with clocks whose steps are too long or too short, one line for all of one kind."""
    from go1exp.logs.audit.limits import LEAST_STEP
    from go1exp.logs.audit.signals import Log
    from go1exp.logs.audit.single import wrong_steps

    flaws: dict[str, list[str]] = {}
    for r in recordings:
        log = Log(r)
        if len(r.t) > 1 and (message := wrong_steps(log)):
            unit = "ms" if log.dt > LEAST_STEP else "s"
            remedy = f"with source=csv, columns gives the unit: t: {{column: NAME, unit: {unit}}}"
            flaws.setdefault(f"t {message}; {remedy}", []).append(r.meta.episode)
    return [f"{_listed(episodes)}: {message}" for message, episodes in flaws.items()]


def _listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    rest = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {rest} more" if rest > 0 else "")


APP = App("record_import", _task, title="record import")
