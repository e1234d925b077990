"""Run ``go1exp gap explain`` on every case of a folder, unattended: ``python benchmarks/gap_solve.py CASES``.

Writes ``CASES/<case>/verdict.json``, which ``benchmarks.gap.score`` reads. Knows the nominal model and the logs, no
answer; a case that has its verdict is skipped, so that an interrupted run goes on.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch

from go1exp.compose import compose
from go1exp.config import parse_parts
from go1exp.gap import files
from go1exp.gap.explain import explain
from go1exp.gap.result import GapResult, GapSettings
from go1exp.recording import RecordingError, read_folder


def main() -> None:
    """Solve."""
    torch.set_num_threads(1)
    config = parse_parts(compose("gap", ["logs=none"]), ("robot",))[0]["robot"]
    for case in sorted(p for p in Path(sys.argv[1]).iterdir() if p.is_dir() and any(p.glob("*.parquet"))):
        if (case / files.RESULT).exists():
            continue
        start = time.perf_counter()
        try:
            result = explain(read_folder(case), config, GapSettings(overlays=0))
        except RecordingError as error:
            result = GapResult("bad log", str(error), seconds=time.perf_counter() - start)
        files.save(result, case)
        print(f"{case.name}: {result.verdict}, {result.seconds:.0f} s. {result.sentence}", flush=True)


if __name__ == "__main__":
    main()
