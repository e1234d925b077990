"""Walks of the light runtime in real time: ``python -m benchmarks.deploy_walks bundle=FILE [seconds=12] [x=1.0]``.

``[rates=50,100] [loss=0.01] [jitter=0.005]``: other rates of the policy, and what the network does to each datagram.

``python -m go1exp.deploy`` against the simulated robot in its own process, with the Kalman filter's velocity and the
noise of Table II, at 50, 100, 200 and 400 Hz: timing of the loop, error of the estimated velocity, and error of the
walk against its command. Beside them the memory of both processes, which must not grow: at half of the walk and at its
end. A walk that ends by a fault (a fall, a lost robot) ends the program with exit status 1. The walk of the bar, ten
minutes with 1 % lost and 5 ms of jitter: ``bundle=FILE rates=50 seconds=600 x=0.5 loss=0.01 jitter=0.005``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

USAGE = (
    "usage: python -m benchmarks.deploy_walks bundle=FILE "
    "[seconds=12] [x=1.0] [rates=50,100,200,400] [loss=0] [jitter=0]"
)

EVERY_S = 1.0
"""Period at which memory is read, s."""

LAST = 6
"""Readings at the end that are left out: the robot lies down, and the log is written."""

SHOWN_S = 30.0
"""Period of the lines that say how far a walk is, s."""


def memory_mib(pid: int) -> float:
    """Return the resident memory of a process and of its children, MiB; 0 for one that has ended (Linux only)."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    here = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)
    return here / 1024 + sum(memory_mib(int(child)) for child in children)


def watched(process: subprocess.Popen[str]) -> list[float]:
    """Wait for the end of a walk; return its memory, MiB, every ``EVERY_S``."""
    memory: list[float] = []
    while True:
        try:
            process.wait(EVERY_S)
        except subprocess.TimeoutExpired:
            memory.append(memory_mib(process.pid))
            if len(memory) % round(SHOWN_S / EVERY_S) == 0:
                print(f"{len(memory) * EVERY_S:.0f} s, {memory[-1]:.0f} MiB", file=sys.stderr, flush=True)
        else:
            return memory


def walk(bundle: str, rate: int, seconds: float, x: float, loss: float, jitter: float) -> dict[str, Any]:
    """Walk once; return the runtime's report, with ``memory``, MiB at half of the walk and near its end.

    Raises:
        SystemExit: if the walk did not come to its end.
    """
    with tempfile.TemporaryDirectory(prefix="go1exp-") as folder:
        arguments = [bundle, "--rate", str(rate), "--seconds", str(seconds), "--command", f"{x},0,0", "--out", folder]
        arguments += ["--stale", "0.2"]  # tolerant, since the machine may be busy
        arguments += ["--loss", str(loss), "--jitter", str(jitter)]
        with open(Path(folder) / "output", "w+") as output:
            command = [sys.executable, "-m", "go1exp.deploy", *arguments]
            run = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, text=True)
            memory = watched(run)
            output.seek(0)
            if run.returncode:
                raise SystemExit(f"{rate} Hz: exit status {run.returncode}\n{output.read()[-2000:].strip()}")
        account: dict[str, Any] = json.loads(next(Path(folder).glob("*.json")).read_text())
    walked = memory[: max(1, len(memory) - LAST)]
    account["memory"] = (walked[len(walked) // 2], walked[-1])
    return account


def row(rate: int, account: dict[str, Any]) -> str:
    """Return a line of the table."""
    t, v = account["timing"], account["velocity"]
    period = ", ".join(f"{1e3 * t[f'period_{name}']:.2f}" for name in ("p50", "p99", "worst"))
    work = ", ".join(f"{1e3 * t[f'work_{name}']:.2f}" for name in ("p50", "p99"))
    estimate = ", ".join(f"{value:.3f}" for value in v["estimate_rmse"])
    tracking = ", ".join(f"{value:.3f}" for value in v["tracking_rmse"])
    missed = f"{100 * t['missed_share']:.2f} %"
    memory = ", ".join(f"{value:.0f}" for value in account["memory"])
    ways = f"{account['link']['lost']} lost, {account['link']['late']} late"
    cells = (f"{rate} Hz", period, work, missed, f"{v['mean'][0]:.2f}", estimate, tracking, ways, memory)
    return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str]) -> None:
    """Walk at every rate and print a line for each."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    usual = {"seconds": "12", "x": "1.0", "rates": "50,100,200,400", "loss": "0", "jitter": "0"}
    if not {"bundle"} <= set(given) <= {"bundle", *usual}:
        raise SystemExit(USAGE)
    print(
        "| rate | period p50, p99, worst, ms | work p50, p99, ms | missed | velocity | estimate's RMSE | walk's RMSE "
        "| states | memory at half and end, MiB |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    usual |= given
    numbers = [float(usual[name]) for name in ("seconds", "x", "loss", "jitter")]
    for rate in map(int, usual["rates"].split(",")):
        account = walk(usual["bundle"], rate, *numbers)
        print(row(rate, account), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
