"""Walks of the light runtime in real time: ``python -m benchmarks.deploy_walks bundle=FILE [seconds=12] [x=1.0]``.

``python -m go1exp.deploy`` against the simulated robot in its own process, with the Kalman filter's velocity and the
noise of Table II, at 50, 100, 200 and 400 Hz: timing of the loop, error of the estimated velocity, and error of the
walk against its command.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

RATES = (50, 100, 200, 400)


def walk(bundle: str, rate: int, seconds: float, x: float) -> dict[str, Any]:
    """Walk once; return the runtime's report.

    Raises:
        SystemExit: if the walk did not come to its end.
    """
    with tempfile.TemporaryDirectory(prefix="go1exp-") as folder:
        arguments = [bundle, "--rate", str(rate), "--seconds", str(seconds), "--command", f"{x},0,0", "--out", folder]
        arguments += ["--stale", "0.2"]  # tolerant, since the machine may be busy
        run = subprocess.run([sys.executable, "-m", "go1exp.deploy", *arguments], capture_output=True, text=True)
        if run.returncode:
            raise SystemExit(f"{rate} Hz: {run.stderr.strip() or run.stdout.strip()}")
        account: dict[str, Any] = json.loads(next(Path(folder).glob("*.json")).read_text())
    return account


def row(rate: int, account: dict[str, Any]) -> str:
    """Return a line of the table."""
    t, v = account["timing"], account["velocity"]
    period = ", ".join(f"{1e3 * t[f'period_{name}']:.2f}" for name in ("p50", "p99", "worst"))
    work = ", ".join(f"{1e3 * t[f'work_{name}']:.2f}" for name in ("p50", "p99"))
    estimate = ", ".join(f"{value:.3f}" for value in v["estimate_rmse"])
    tracking = ", ".join(f"{value:.3f}" for value in v["tracking_rmse"])
    missed = f"{100 * t['missed_share']:.2f} %"
    return f"| {rate} Hz | {period} | {work} | {missed} | {v['mean'][0]:.2f} | {estimate} | {tracking} |"


def main(arguments: Sequence[str]) -> None:
    """Walk at every rate and print a line for each."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"bundle"} <= set(given) <= {"bundle", "seconds", "x"}:
        raise SystemExit("usage: python -m benchmarks.deploy_walks bundle=FILE [seconds=12] [x=1.0]")
    print(
        "| rate | period p50, p99, worst, ms | work p50, p99, ms | missed | velocity | estimate's RMSE | walk's RMSE |"
    )
    print("|---|---|---|---|---|---|---|")
    for rate in RATES:
        account = walk(given["bundle"], rate, float(given.get("seconds", 12.0)), float(given.get("x", 1.0)))
        print(row(rate, account), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
