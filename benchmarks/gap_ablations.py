"""What each part of ``go1exp gap`` is worth: sealed cases solved with it, without one part, and by another method.

    python -m benchmarks.gap_ablations out=DIR seed=INT [methods=whole,no_box] [jobs=2]

Draws and seals one set of cases (``PLAN``), solves all of it by every method, prints a table and writes
``OUT/ablations.json`` and ``OUT/ablations.csv``. All methods see the same cases in the same order, which is that of
their random names. What is done already is not done again, so an interrupted run goes on; methods that were solved by
earlier calls are in the table with what they have. ``sysid`` needs the extra of that name.
"""

from __future__ import annotations

import csv
import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks import gap_solve, gap_sysid
from benchmarks.gap import generate, score
from benchmarks.results import write_results

PLAN: dict[str, tuple[int, str]] = {
    "null": (12, "1"),
    "near_null": (12, "1"),
    "single": (27, "3"),
    "outside": (11, "1"),
}
"""Kind -> number of cases, and size of single effects in tolerances: every effect of a suspended robot once."""

METHODS: dict[str, tuple[str, dict[str, str]]] = {
    "whole": ("the search as it is", {}),
    "no_box": ("no tolerance box: nominal values stay nominal; one term", {"calibrate": "false", "max_terms": "1"}),
    "gain": ("selected by the gain alone, no max-T", {"selection": "gain"}),
    "bic": ("selected by BIC, not by held-out windows", {"selection": "bic"}),
    "no_adequacy": ("no absolute adequacy", {"adequate": "1e9"}),
    "sysid": ("mujoco.sysid, everything at once", {}),
}
"""Name -> what it is, and its settings of :class:`~go1exp.gap.result.GapSettings`. Without the box nearly every case
asks for term after term, 4 to 6 minutes of a core; the first one says what the box is worth."""

SHOWN = {
    "false_name_rate": "false names, nulls",
    "first": "first",
    "in_set": "in set",
    "joints_exact": "joints exact",
    "singles_wrong": "wrong, singles",
    "outside_handled": "outside handled",
    "wrong_explained": "outside explained",
    "coverage": "coverage",
}
"""Figures of the table, and their columns."""


def solve(method: str, out: Path, jobs: str) -> None:
    """Solve all cases by a method, those that it has solved left out."""
    where = [f"cases={out / 'cases'}", f"out={out / method}", f"jobs={jobs}"]
    if method == "sysid":
        gap_sysid.main(where)
    else:
        gap_solve.main([*where, *(f"{key}={value}" for key, value in METHODS[method][1].items())])


def draw(out: Path, seed: int, jobs: str) -> None:
    """Draw and seal the cases of all kinds, and put them into one folder, beside which lie their answers.

    Raises:
        SystemExit: if the folder holds cases of another seed.
    """
    answers: dict[str, Any] = {}
    (out / "cases").mkdir(parents=True, exist_ok=True)
    for kind, (n, size) in PLAN.items():
        where = [f"out={out / 'drawn' / kind}", f"seed={seed}", f"kinds={kind}", f"n={n}", f"sizes={size}"]
        generate.main([*where, f"jobs={jobs}"])
        answers |= json.loads((out / "drawn" / f"{kind}.answers.json").read_text())
        for case in (out / "drawn" / kind).glob("case_*"):
            if not (link := out / "cases" / case.name).exists():
                link.symlink_to(Path("..", "drawn", kind, case.name), target_is_directory=True)
    text = (json.dumps(answers, indent=1, sort_keys=True) + "\n").encode()
    (out / "answers.json").write_bytes(text)
    (out / "SEAL").write_text(f"{hashlib.sha256(text).hexdigest()}  answers.json\n")


def rows_of(out: Path) -> list[dict[str, Any]]:
    """Return a row of figures for each method that has solved something: value, interval, n."""
    answers, rows = json.loads((out / "answers.json").read_text()), []
    for method, (about, _) in METHODS.items():
        results = score.read_results(out / method) if (out / method).is_dir() else {}
        if not results:
            continue
        figures = score.evaluate({name: answers[name] for name in results}, results).figures
        row: dict[str, Any] = {"method": method, "about": about, "cases": len(results)}
        for name in (*SHOWN, "seconds_per_case"):
            value, low, high, n = figures[name]
            row |= {name: value, f"{name}_low": low, f"{name}_high": high, f"{name}_n": n}
        rows.append(row)
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as lines for people: per cent with the 95 % interval, and n."""

    def cell(row: Mapping[str, Any], name: str) -> str:
        value, low, high, n = (row[f"{name}{end}"] for end in ("", "_low", "_high", "_n"))
        return "-" if value is None else f"{value:.0%} ({low:.0%} to {high:.0%}) of {n}"

    lines = ["  ".join([f"{'method':12}", *(f"{title:>26}" for title in SHOWN.values())])]
    lines += ["  ".join([f"{r['method']:12}", *(f"{cell(r, name):>26}" for name in SHOWN)]) for r in rows]
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Draw, solve by every method, score."""
    usage = (
        "usage: python -m benchmarks.gap_ablations out=DIR seed=INT [methods=NAME,NAME] [jobs=2]\n"
        f"methods: {', '.join(METHODS)}"
    )
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if len(given) != len(arguments) or not {"out", "seed"} <= set(given) <= {"out", "seed", "methods", "jobs"}:
        raise SystemExit(usage)
    methods = given["methods"].split(",") if "methods" in given else [*METHODS]
    if unknown := sorted({*methods} - {*METHODS}):
        raise SystemExit(f"methods={unknown[0]}: there are {', '.join(METHODS)}")
    try:
        seed = int(given["seed"])
    except ValueError:
        raise SystemExit(f"seed={given['seed']}: must be a whole number\n{usage}") from None
    if "sysid" in methods:
        gap_sysid.require()  # now, and not after hours of the others
    out, jobs = Path(given["out"]), given.get("jobs", "2")
    draw(out, seed, jobs)
    for method in methods:
        print(f"{method}: {METHODS[method][0]}", flush=True)
        solve(method, out, jobs)
    rows = rows_of(out)
    print(table(rows))
    with open(out / "ablations.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    figures = {
        f"ablation_{row['method']}_{name}{end}": row[f"{name}{end}"]
        for row in rows
        for name in SHOWN
        for end in ("", "_low", "_high", "_n")
    }
    write_results(out / "ablations.json", f"python -m benchmarks.gap_ablations seed={seed}", figures)


if __name__ == "__main__":
    main(sys.argv[1:])
