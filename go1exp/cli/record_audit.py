"""``go1exp record audit``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from go1exp.base.files import write_json
from go1exp.cli.app import App

STATUS = {"ok": 0, "suspect": 3, "bad": 4}
"""Exit status of each verdict; the worst counts."""


def _task(container: dict[str, Any]) -> int:
    from go1exp.cli.logs import files_of
    from go1exp.cli.settings import AuditSettings, parse
    from go1exp.logs.recording import RecordingError

    settings = parse(AuditSettings, container)

    from go1exp.logs.audit import AuditReport, audit_file, clock_flaws

    reports: dict[str, Any] = {}
    folders: dict[Path, dict[Path, AuditReport]] = {}
    unreadable: list[str] = []
    status = 0
    for file in files_of(settings.files):
        try:
            report = audit_file(file)
        except RecordingError as error:
            unreadable.append(str(error))
            reports[str(file)] = {"verdict": "unreadable", "message": str(error)}
            continue
        print(f"{file}\n{report.text()}\n")
        reports[str(file)] = report.as_dict()
        folders.setdefault(file.parent, {})[file] = report
        status = max(status, STATUS[report.verdict])
    for together in folders.values():
        flaws = clock_flaws(list(together.values()))
        for file, report in together.items():
            if report.episode in flaws:
                print(f"{file}: bad: {flaws[report.episode]}")
                reports[str(file)] |= {"verdict": "bad", "clocks": flaws[report.episode]}
                status = max(status, STATUS["bad"])
    if settings.out:
        out = Path(settings.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, reports)
        print(f"written to {out}")
    if unreadable:  # the others have been judged all the same
        raise RecordingError("\n".join(unreadable))
    return status


APP = App("record_audit", _task, title="record audit")
