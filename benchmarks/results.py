"""Figures of a benchmark as a file: flat JSON, with the command, the commit and the day that made them."""

from __future__ import annotations

import datetime
import json
import subprocess
from collections.abc import Mapping
from pathlib import Path


def write_results(file: Path, command: str, figures: Mapping[str, float | int | str | None]) -> None:
    """Add figures to a file, with where they come from; figures of other names in it stay.

    Args:
        file: JSON, made if it is missing.
        command: that made them, with its seed.
        figures: name -> value.
    """
    held = json.loads(file.read_text()) if file.is_file() else {}
    made_by = {**held.get("made_by", {}), command: {"commit": commit(), "date": f"{datetime.date.today()}"}}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({**held, **figures, "made_by": made_by}, indent=1) + "\n")


def commit() -> str:
    """Return the commit of this folder, with ``+`` where files differ from it; ``unknown`` outside of git."""
    here = Path(__file__).parent
    asked = ["git", "-C", str(here), "describe", "--always", "--dirty=+", "--abbrev=7", "--exclude=*"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
