"""A small fixed slice of the sealed benchmark: made by one module, solved by another, scored by a third."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.gap import cases, generate, score
from benchmarks.gap_solve import solve
from go1exp.base.paths import data_root
from go1exp.logs.recording import read_folder

SEED = 20261121

SLICE = (
    ("null", 1),
    ("single", 2 * len(cases.SUSPENDED) + cases.SUSPENDED.index("lag")),
    ("outside", 0),
    ("damaged", 2),
)
"""Kind and index: a background within tolerances, lag at 5 tolerances, one beyond the library, lost samples."""


FAST = ("damaged",)
ABOUT = ("benchmarks/gap/", "benchmarks/gap_solve.py", "go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/physics/")


@pytest.mark.parametrize(
    ("kind", "index"),
    [pytest.param(*case, id=case[0], marks=[] if case[0] in FAST else [pytest.mark.slow(*ABOUT)]) for case in SLICE],
)
def test_a_sealed_case(kind: str, index: int, tmp_path: Path) -> None:
    case = cases.make(kind, index, SEED, count=6, seconds=3.0)
    generate.write_case(case, out=tmp_path / "cases")
    solve(tmp_path / "cases" / case.name, tmp_path / "out", {})
    results = score.read_results(tmp_path / "out")
    found = score.evaluate({case.name: case.answer}, results)
    failures = {name: lines for name, lines in found.failures.items() if lines}
    if kind == "single":
        assert found.figures["first_exact"][0] == found.figures["in_set"][0] == 1.0, failures
        assert results[case.name]["verdict"] in ("explained", "partly explained")
        assert results[case.name]["closed"] > 0.9
    elif kind == "null":
        assert found.figures["false_names"][0] == 0.0, failures
    elif kind == "outside":
        assert found.figures["outside_handled"][0] == 1.0, failures
    else:
        assert results[case.name]["verdict"] == "bad log"


def test_the_bundled_case_is_what_the_generator_makes() -> None:
    """It hides dry friction at the thighs; its README says how it was made."""
    case = cases.make("single", 2, 5, 6, 3.0, ("coulomb",))
    fresh = {r.meta.episode: r for r in generate.recordings(case)}
    bundled = read_folder(data_root() / "assets/demo/suspended_go1")
    assert {r.meta.episode for r in bundled} == set(fresh)
    for recording in bundled:
        assert recording.meta == fresh[recording.meta.episode].meta
        assert abs(recording.joint("q") - fresh[recording.meta.episode].joint("q")).max() < 1e-9
    (effect,) = json.loads(generate.seal({case.name: case.answer})[0])[case.name]["effects"]
    assert effect["effect"] == "coulomb"
    assert {j.split("_")[1] for j in effect["joints"]} == {"thigh"}
