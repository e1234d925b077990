"""``benchmarks/gap_real.py``: what is counted of real robots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import commands, gap_real
from go1exp.gap import files
from go1exp.gap.result import AngleErrors, GapResult, NamedEffect


def named(effect: str, low: float, high: float, status: str = "certified") -> NamedEffect:
    interval = {"bound": {"elbow": (low, high)}}
    return NamedEffect(effect, ("elbow",), {"bound": {"elbow": low}}, interval, (effect,), status)  # type: ignore[arg-type]


def answer(*effects: NamedEffect, removed: float = 0.8) -> GapResult:
    errors = AngleErrors(20, (0.02, 0.004), removed, 0.05, {}, {})
    return replace(GapResult("partly explained", "so"), named=effects, errors=errors)


def test_halves_contradict_each_other_where_intervals_of_one_joint_do_not_meet() -> None:
    low, high, near = named("coulomb", 0.1, 0.2), named("coulomb", 0.3, 0.4), named("coulomb", 0.15, 0.35)
    assert gap_real.compared([answer(low), answer(high)]) == (2, 2, 2)
    assert gap_real.compared([answer(low), answer(near)]) == (2, 2, 0)
    assert gap_real.compared([answer(low), answer(named("coulomb", 0.3, 0.4, "compensating"))]) == (1, 1, 1)
    assert gap_real.compared([answer(low), answer(named("viscous", 0.3, 0.4))]) == (2, 0, 0)
    assert gap_real.compared([answer(), answer(named("coulomb", 0.3, 0.4, "compensating"))]) == (0, 0, 0)


def test_every_second_recording_is_of_each_half(tmp_path: Path) -> None:
    logs = tmp_path / "xl330"
    logs.mkdir()
    for name in "dbac":
        (logs / f"{name}.parquet").write_text(name)
    first, second = gap_real.halves(logs)
    assert [file.name for file in sorted(first.iterdir())] == ["a.parquet", "c.parquet"]
    assert [file.name for file in sorted(second.iterdir())] == ["b.parquet", "d.parquet"]


def test_least_is_none_where_a_set_could_not_be_compared() -> None:
    flat = gap_real.figures("xl330", answer(removed=0.7)) | gap_real.figures("go2", answer(removed=0.6))
    assert gap_real.least(flat) == 0.6
    assert flat["real_after_go2_mrad"] == 4.0
    bad = replace(answer(), errors=None)
    assert gap_real.least(flat | gap_real.figures("so101", bad)) is None


def test_sets_are_asked_as_a_whole_and_by_halves_and_never_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def answering(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        asked.append(words)
        out = Path(words[-1].removeprefix("out="))
        if words[0] == "record":
            out.mkdir(parents=True)
            for k in range(gap_real.FEWEST):
                (out / f"{k}.parquet").touch()
        else:
            files.save(answer(named("coulomb", 0.1, 0.2)), out)
        return 0

    monkeypatch.setattr(commands, "run", answering)
    for _ in range(2):
        gap_real.main([f"data={tmp_path}", f"out={tmp_path / 'out'}", "sets=xl330"])
    assert [words[0] for words in asked] == ["record", "gap", "gap", "gap"]
    assert {word for words in asked[1:] for word in words if "model=" in word} == {"model=xl330_pendulum"}
    assert '"real_certified": 2' in (tmp_path / "out" / "gap.json").read_text()


@pytest.mark.parametrize("words", [["data=x"], ["data=x", "out=y", "sets=go3"], ["data=x", "out=y", "nonsense"]])
def test_what_is_wrong_with_a_call_is_said(words: list[str]) -> None:
    with pytest.raises(SystemExit, match=r"usage|sets=go3: there are xl330"):
        gap_real.main(words)
