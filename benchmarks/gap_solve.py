"""Run the solver on every case of a folder, unattended.

``python benchmarks/gap_solve.py cases=DIR [out=DIR] [jobs=2] [setting=value ...]``

Writes ``OUT/<case>/verdict.json`` (``OUT`` is the cases' folder unless given), which ``benchmarks.gap.score`` reads.
Knows the nominal model and the logs, no answer; a case that has its verdict is skipped, so that an interrupted run goes
on. ``key=value`` of :class:`~go1exp.gap.result.GapSettings` make ablations: ``calibrate=false`` (no tolerance box),
``selection=gain`` (no max-T), ``selection=bic`` (no held-out test), ``adequate=1e9`` (no absolute adequacy).
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

CASES_A_PROCESS = 4
"""Cases that a process solves before another takes its place: what a heap has grown to is not returned."""


def solve(case: Path, out: Path, settings: dict[str, Any]) -> str:
    """Solve one case and return a line about it."""
    import torch

    from go1exp.config.compose import compose
    from go1exp.gap import files
    from go1exp.gap.result import GapResult, GapSettings
    from go1exp.gap.stages.explain import explain
    from go1exp.logs.recording import RecordingError, read_folder
    from go1exp.sim.task import parse_parts

    torch.set_num_threads(1)
    start = time.perf_counter()
    config = parse_parts(compose("gap", ["logs=none"]), ("robot",))[0]["robot"]
    try:
        result = explain(read_folder(case), config, GapSettings(**{"overlays": 0, **settings}))
    except RecordingError as error:
        result = GapResult("bad log", str(error), seconds=time.perf_counter() - start)
    (out / case.name).mkdir(parents=True, exist_ok=True)
    files.save(result, out / case.name)
    return f"{case.name}: {result.verdict}, {result.seconds:.0f} s. {result.sentence}"


def main(arguments: Sequence[str]) -> None:
    """Solve all cases that have no verdict yet."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if "cases" not in given or len(given) != len(arguments):
        raise SystemExit("usage: python benchmarks/gap_solve.py cases=DIR [out=DIR] [jobs=2] [setting=value ...]")
    cases, jobs = Path(given.pop("cases")), int(given.pop("jobs", 2))
    out = Path(given.pop("out", cases))
    settings: Any = OmegaConf.to_container(OmegaConf.from_dotlist([f"{k}={v}" for k, v in given.items()]))
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # two processes with one thread each are faster
    todo = sorted(p for p in cases.iterdir() if p.is_dir() and any(p.glob("*.parquet")))
    todo = [case for case in todo if not (out / case.name / "verdict.json").exists()]
    work = functools.partial(solve, out=out, settings=settings)
    begun = time.monotonic()
    # Not ProcessPoolExecutor: with max_tasks_per_child it came to a standstill (Python 3.11).
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=CASES_A_PROCESS) as pool:
        for done, line in enumerate(pool.imap(work, todo), start=1):
            left = (time.monotonic() - begun) / done * (len(todo) - done)
            print(f"[{done}/{len(todo)}, {left / 60:.0f} min left] {line}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
