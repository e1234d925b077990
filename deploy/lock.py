"""Takes from requirements/lock.txt what the robot's computer runs and what builds the wheel; ``make lock`` calls it.

Both parts repeat the pins and hashes of the whole, so versions are chosen in one place. Which package needs which
is read from the comments that uv leaves under each pin (``# via``).

By hand: python deploy/lock.py
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "requirements"

PARTS = {
    "deploy.txt": ("numpy", "onnxruntime", "pyarrow", "pydantic"),
    "build.txt": ("cmeel-eigen", "hatchling", "pybind11"),
}
"""File in requirements/ -> the packages it is for; what they need comes along."""


def blocks(lock: str) -> dict[str, str]:
    """Split a lock into its packages: name -> pin, hashes and comments, as they stand there."""
    found: dict[str, str] = {}
    name = ""
    for line in lock.splitlines(keepends=True):
        if line[0] not in " #\n":
            name = line.partition("==")[0]
            found[name] = ""
        if name:
            found[name] += line
    return found


def asked_by(block: str) -> set[str]:
    """Return which packages need that of a block."""
    comments = block.partition("# via")[2].replace("#", " ").split("\n")
    return {words[0] for line in comments if (words := line.split())}


def part(lock: str, wanted: tuple[str, ...]) -> str:
    """Return the lock of some packages and of everything that they need.

    Raises:
        KeyError: if the whole lock has no such package.
    """
    every = blocks(lock)
    chosen = {name: every[name] for name in wanted}
    while more := {n: b for n, b in every.items() if n not in chosen and not asked_by(b).isdisjoint(chosen)}:
        chosen |= more
    head = f"# Part of lock.txt, for {', '.join(wanted)}; written by `make lock` (deploy/lock.py).\n"
    return head + "".join(chosen[name] for name in sorted(chosen))


if __name__ == "__main__":
    whole = (FOLDER / "lock.txt").read_text()
    for file, packages in PARTS.items():
        (FOLDER / file).write_text(part(whole, packages))
