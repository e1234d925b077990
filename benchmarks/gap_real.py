"""Real robots: ``python -m benchmarks.gap_real data=DIR out=DIR [sets=xl330,go2] [halves=true]``.

Imports each set of recordings below ``data``, asks ``go1exp gap`` as docs/notebook/gap_real.md does, and counts which
share of the angles' error is gone in the median window that no fitted value has seen. Then, with ``halves``, asks each
half of the recordings by itself, every second one in the order of their names, and compares what they certify: an
effect is contradicted by the other half if that names it at the same joint with an interval that does not meet. Writes
``OUT/gap.json``. What is done already is not done again.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import commands
from benchmarks.results import write_results
from go1exp.gap import files
from go1exp.gap.result import GapResult, NamedEffect

FEWEST = 6
"""Recordings of which halves are taken; fewer are too little for a search."""


@dataclass(frozen=True)
class Set:
    """Recordings of one robot.

    Attributes:
        importer: of ``go1exp record import``.
        folder: below the data.
        model: of ``go1exp gap``.
    """

    importer: str
    folder: str
    model: str


SETS = {
    "xl330": Set("servo_pendulum_xl330", "servo_pendulum_xl330", "xl330_pendulum"),
    "ak80_a": Set("ak80_double_pendulum", "ak80_double_pendulum/design_A_0", "ak80_double_pendulum_a"),
    "ak80_c": Set("ak80_double_pendulum", "ak80_double_pendulum/design_C_0", "ak80_double_pendulum_c"),
    "go2": Set("go2_in_air", "go2_in_air", "go2"),
    "so101": Set("so101_arm", "so101_arm", "so101"),
}


def halves(logs: Path) -> list[Path]:
    """Write every second recording to a folder of its own, in the order of names; return the two folders."""
    folders = [logs.with_name(f"{logs.name}_half{k}") for k in range(2)]
    for k, file in enumerate(sorted(logs.glob("*.parquet"))):
        folders[k % 2].mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folders[k % 2] / file.name)
    return folders


def answer(logs: Path, model: str, out: Path) -> GapResult:
    """Return what ``go1exp gap`` says of recordings."""
    if not (out / "verdict.json").is_file():
        words = (f"logs={logs}", f"model={model}", "search.threads=1", f"out={out}")
        commands.run("gap", *words, allowed=commands.VERDICTS)
    return files.load(out)


def certified(result: GapResult) -> Iterator[NamedEffect]:
    """Yield the effects that are certified."""
    return (named for named in result.named if named.status == "certified")


def contradicted(named: NamedEffect, other: GapResult) -> bool:
    """Return whether another answer names the same effect at the same joint with an interval that does not meet."""
    for same in (n for n in other.named if n.effect == named.effect):
        for name, by_joint in named.interval.items():
            for joint, (low, high) in by_joint.items():
                there = same.interval.get(name, {}).get(joint)
                if there is not None and (there[0] > high or there[1] < low):
                    return True
    return False


def compared(pair: Sequence[GapResult]) -> tuple[int, int, int]:
    """Return how many effects two halves certify, how many of these the other names too, and contradicts."""
    each = [(named, other) for one, other in (pair, pair[::-1]) for named in certified(one)]
    again = sum(any(n.effect in named.alias_set for n in other.named) for named, other in each)
    return len(each), again, sum(contradicted(named, other) for named, other in each)


def figures(name: str, result: GapResult) -> dict[str, float | int | str | None]:
    """Return the figures of one set."""
    if result.errors is None:
        return {f"real_closed_{name}": None}
    before, after = result.errors.median
    return {
        f"real_closed_{name}": result.errors.removed,
        f"real_closed_{name}_n": result.errors.windows,
        f"real_worse_{name}": result.errors.worse,
        f"real_before_{name}_mrad": 1e3 * before,
        f"real_after_{name}_mrad": 1e3 * after,
    }


def least(flat: Mapping[str, float | int | str | None]) -> float | None:
    """Return the smallest share that is gone of all sets; None if one has none."""
    shares = [flat.get(f"real_closed_{name}") for name in SETS if f"real_closed_{name}" in flat]
    known = [share for share in shares if isinstance(share, float)]
    return min(known) if known and len(known) == len(shares) else None


def main(arguments: Sequence[str]) -> None:
    """Import, search, count."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"data", "out"} <= set(given) <= {"data", "out", "sets", "halves"} or len(given) != len(arguments):
        raise SystemExit("usage: python -m benchmarks.gap_real data=DIR out=DIR [sets=xl330,go2] [halves=true]")
    names = given.get("sets", ",".join(SETS)).split(",")
    if unknown := sorted({*names} - {*SETS}):
        raise SystemExit(f"sets={unknown[0]}: there are {', '.join(SETS)}")
    data, out, totals = Path(given["data"]), Path(given["out"]), (0, 0, 0)
    flat: dict[str, float | int | str | None] = {}
    for name in names:
        recordings, logs = SETS[name], out / "logs" / name
        if not logs.is_dir():
            commands.run("record", "import", recordings.importer, str(data / recordings.folder), f"out={logs}")
        flat |= figures(name, answer(logs, recordings.model, out / name))
        print({key: value for key, value in flat.items() if key.split("_mrad")[0].endswith(name)}, flush=True)
        if given.get("halves", "true") == "true" and len(list(logs.glob("*.parquet"))) >= FEWEST:
            pair = [answer(half, recordings.model, out / half.name) for half in halves(logs)]
            totals = tuple(a + b for a, b in zip(totals, compared(pair), strict=True))  # type: ignore[assignment]
    flat |= dict(zip(("real_certified", "real_certified_again", "real_contradicted"), totals, strict=True))
    flat["real_closed_least"] = least(flat)
    write_results(out / "gap.json", f"python -m benchmarks.gap_real sets={','.join(names)}", flat)
    print(f"least share gone in the median window: {flat['real_closed_least']}")
    print("certified by a half {}, named by the other too {}, contradicted {}".format(*totals))


if __name__ == "__main__":
    main(sys.argv[1:])
