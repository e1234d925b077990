"""``go1exp record audit``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from go1exp.cli.app import App

STATUS = {"ok": 0, "suspect": 3, "bad": 4}
"""Exit status of each verdict; the worst counts."""


def _task(container: dict[str, Any]) -> int:
    from go1exp.audit import audit_file
    from go1exp.cli.settings import AuditSettings, parse
    from go1exp.recording import RecordingError

    settings = parse(AuditSettings, container)
    files: list[Path] = []
    for name in settings.files:
        path = Path(name)
        inside = sorted(path.glob("*.parquet"))
        if path.is_dir() and not inside:
            raise RecordingError(f"{path}: no *.parquet in it")
        files += inside if path.is_dir() else [path]
    reports = {str(file): audit_file(file) for file in files}
    for name, report in reports.items():
        print(f"{name}\n{report.text()}\n")
    if settings.out:
        out = Path(settings.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps({name: r.as_dict() for name, r in reports.items()}, indent=2) + "\n")
        print(f"written to {out}")
    return max(STATUS[r.verdict] for r in reports.values())


APP = App("record_audit", _task, title="record audit")
