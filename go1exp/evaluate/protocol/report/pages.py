"""Pages of a protocol and of a comparison, and the files of a protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from go1exp.base.files import write_json, write_text
from go1exp.base.report.page import Page, provenance, render, sections
from go1exp.base.report.table import Cell, Table, number, spread, verdict
from go1exp.evaluate.protocol.claims import ORDER
from go1exp.evaluate.protocol.comparing import Difference
from go1exp.evaluate.protocol.playing import Result, as_json
from go1exp.evaluate.protocol.report.tables import (
    Meanings,
    claims_table,
    condition_text,
    falls,
    figure_tables,
    meanings,
)
from go1exp.evaluate.rows import finite, write_rows
from go1exp.evaluate.statistics.compare import ORDER as COMPARED

INTERVALS = (
    "Mean over robots with Student's 95 % interval; shares with Wilson's; falls per moving robot-minute with Garwood's;"
    " thresholds by the bootstrap over robots. n: number of robots with a value. With few robots, intervals are wide"
    " and may exceed the possible range."
)

VERDICTS = (
    "better, worse: the 95 % interval of the difference, in brackets, excludes zero; no significant difference: the"
    " interval includes zero, or there are fewer than three pairs. n: number of pairs, robots with a value for both."
    " Pairs needed: sample size for 80 % power."
)

PAIRING = (
    "All subjects play the same protocol with the same seed and the same randomisation, robot by robot. Difference ="
    " other - first, over robots with a value for both; walking quantities exclude robots that fell with either.",
    "Intervals of 95 %: Student's over robots; shares by Agresti and Min; figures of all robots together by the"
    " bootstrap. One in twenty equal quantities is expected to differ significantly by chance.",
)


def page(result: Result) -> str:
    """Return the page of one protocol, one HTML document."""
    protocol, means = result.chosen.protocol, meanings(result)
    repeats = f"; {result.repeats} bit-identical repeats excluded" if result.repeats else ""
    count = f"{len(result.played.rows)} rows, one per robot and condition{repeats}; {result.seconds:.0f} s."
    by_word = {w: [v.name.replace("_", " ") for v in result.verdicts if v.word == w] for w in reversed(ORDER)}
    settings = {"settings": dataclasses.asdict(protocol), **result.about}
    tables = [claims_table(result, means), *figure_tables(result.summary, means)]
    content = sections(tables, protocol.drawings(result.played, result.summary))
    return render(
        Page(
            title=f"{result.chosen.key}: {result.label}",
            kind=f"go1exp eval · protocol={result.chosen.key}",
            heading=result.label,
            lead=(type(protocol).__doc__ or "").strip().split("\n")[0],
            verdicts=[(f"{word}: {len(names)}", ", ".join(names)) for word, names in by_word.items() if names],
            facts=[falls(result), *result.played.notes],
            sections=[*content, provenance([count, INTERVALS], settings)],
        )
    )


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.parquet, NAME.json and NAME.html into ``folder``, which is created if missing; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{result.chosen.key}.{kind}" for kind in ("parquet", "json", "html")]
    write_rows(files[0], result.played.rows, {"protocol": result.chosen.key, "subject": result.label})
    write_json(files[1], finite(as_json(result)), indent=1, allow_nan=False)
    write_text(files[2], page(result))
    return files


# ---------------------------------------------------------------------- comparisons


def comparison(
    plays: Mapping[str, Sequence[Result]], differences: Mapping[str, Sequence[Difference]], about: Mapping[str, Any]
) -> str:
    """Return the page of a comparison.

    Args:
        plays: results of all subjects, by protocol.
        differences: of the other subjects to the first, by protocol.
        about: settings and provenance, plain data.
    """
    tables, drawings = [_counts(differences)], []
    for key, results in plays.items():
        tables.append(_differences(key, differences[key], results[0].label, meanings(results[0])))
        played, summaries = {r.label: r.played for r in results}, {r.label: r.summary for r in results}
        drawings += [
            dataclasses.replace(d, name=f"{key}-{d.name}", title=f"{key}: {d.title}")
            for d in results[0].chosen.protocol.compared(played, summaries)
        ]
    labels = [r.label for r in next(iter(plays.values()))]
    return render(
        Page(
            title=" vs. ".join(labels),
            kind="go1exp compare",
            heading=" · ".join(labels),
            lead=f"Comparison with {labels[0]}, paired by robot.",
            verdicts=_verdicts(differences),
            facts=[f"{r.chosen.key}, {r.label}: {falls(r)}" for results in plays.values() for r in results],
            sections=[*sections(tables, drawings), provenance(PAIRING, about)],
        )
    )


def _verdicts(differences: Mapping[str, Sequence[Difference]]) -> list[tuple[str, str]]:
    """Return each word with the quantities that have it, for the page's head."""
    lines = []
    for word in COMPARED:
        of_word = [f"{key}, {d.subject}: {d.quantity}" for key, ds in differences.items() for d in ds if d.word == word]
        counts = {name: of_word.count(name) for name in of_word}
        text = "; ".join(f"{name} (in {n} conditions)" if n > 1 else name for name, n in counts.items())
        if of_word:
            lines.append((f"{word}: {len(of_word)}", text if word != COMPARED[-1] else "listed below"))
    return lines


def _counts(differences: Mapping[str, Sequence[Difference]]) -> Table:
    """Return how many quantities of each subject have each verdict."""
    rows = []
    for key, those in differences.items():
        for subject in dict.fromkeys(d.subject for d in those):
            words = [d.word for d in those if d.subject == subject]
            rows.append([key, subject, *(words.count(w) for w in COMPARED)])
    return Table("Verdicts", ["protocol", "subject", *COMPARED], rows, VERDICTS)


def _differences(key: str, differences: Sequence[Difference], first: str, means: Meanings) -> Table:
    """Return the significant differences, then the others; quantities that are 0 for all subjects stand in the note."""
    quantities = list(dict.fromkeys(d.quantity for d in differences))
    not_zero = {d.quantity for d in differences if d.first != 0.0 or d.other != 0.0}
    zero = [name for name in quantities if name not in not_zero]
    subjects = list(dict.fromkeys(d.subject for d in differences))
    rows, above = [], ""
    for d in sorted(differences, key=lambda d: (COMPARED.index(d.word), quantities.index(d.quantity))):
        if d.quantity in zero:
            continue
        meaning = "" if d.quantity == above else means.get(d.quantity, ("", ""))[1]
        head = Cell(f"{d.quantity} ({d.unit})" if d.unit else d.quantity, meaning, "name")
        above = d.quantity
        between = spread(d.difference.estimate, d.difference.low, d.difference.high, f"n {d.difference.n}")
        who = [d.subject] if len(subjects) > 1 else []
        where, needed = condition_text(d.condition), "" if d.needed is None else d.needed
        rows.append([head, verdict(d.word), *who, where, number(d.first), number(d.other), between, needed])
    other = ["subject", "where", first, "subject's"] if len(subjects) > 1 else ["where", first, *subjects]
    header = ["quantity", "verdict", *other, "difference [95 %] n", "pairs needed"]
    return Table(key, header, rows, f"Omitted, 0 for all subjects: {', '.join(zero)}." if zero else "")
