"""Score a solver: ``python -m benchmarks.gap.score answers=FILE results=DIR [out=results.json]``.

``results`` holds one JSON per case, ``<case>.json`` or ``<case>/verdict.json``::

    {"verdict": "no gap|explained|partly explained|unexplained|not excited|bad log",
     "named": [{"effect": NAME, "joints": [...], "alias_set": [names], "status": "certified|compensating",
                "params": {parameter: {joint or "robot": value}},
                "interval": {parameter: {joint or "robot": [low, high]}}}],
     "candidates": [{"effect": NAME}],   # best first; ranks the effects of a case in which nothing is named
     "excess": {"box": held-out excess of the model within its tolerances},
     "closed": share of the held-out excess error that was removed,
     "seconds": wall time}

Instead of a mapping, ``params`` may hold one number or a list in the order of ``joints``, ``interval`` one pair or a
list of pairs. A compensating effect is a mistake on a null case and is otherwise not counted as named.

A case without a result counts as a failure of whatever it was to show, or, with ``solved=true``, not at all: for a
run that is not at its end.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gap import known
from benchmarks.gap.intervals import median, share

VISIBLE = 1.0
"""``first_visible`` counts effects that change the angles by at least this many times their noise, RMS."""

MATERIAL = 0.1
"""``in_set_material`` counts single effects whose held-out excess, all else within its tolerances, is above this
(``material`` of :class:`~go1exp.gap.result.GapSettings`, ``excess.box`` of a result): the tolerances do not suffice."""

VERDICTS = ("no gap", "explained", "partly explained", "unexplained", "not excited", "bad log")
LOWEST = 2.0
"""Single effects from this size on, in tolerances, must be found; smaller ones may be taken for tolerance."""

BARS = {
    "first": ">= 95 %",
    "in_set": ">= 98 %",
    "set_size": "<= 1.3",
    "joints_exact": ">= 90 %",
    "false_names": "0",
    "false_names_beyond": "<= 1 %",
    "outside_handled": ">= 95 %",
    "wrong_explained": "0",
    "pairs_both": ">= 85 %",
    "pair_precision": ">= 97 %",
    "param_error": "<= 3 %",
    "coverage": "90-99 %",
    "closed_median": ">= 99 %",
    "seconds_null": "<= 40",
    "seconds_single": "<= 90",
    "seconds_pair": "<= 150",
    "seconds_per_case": "<= 120",
}


@dataclass
class Solved:
    """One case, its answer and its result (None if there is none)."""

    name: str
    answer: dict[str, Any]
    result: dict[str, Any] | None

    @property
    def kind(self) -> str:
        """The case's kind."""
        return str(self.answer["kind"])

    @property
    def verdict(self) -> str:
        """The solver's verdict."""
        return "none" if self.result is None else str(self.result["verdict"])

    @property
    def named(self) -> list[dict[str, Any]]:
        """The effects that the solver certifies."""
        return [n for n in self.mentioned if n.get("status", "certified") == "certified"]

    @property
    def mentioned(self) -> list[dict[str, Any]]:
        """The effects that the solver certifies or lists as compensating."""
        return [] if self.result is None else list(self.result.get("named", []))

    @property
    def true(self) -> list[str]:
        """Names of the hidden effects of the library."""
        return [e["effect"] for e in self.answer["effects"]]

    @property
    def allowed(self) -> frozenset[str]:
        """Names that are no mistake: of the hidden effects' families, and a background that is beyond tolerance."""
        names = [*self.true, *([self.answer["background_beyond"]] if self.answer.get("background_beyond") else [])]
        collected = frozenset().union(*(known.family(n) for n in names))
        return collected.union(*(known.EQUIVALENT.get(n, frozenset()) for n in names))

    @property
    def wrong(self) -> list[str]:
        """Certified names that nothing in the case justifies."""
        return [n["effect"] for n in self.named if n["effect"] not in self.allowed]

    def ranking(self) -> list[str]:
        """Names in the solver's order, without those that only the background justifies."""
        ranked = self.named or ([] if self.result is None else self.result.get("candidates", []))
        order = [n["effect"] for n in ranked]
        beyond = self.answer.get("background_beyond")
        spare = known.family(beyond) - self.families() if beyond else frozenset()
        return [str(n) for n in order if n not in spare]

    def families(self) -> frozenset[str]:
        """Names that stand for a hidden effect."""
        return frozenset().union(*(known.family(n) | known.EQUIVALENT.get(n, frozenset()) for n in self.true))


@dataclass
class Score:
    """Figures with intervals and what went wrong.

    Attributes:
        figures: name -> (value or None, low, high, n).
        failures: figure -> lines that name a case.
        confusion: (truth, name) -> count, of single effects.
    """

    figures: dict[str, tuple[float | None, float, float, int]] = field(default_factory=dict)
    failures: dict[str, list[str]] = field(default_factory=dict)
    confusion: Counter[tuple[str, str]] = field(default_factory=Counter)

    def rate(self, name: str, cases: Iterable[tuple[Solved, bool]]) -> None:
        """Enter a share; the cases for which it fails are listed."""
        outcomes = list(cases)
        self.figures[name] = share([good for _, good in outcomes])
        self.failures[name] = [_line(case) for case, good in outcomes if not good]


def _line(case: Solved) -> str:
    truth = " + ".join(f"{e['effect']} x{e['size']:g} on {_where(e['joints'])}" for e in case.answer["effects"])
    truth = truth or case.answer.get("outside", {}).get("effect") or case.answer.get("damage") or "nothing"
    beyond = f" (background: {case.answer['background_beyond']})" if case.answer.get("background_beyond") else ""
    return f"{case.name}: {case.kind}, {truth}{beyond} -> {case.verdict} {[n['effect'] for n in case.named]}"


def _where(joints: Sequence[str]) -> str:
    return "the robot" if not joints else joints[0] if len(joints) == 1 else f"{len(joints)} joints"


def evaluate(answers: dict[str, Any], results: dict[str, dict[str, Any]]) -> Score:
    """Compare results with answers, both by case.

    Raises:
        ValueError: if a verdict or a case is unknown.
    """
    strange = [f"{k}: verdict {r.get('verdict')!r}" for k, r in results.items() if r.get("verdict") not in VERDICTS]
    strange += [f"{k}: no such case" for k in results if k not in answers]
    if strange:
        raise ValueError("; ".join(strange))
    cases = [Solved(name, answer, results.get(name)) for name, answer in sorted(answers.items())]

    def of(kind: str) -> list[Solved]:
        return [c for c in cases if c.kind == kind]

    score, singles = Score(), [c for c in of("single") if c.answer["effects"][0]["size"] >= LOWEST]
    score.rate("first", ((c, bool(c.ranking()) and c.ranking()[0] in c.families()) for c in singles))
    visible = [c for c in singles if c.answer.get("signal", 0.0) >= VISIBLE]
    score.rate("first_visible", ((c, bool(c.ranking()) and c.ranking()[0] in c.families()) for c in visible))
    score.rate("first_exact", ((c, c.ranking()[:1] == c.true) for c in singles))
    in_set = [(c, bool(_sets(c) & set(c.true)) or _equivalent(c)) for c in singles]
    score.rate("in_set", in_set)
    score.rate("in_set_material", ((c, good) for c, good in in_set if _within(c) > MATERIAL))
    sets = [len({n["effect"], *n.get("alias_set", [])}) for c in singles for n in c.named]
    score.figures["set_size"] = median(sets, np.mean)
    score.rate("joints_exact", ((c, right) for c in singles for right in _right_joints(c)))
    _misses(score, "singles_wrong", [(c, bool(c.wrong)) for c in singles])
    small = [c for c in of("single") if c.answer["effects"][0]["size"] < LOWEST]
    score.rate("small_not_wrong", ((c, not c.wrong) for c in small))
    for c in singles:
        score.confusion[c.true[0], (c.ranking() or ["-"])[0]] += 1

    nulls = [
        (c, any(n["effect"] not in c.allowed for n in c.mentioned)) for kind in ("null", "near_null") for c in of(kind)
    ]
    _misses(score, "false_name_rate", nulls)
    within = [bad for c, bad in nulls if not c.answer["background_beyond"]]
    score.figures["false_names"] = (float(sum(within)), sum(within), sum(within), len(within))
    _misses(score, "false_names_beyond", [(c, bad) for c, bad in nulls if c.answer["background_beyond"]])
    score.figures["nulls"] = (float(len(nulls)), len(nulls), len(nulls), len(nulls))
    score.rate("nulls_no_gap", ((c, c.verdict == "no gap") for c, _ in nulls if not c.answer["background_beyond"]))

    beyond = of("outside")
    left_alone = ((c, c.result is not None and (not c.wrong or c.verdict == "partly explained")) for c in beyond)
    score.rate("outside_handled", ((c, good and c.verdict != "explained") for c, good in left_alone))
    _misses(score, "wrong_explained", [(c, c.verdict == "explained") for c in beyond])
    library = singles + of("pair")
    _misses(score, "wrong_explained_library", [(c, c.verdict == "explained" and bool(c.wrong)) for c in library])

    score.rate("pairs_both", ((c, all(_recovered(c, true) for true in c.true)) for c in of("pair")))
    score.rate("pair_precision", ((c, n["effect"] in c.allowed) for c in of("pair") for n in c.named))
    score.rate("not_excited_unnamed", ((c, c.result is not None and not c.mentioned) for c in of("not_excited")))
    score.rate("not_excited_said", ((c, c.verdict == "not excited") for c in of("not_excited")))
    score.rate("damaged_caught", ((c, c.verdict == "bad log") for c in of("damaged")))
    score.rate("bad_log_only_if_bad", ((c, c.verdict != "bad log") for c in cases if c.kind != "damaged"))

    errors, inside = _parameters(library)
    score.figures["param_error"] = median(errors)
    score.figures["coverage"] = share(inside)
    closed = [float(c.result["closed"]) for c in library if c.result and c.result.get("closed") is not None]
    score.figures["closed_median"] = median(closed)
    for kinds, name in ((("null", "near_null"), "null"), (("single",), "single"), (("pair",), "pair")):
        score.figures[f"seconds_{name}"] = median([seconds for kind in kinds for seconds in _seconds(of(kind))])
    score.figures["seconds_per_case"] = median(_seconds(cases))
    score.figures["missing"] = (float(sum(c.result is None for c in cases)), 0.0, 0.0, len(cases))
    return score


def _seconds(cases: Iterable[Solved]) -> list[float]:
    """Return the wall time of every case that has one, s."""
    return [float(c.result["seconds"]) for c in cases if c.result and c.result.get("seconds") is not None]


def _misses(score: Score, name: str, cases: list[tuple[Solved, bool]]) -> None:
    """Enter the share of cases in which something bad happened, and list them."""
    score.figures[name] = share([bad for _, bad in cases])
    score.failures[name] = [_line(case) for case, bad in cases if bad]


def _within(case: Solved) -> float:
    """Return the held-out excess of the model within its tolerances; -inf where a result does not say."""
    return float(((case.result or {}).get("excess") or {}).get("box", -math.inf))


def _sets(case: Solved) -> set[str]:
    return {name for n in case.named for name in (n["effect"], *n.get("alias_set", []))}


def _equivalent(case: Solved) -> bool:
    """Whether a set was named that describes the hidden effect exactly."""
    return any(known.EQUIVALENT.get(n, frozenset({"-"})) <= _sets(case) for n in case.true)


def _right_joints(case: Solved) -> list[bool]:
    """Return whether the hidden effect of joints, where it is named, is named at its joints and at no others."""
    (true,) = case.answer["effects"]
    named = [n for n in case.named if n["effect"] == true["effect"]]
    return [set(n["joints"]) == set(true["joints"]) for n in named if true["joints"]]


def _recovered(case: Solved, true: str) -> bool:
    names = {n["effect"] for n in case.named}
    return bool(names & known.family(true)) or bool(names & known.EQUIVALENT.get(true, frozenset()))


def _parameters(cases: Iterable[Solved]) -> tuple[list[float], list[bool]]:
    """Compare what was estimated for effects that were named rightly: one relative error per parameter and case.

    An error is |estimate - truth| / |truth - null|, its median over the joints of the effect; coverage counts joints.
    """
    errors, inside = [], []
    for case in cases:
        for true in case.answer["effects"]:
            for named in case.named:
                if named["effect"] != true["effect"]:
                    continue
                for parameter in true["sizes"]:
                    if parameter in named.get("params", {}) and parameter in true["params"]:
                        e, i = _compare(true, named, parameter)
                        errors += [float(np.median(e))] if e else []
                        inside += i
    return errors, inside


def _compare(true: dict[str, Any], named: dict[str, Any], parameter: str) -> tuple[list[float], list[bool]]:
    """Return relative errors and hits of the intervals, joint by joint, of joints that both have."""
    truth = _by_joint(true["joints"], true["params"][parameter])
    estimate = _by_joint(named.get("joints", []), named["params"][parameter])
    band = named.get("interval", {}).get(parameter)
    if isinstance(band, list) and np.ndim(band) == 1:
        band = [band] * len(estimate)
    bands = {} if band is None else _by_joint(named.get("joints", []), band)
    absent = known.null(true["effect"], parameter)
    errors, inside = [], []
    for joint in truth.keys() & estimate.keys():
        size = abs(truth[joint] - absent)
        if size < 1e-12:
            continue
        errors.append(abs(estimate[joint] - truth[joint]) / size)
        if joint in bands:
            low, high = bands[joint]
            inside.append(bool(low <= truth[joint] <= high))
    return errors, inside


def _by_joint(joints: Sequence[str], values: Any) -> dict[str, Any]:
    """Return joint (or ``robot``) -> value of a number, a list in the order of ``joints``, or such a mapping."""
    if isinstance(values, dict):
        return values
    names = list(joints) or ["robot"]
    if isinstance(values, int | float):
        return dict.fromkeys(names, float(values))
    return dict(zip(names, values, strict=True))


# ---------------------------------------------------------------------- reading and showing


def read_results(folder: Path) -> dict[str, dict[str, Any]]:
    """Read ``<case>.json`` and ``<case>/verdict.json`` of a folder."""
    files = {f.stem: f for f in folder.glob("case_*.json")} | {f.parent.name: f for f in folder.glob("*/verdict.json")}
    return {name: json.loads(file.read_text()) for name, file in files.items()}


def flat(score: Score) -> dict[str, float | int | None]:
    """Return the figures as ``docs/results/gap.json`` holds them; intervals under ``<figure>_low`` and ``_high``."""
    collected: dict[str, float | int | None] = {}
    for name, (value, low, high, n) in score.figures.items():
        collected |= {name: value, f"{name}_n": n}
        if np.isfinite([low, high]).all():
            collected |= {f"{name}_low": low, f"{name}_high": high}
    return collected


def table(score: Score) -> str:
    """Return the figures, the confusion matrix and the failures as text."""
    lines = [f"{'figure':26s} {'value':>9s}  {'95 % interval':>19s} {'n':>5s}  bar"]
    for name, (value, low, high, n) in score.figures.items():
        shown = "-" if value is None else f"{value:9.3f}"
        lines.append(f"{name:26s} {shown:>9s}  [{low:8.3f}, {high:8.3f}] {n:5d}  {BARS.get(name, '')}")
    lines += ["", "first name (columns) of single effects from 2 tolerances on (rows):"]
    rows, columns = (sorted({key[k] for key in score.confusion}) for k in (0, 1))
    lines += [
        f"  {row}: " + ", ".join(f"{c} {score.confusion[row, c]}" for c in columns if score.confusion[row, c])
        for row in rows
    ]
    for name, failed in score.failures.items():
        if failed:
            lines += ["", f"{name}: {len(failed)}", *(f"  {line}" for line in failed)]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Score, print and write."""
    words = (
        "usage: python -m benchmarks.gap.score answers=FILE results=DIR [seal=OUT/SEAL] [signals=DIR] [out=FILE] "
        "[solved=true]"
    )
    given = dict(a.split("=", 1) for a in (sys.argv[1:] if arguments is None else arguments) if "=" in a)
    if not {"answers", "results"} <= set(given) <= {"answers", "results", "seal", "signals", "out", "solved"}:
        raise SystemExit(words)
    text = Path(given["answers"]).read_bytes()
    if "seal" in given and Path(given["seal"]).read_text().split()[0] != hashlib.sha256(text).hexdigest():
        raise SystemExit(f"{given['answers']}: not the answers that were sealed")
    answers = json.loads(text)
    if "signals" in given:
        for name, answer in answers.items():
            answer["signal"] = json.loads((Path(given["signals"]) / f"{name}.json").read_text())["signal"]
    results = read_results(Path(given["results"]))
    if given.get("solved") == "true":  # cases are solved in the order of names, which say nothing about them
        answers = {name: answer for name, answer in answers.items() if name in results}
    score = evaluate(answers, results)
    print(table(score))
    if "out" in given:
        Path(given["out"]).write_text(json.dumps(flat(score), indent=1) + "\n")


if __name__ == "__main__":
    main()
