"""Process of the simulated robot, so that the runtime imports neither torch nor the engine."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.errors import REFUSED, Expected

PATIENCE = 120.0
"""Longest time for the robot's process to start, s: importing torch is slow on a busy machine."""


class RobotError(Expected):
    """The robot is not available."""


class RefusedError(RobotError):
    """The settings of the simulated robot are wrong.

    Attributes:
        problems: one line each.
    """

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems), status=REFUSED)
        self.problems = problems


SPARE, SPARE_S = 1.5, 30.0
"""Factor and additional time by which the robot keeps more than the log, which has gaps and ends earlier."""


class SimulatedRobot(contextlib.AbstractContextManager["SimulatedRobot"]):
    """A simulated Go1 in a process of its own that listens at a port of this machine.

    Attributes:
        port: where it listens.
        report: its report of the walk, after ``close``: datagrams, and how it kept real time.
        truth: the trunk's true motion by column, with ``clock``, after ``close``; empty for a suspended robot.
        applied: the applied commands, after ``close``: rows of clock, s, and ``Robot.applied``.
    """

    def __init__(self, bundle: str, sim: Mapping[str, Any], other: Mapping[str, Any], keep: float = 120.0) -> None:
        """Start it and wait until it listens.

        Args:
            bundle: the file; the robot in it is that of training.
            sim: settings (``go1exp.deploy.sim_robot.SimConfig``).
            other: choices of ``actuator`` and ``effect`` that replace those of training.
            keep: newest seconds of the walk's log, for which truth and applied commands are kept too.

        Raises:
            RefusedError: if its settings are wrong.
            RobotError: if it does not start.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="go1exp-")
        self._truth = Path(self._folder.name) / "truth.npz"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "go1exp.deploy.sim_robot"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # leaves the other cores to the runtime
            start_new_session=True,  # Ctrl-C in the terminal must reach the runtime only
        )
        self.report: dict[str, Any] = {}
        self.truth: dict[str, np.ndarray] = {}
        self.applied: np.ndarray | None = None
        given: dict[str, object] = {"bundle": bundle, "sim": dict(sim), "robot": dict(other)}
        given |= {"truth": str(self._truth), "kept": SPARE * keep + SPARE_S}
        assert self._process.stdin is not None
        try:
            self._process.stdin.write((json.dumps(given) + "\n").encode())
            self._process.stdin.flush()
            answer = self._answer(PATIENCE)
        except OSError:
            answer = {}
        except BaseException:
            self._process.kill()  # it does not read its input yet, so closing that would not end it
            self.close()
            raise
        if answer.get("what") != "listening":
            self.close()
            if answer.get("problems"):
                raise RefusedError(answer["problems"])
            raise RobotError(f"robot=sim: {answer.get('message') or 'its process ended before it listened'}")
        self.port = int(answer["port"])
        self.pid = self._process.pid

    def _answer(self, patience: float) -> dict[str, Any]:
        """Return the next line of the process as JSON; empty if there is none in time, or only part of one."""
        assert self._process.stdout is not None
        until, text = time.monotonic() + patience, b""
        while not text.endswith(b"\n"):
            left = until - time.monotonic()
            if left <= 0 or not select.select([self._process.stdout], [], [], left)[0]:
                return {}
            part = os.read(self._process.stdout.fileno(), 65536)
            if not part:
                return {}
            text += part
        try:
            answer: dict[str, Any] = json.loads(text)
        except ValueError:  # a process that was killed while it wrote
            return {}
        return answer

    def close(self) -> None:
        """End the process and read its report."""
        if self._process.returncode is not None:
            return
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.close()  # the process ends when its input ends
            self.report = self._answer(10.0)
            self._process.wait(10.0)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        if self._truth.is_file():
            with np.load(self._truth) as file:
                rows, columns = file["rows"], [str(name) for name in file["columns"]]
                self.applied = file["applied"]
            if len(rows) and not np.isnan(rows).any():
                self.truth = dict(zip(columns, rows.T, strict=True))
        self._folder.cleanup()

    def __exit__(self, *error: object) -> None:
        self.close()
