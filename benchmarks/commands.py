"""Commands of ``go1exp`` as a user would run them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

VERDICTS = (0, 10, 11, 12, 13, 15)
"""Exit statuses of ``go1exp gap`` that tell something of the robot, not of the logs."""


def run(*words: str, allowed: Sequence[int] = (0,)) -> int:
    """Run a command as a user would and return its exit status.

    Raises:
        SystemExit: if that is not one of ``allowed``.
    """
    print("$ go1exp", *words, flush=True)
    status = subprocess.run([sys.executable, "-m", "go1exp", *words]).returncode
    if status not in allowed:
        raise SystemExit(f"go1exp {' '.join(words)}: exit status {status}")
    return status
