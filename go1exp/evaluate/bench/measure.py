"""Timing that is robust on a busy machine: subjects run in turns, and the median of the rounds counts."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch


@dataclass(frozen=True)
class Subject:
    """A piece of work to measure: ``work()`` does one unit and returns its number of environment steps."""

    label: str
    work: Callable[[], int]


def rates(
    subjects: Mapping[str, Subject], rounds: int, seconds: float, on_round: Callable[[int, int], None]
) -> dict[str, list[float]]:
    """Return the steps per second of each subject in each round; a warm-up unit of each does not count."""
    for subject in subjects.values():
        subject.work()
    measured: dict[str, list[float]] = {name: [] for name in subjects}
    for k in range(rounds):
        for name, subject in subjects.items():
            steps, start = 0, time.perf_counter()
            # Whole units only: the time is taken after the last one.
            while (elapsed := time.perf_counter() - start) < seconds:
                steps += subject.work()
            measured[name].append(steps / elapsed)
        on_round(k + 1, rounds)
    return measured


def ratio(rates: Mapping[str, list[float]], over: str, under: str) -> float:
    """Return the median over rounds of one subject's rate over another's, taken within each round."""
    return statistics.median(a / b for a, b in zip(rates[over], rates[under], strict=True))


def machine() -> str:
    """Describe the machine and the versions that matter, one line."""
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{cpu}, {os.cpu_count()} cores, mujoco {version('mujoco-core')}, torch {torch.__version__}"
