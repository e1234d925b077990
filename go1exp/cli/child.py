"""``python -m go1exp.cli.child PARENT CORES ARGUMENTS``: the command line, as a job of a launcher.

It takes its cores, ends when the launcher's process does, and waits for an older process of the same job to leave.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path

from go1exp.cli import main
from go1exp.train import run_state

PR_SET_PDEATHSIG = 1  # ``prctl(2)``: the signal to get when the parent dies

PATIENCE_S = 60.0
"""Time for which an older process of the same job may save its checkpoint; then the lock belongs to another, s."""


def end_with(parent: int) -> None:
    """Get SIGTERM, at which training saves a checkpoint and ends, when the process ``parent`` is no more.

    Where the system has no ``prctl`` (it is Linux's), an orphan goes on to its end.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if os.getppid() != parent:  # it died before prctl
            sys.exit(1)


def wait_for_older_one(run: Path) -> None:
    """Wait until no process trains in ``run``: a launcher that lost one may have started this one in its place."""
    limit = time.monotonic() + PATIENCE_S
    while run_state.in_use(run) and time.monotonic() < limit:
        time.sleep(0.2)


if __name__ == "__main__":
    parent, cores, *arguments = sys.argv[1:]
    end_with(int(parent))
    if cores:
        os.sched_setaffinity(0, [int(core) for core in cores.split(",")])
    for folder in (a.removeprefix("hydra.run.dir=") for a in arguments if a.startswith("hydra.run.dir=")):
        wait_for_older_one(Path(folder))
    sys.argv = ["go1exp", *arguments]
    sys.exit(main())
