"""The whole sealed benchmark: ``python -m benchmarks.gap_full out=DIR seed=INT [jobs=2] [scale=1.0] [kinds=null]``.

Draws and seals the cases of every kind, solves them without their answers (``gap_solve``), scores all together, prints
the table and writes ``OUT/gap.json`` (``docs/results/gap.json`` is made of several). What is done already is not done
again, so an interrupted run goes on. ``scale`` makes all numbers of cases smaller or larger (of single effects, half
has them at the smaller size alone). ``kinds`` leaves out all others: a kind has the same cases whichever others are
drawn with it, and what earlier calls have drawn into ``OUT`` is scored with it.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import gap_solve
from benchmarks.gap import cases, generate, score
from benchmarks.results import write_results

PLAN: dict[str, tuple[int, str]] = {
    "single": (2 * len(cases.SUSPENDED), "2,5"),
    "pair": (14, "1,2,5"),
    "outside": (11, "1,2,5"),
    "damaged": (8, "1,2,5"),
    "not_excited": (6, "1,2,5"),
    "null": (104, "1,2,5"),
    "near_null": (100, "1,2,5"),
}
"""Kind -> number of cases, and sizes of single effects in tolerances: every effect of a suspended robot at both."""


def merged(out: Path, kinds: Sequence[str]) -> score.Score:
    """Score the cases of several kinds together.

    Raises:
        SystemExit: if answers are not those that were sealed.
    """
    answers: dict[str, Any] = {}
    results: dict[str, Any] = {}
    for kind in kinds:
        text = (out / f"{kind}.answers.json").read_bytes()
        if (out / kind / "SEAL").read_text().split()[0] != hashlib.sha256(text).hexdigest():
            raise SystemExit(f"{out / kind}: its answers are not those that were sealed")
        answers |= json.loads(text)
        results |= score.read_results(out / f"out_{kind}")
    return score.evaluate(answers, results)


def main(arguments: Sequence[str]) -> None:
    """Draw, solve, score."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"out", "seed"} <= set(given) <= {"out", "seed", "jobs", "scale", "kinds"}:
        raise SystemExit("usage: python -m benchmarks.gap_full out=DIR seed=INT [jobs=2] [scale=1.0] [kinds=null,pair]")
    kinds = tuple(given.get("kinds", ",".join(PLAN)).split(","))
    if unknown := sorted({*kinds} - {*PLAN}):
        raise SystemExit(f"kinds={unknown[0]}: there are {', '.join(PLAN)}")
    try:
        seed, scale = int(given["seed"]), float(given.get("scale", 1.0))
    except ValueError as error:
        raise SystemExit(f"seed must be a whole number and scale a number: {error}") from error
    out, jobs = Path(given["out"]), given.get("jobs", "2")
    for kind in kinds:
        number, sizes = PLAN[kind]
        n, drawn_with = max(1, round(scale * number)), seed + list(PLAN).index(kind)
        print(f"{kind}: {n} cases", flush=True)
        where = [f"out={out / kind}", f"seed={drawn_with}", f"kinds={kind}", f"n={n}", f"sizes={sizes}"]
        generate.main([*where, f"jobs={jobs}"])
        gap_solve.main([f"cases={out / kind}", f"out={out / f'out_{kind}'}", f"jobs={jobs}"])
    drawn = [kind for kind in PLAN if (out / kind / "SEAL").is_file()]
    total = merged(out, drawn)
    print(score.table(total))
    command = f"python -m benchmarks.gap_full seed={seed} scale={scale:g} kinds={','.join(drawn)}"
    write_results(out / "gap.json", command, score.flat(total))


if __name__ == "__main__":
    main(sys.argv[1:])
