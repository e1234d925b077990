"""``suite=report``: time and memory of ``go1exp report`` on a study of the size that a cluster makes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from go1exp.evaluate.report.example import make_run

RUNS, ROWS = 100, 5000
"""A study: runs, and rows of each one's metrics."""


def run(container: dict[str, Any], on_round: Callable[[int, int], None]) -> dict[str, float]:
    """Make a study of 20 configurations with five seeds each, report it in a process of its own; return the figures.

    Args:
        container: the training configuration of which the runs are variations.
        on_round: called with the progress.
    """
    with tempfile.TemporaryDirectory() as folder:
        study = Path(folder)
        for number in range(RUNS):
            make_run(study / f"run{number}", container, number, ROWS)
            on_round(number, RUNS + 1)
        command = [sys.executable, "-m", "go1exp", "report", str(study)]
        start = time.perf_counter()
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - start
        on_round(RUNS + 1, RUNS + 1)
        if status:
            raise RuntimeError(f"go1exp report ended with status {os.waitstatus_to_exitcode(status)}")
        size = (study / "report" / "report.html").stat().st_size
    busy = usage.ru_utime + usage.ru_stime
    figures = {"report_s": seconds, "report_cpu_s": busy, "report_mb": usage.ru_maxrss / 1024.0}
    return {**figures, "report_page_mb": size / 1e6}
