"""Asynchronous evaluation and videos of a training: another process, on the CPU engine, of the lowest priority.

The process is ``python -m go1exp.evaluate.asynchronous RUN``; jobs and results are lines of JSON. Training never waits
for it but at its end. Its results go to ``evals.csv``, to the loggers, and the best policy to ``best.pt``, whose
row is ``best.json``: always one of ``evals.csv``.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from go1exp.base.files import opened, write_bytes, write_json, write_text
from go1exp.config.schema.training import EVALUATED, ROWS
from go1exp.sim.task import TrainConfig
from go1exp.train.checkpoint import FORMAT, SUFFIX
from go1exp.train.ppo import AdaptivePPO

FOLDER, BEST, BEST_ROW, VIDEOS = "evals", "best.pt", "best.json", "videos"
"""In the run folder: policies that are evaluated, the best one, its row, videos."""

WAITING = 3
"""Jobs that may wait; a policy that would be the next one is not evaluated."""

PATIENCE = 600.0
"""Longest time to wait for results at the end of a training, s."""

MODULE = "go1exp.evaluate.asynchronous"


class AsyncEvaluation:
    """The other process, begun with the first job; with ``eval.every`` and ``video.every`` 0 there never is one.

    Args:
        config: of the training.
        run: its folder.
        iteration: that training continues from: rows of later ones are dropped.
        on_video: called with the iteration's steps and the file of each video.
    """

    def __init__(
        self, config: TrainConfig, run: Path, iteration: int, on_video: Callable[[int, Path], None] | None = None
    ) -> None:
        self._config, self._run, self._on_video = config, run, on_video
        self._process: subprocess.Popen[str] | None = None
        self._results: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._waiting, self.skipped, self.problems = 0, 0, list[str]()
        self._written, self._best = set[Path](), math.inf
        self._rows = [row for row in _rows(run / ROWS) if row["iteration"] <= iteration]
        if self._rows or any((run / name).is_file() for name in (ROWS, BEST_ROW)):
            self._restore_best(iteration)
            self._write_rows()

    def _restore_best(self, iteration: int) -> None:
        """Make best policy and rows consistent after a crash or a return to an older checkpoint.

        A lost row is restored from its copy. A best policy of a later iteration is replaced by the best of the rows,
        and stays among those that were evaluated.
        """
        best, file, kept = _row_of_best(self._run), self._run / BEST, None
        if best and file.is_file():
            fits = best["iteration"] <= iteration and all(row.keys() == best.keys() for row in self._rows)
            if fits and best["iteration"] not in [row["iteration"] for row in self._rows]:
                self._rows = sorted([*self._rows, best], key=lambda row: row["iteration"])
            policy = self._policy(best["iteration"])
            if fits:
                kept = best["iteration"]
            elif not policy.is_file():
                policy.parent.mkdir(exist_ok=True)
                write_bytes(policy, file.read_bytes())
        known = [r for r in self._rows if r["iteration"] == kept or self._policy(r["iteration"]).is_file()]
        wanted = min((r for r in known if math.isfinite(r["score"])), key=lambda row: row["score"], default=None)
        if wanted is None and best:
            file.unlink(missing_ok=True)
            (self._run / BEST_ROW).unlink()
        elif wanted and wanted["iteration"] != kept:
            self._keep(wanted, self._policy(wanted["iteration"]))
        elif wanted:
            self._best = wanted["score"]

    def _policy(self, iteration: float) -> Path:
        return self._run / FOLDER / f"{int(iteration):06d}{SUFFIX}"

    def _keep(self, row: dict[str, float], policy: Path) -> None:
        write_bytes(self._run / BEST, policy.read_bytes())
        write_json(self._run / BEST_ROW, row)
        self._best = row["score"]

    def offer(self, ppo: AdaptivePPO, last: bool) -> None:
        """Request an evaluation and a video of the policy if it is its turn, or the ``last``; return at once."""
        turns = {"evaluate": self._config.eval.every, "video": self._config.video.every}
        for kind, every in turns.items():
            if every and (last or ppo.iteration % every == 0):
                if self._waiting >= WAITING and not last:
                    self.skipped += 1
                    continue
                self._send(kind, ppo)

    def _send(self, kind: str, ppo: AdaptivePPO) -> None:
        file = self._policy(ppo.iteration)
        if file not in self._written:  # one that is there is of a training that went on from here otherwise
            self._written.add(file)
            file.parent.mkdir(exist_ok=True)
            state = {"format": FORMAT, "iteration": ppo.iteration, "num_timesteps": ppo.num_timesteps}
            with opened(file) as written:
                torch.save({**state, "policy": ppo.policy.state_dict()}, written)
        section = self._config.eval if kind == "evaluate" else self._config.video
        job: dict[str, object] = {"kind": kind, "policy": str(file), "settings": dataclasses.asdict(section)}
        job |= {"iteration": ppo.iteration, "steps": ppo.num_timesteps}
        if kind == "video":
            job["out"] = str(self._run / VIDEOS / f"{ppo.iteration:06d}.mp4")
        try:
            process = self._process or self._begin()
            assert process.stdin is not None
            process.stdin.write(json.dumps(job) + "\n")
            process.stdin.flush()
            self._waiting += 1
        except OSError as error:
            self.problems.append(f"asynchronous evaluation ended ({error.strerror})")

    def _begin(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", MODULE, str(self._run)]
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        # A session of its own: Ctrl-C is for the training, which then ends this process.
        environment = {**os.environ, **threads, "CUDA_VISIBLE_DEVICES": ""}
        self._process = subprocess.Popen(command, text=True, start_new_session=True, env=environment, **pipes)
        self._listener = threading.Thread(target=self._listen, args=(self._process,), daemon=True)
        self._listener.start()
        return self._process

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                if line.endswith("\n"):  # or it was killed while it wrote
                    self._results.put(json.loads(line))
        self._results.put(None)

    def collect(self) -> dict[str, float]:
        """Return the figures of the newest evaluation since the last call; do not wait."""
        figures: dict[str, float] = {}
        while True:
            try:
                result = self._results.get_nowait()
            except queue.Empty:
                return figures
            figures = self._take(result) or figures

    def finish(self, wait: bool) -> dict[str, float]:
        """End the process, after the jobs that wait if ``wait``; return the figures that arrived."""
        figures: dict[str, float] = {}
        if self._process is None:
            return figures
        assert self._process.stdin is not None
        if wait and self._waiting:
            print(f"waiting for {self._waiting} asynchronous evaluations and videos", flush=True)
        try:
            self._process.stdin.close()
            while wait and self._waiting:
                result = self._results.get(timeout=PATIENCE)
                figures = self._take(result) or figures
                if result is None:
                    break
        except (OSError, queue.Empty):
            self.problems.append(f"{self._waiting} evaluations and videos did not arrive")
        self._process.kill()
        self._process.wait()
        self._listener.join()
        return figures

    def _take(self, result: dict[str, Any] | None) -> dict[str, float]:
        if result is None:
            if self._waiting:
                self.problems.append("the process of evaluations and videos ended early")
                self._waiting = 0
            return {}
        self._waiting -= 1
        if problem := result.get("problem"):
            if problem not in self.problems:
                self.problems.append(problem)
            return {}
        if result["kind"] == "video":
            if self._on_video:
                self._on_video(result["steps"], Path(result["out"]))
            return {}
        row = {"iteration": result["iteration"], "steps": result["steps"], **result["figures"]}
        better = row["score"] < self._best
        self._rows.append(row)
        self._write_rows()
        if better:
            self._keep(row, Path(result["policy"]))
        return {f"{EVALUATED}{key}": float(value) for key, value in row.items() if key != "steps"}

    def _write_rows(self) -> None:
        text = io.StringIO(newline="")
        if self._rows:
            writer = csv.DictWriter(text, list(self._rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self._rows)
        write_text(self._run / ROWS, text.getvalue())


def _row_of_best(run: Path) -> dict[str, float] | None:
    """Return the row of the best policy; None if there is none, or a crash left half of it."""
    try:
        row = json.loads((run / BEST_ROW).read_text())
        return {**row, "iteration": int(row["iteration"]), "score": float(row["score"])}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _rows(file: Path) -> list[dict[str, float]]:
    if not file.is_file():
        return []
    with file.open(newline="") as text:
        rows = [row for row in csv.DictReader(text) if None not in row.values()]
    return [{k: int(v) if k in ("iteration", "steps") else float(v) for k, v in row.items()} for row in rows]
