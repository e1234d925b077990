"""How much memory is free, and whether something of a given length fits into it: the system ends what does not.

This module imports nothing of the package.
"""

from __future__ import annotations

import math
import os
from pathlib import Path


def free() -> int | None:
    """Return the memory that this process can still have, B; None where the system does not tell."""
    amounts = [amount for amount in (_of_machine(), _of_group(Path("/proc/self/cgroup"))) if amount is not None]
    return min(amounts, default=None)


def too_long(seconds: float, rate: float) -> str | None:
    """Return what is wrong with a length of time whose samples do not fit into memory; None if nothing.

    What fails for certain is refused, nothing else.

    Args:
        seconds: the length, s.
        rate: lower bound of what a second of it takes, B/s.
    """
    available = free()
    if available is None or seconds * rate <= available:
        return None
    return f"{too_much(seconds * rate, available)}; {max(available / rate, 0.0):.0f} s at most would fit"


def too_much(needed: float, available: float) -> str:
    """Word that so many bytes are needed at least where fewer are free."""
    amount = needed / 1e9 if needed < 1e300 else math.inf
    least = f"{amount:.1f}" if amount < 1e6 else f"{amount:.1e}"
    return f"takes at least {least} GB, and {available / 1e9:.1f} GB are free in memory"


def _of_machine() -> int | None:
    """Return the machine's memory that can be had without swapping, B; all of it where no more is known."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        pass  # no Linux
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None


def _of_group(membership: Path, root: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return what the limits of this process's control groups (containers, Slurm jobs) leave, B; None without one."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return None
    left: list[int] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            names, base = ("memory.max", "memory.stat", "anon"), root
        elif "memory" in controllers.split(","):
            names, base = ("memory.limit_in_bytes", "memory.stat", "rss"), root / "memory"
        else:
            continue
        group = base / path.strip("/")
        for folder in (group, *group.parents):  # a limit of any of them holds
            left += _left_in(folder, *names)
            if folder == base:
                break
    return min(left, default=None)


def _left_in(folder: Path, limit: str, statistics: str, used: str) -> list[int]:
    """Return a group's limit less what its processes use (the disk's cache does not count); empty if unlimited."""
    try:
        most = int((folder / limit).read_text())
        figures = dict(line.split() for line in (folder / statistics).read_text().splitlines())
    except (OSError, ValueError):
        return []
    return [most - int(figures.get(used, 0))]
