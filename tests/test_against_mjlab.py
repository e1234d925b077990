"""The comparison with mjlab, without mjlab: who works when, what becomes of a side that fails, what is printed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks import against_mjlab
from benchmarks.against_mjlab import NEEDS, Side, compare, main, missing_packages, report
from go1exp.base.paths import data_root

WORKER = """
import sys, time
from benchmarks.against_mjlab import serve
name, log, each = sys.argv[1], sys.argv[2], float(sys.argv[3])
def loop(iterations):
    print("this is no answer")
    with open(log, "a") as file:
        print(name, "begins", file=file, flush=True)
        time.sleep(iterations * each)
        print(name, "ends", file=file, flush=True)
serve(lambda: (loop, 10, {"device": name}))
"""
FAILING = "import sys; print('told at the start', file=sys.stderr); {}; sys.exit(3)"
ANSWER = 'print(\'{"about": {}, "start": 1.0}\', flush=True); sys.stdin.readline()'


def side(name: str, code: str, *arguments: str) -> Side:
    return Side(name, [sys.executable, "-c", code, name, *arguments], str(data_root()))


def test_sides_take_turns_and_only_their_own_work_counts(tmp_path: Path) -> None:
    log = tmp_path / "log"
    sides = [side("quick", WORKER, str(log), "0.002"), side("slow", WORKER, str(log), "0.004")]
    compare(sides, rounds=3, seconds=0.2)
    assert [s.failure for s in sides] == ["", ""]
    assert [s.about for s in sides] == [{"device": "quick"}, {"device": "slow"}]
    work = log.read_text().splitlines()
    pairs = list(zip(work[::2], work[1::2], strict=True))
    measured = pairs[2:]  # after both have warmed up, which may overlap
    assert all(a.split()[0] == b.split()[0] and a.endswith("begins") and b.endswith("ends") for a, b in measured)
    turns = [a.split()[0] for a, _ in measured]
    assert (
        turns == ["quick", "quick", "slow", "slow"] + ["quick", "slow"] * 2
    )  # the first time, one more to size a round
    # 10 steps in 2 ms and in 4 ms; sleep may take longer, never shorter
    assert all(0.0 < r <= 5000.0 for r in sides[0].rates)
    assert all(0.0 < r <= 2500.0 for r in sides[1].rates)
    assert len(sides[0].rates) == len(sides[1].rates) == 3


@pytest.mark.parametrize("when", ["pass", ANSWER])
def test_a_side_that_fails_says_what_it_wrote_last_and_the_other_is_measured(
    tmp_path: Path, when: str, capsys: pytest.CaptureFixture[str]
) -> None:
    sides = [side("sound", WORKER, str(tmp_path / "log"), "0.001"), side("broken", FAILING.format(when))]
    compare(sides, rounds=2, seconds=0.02)
    assert len(sides[0].rates) == 2
    assert not sides[1].rates
    text = report(sides)
    assert "FAILED after 0 rounds: ended with exit status 3" in text
    assert "told at the start" in text
    assert f"{sorted(sides[0].rates)[0]:,.0f}" in text


def test_a_side_that_does_not_answer_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(against_mjlab, "START_S", 0.2)
    mute = side("mute", "import time; time.sleep(60)")
    compare([mute], rounds=1, seconds=0.1)
    assert mute.failure.startswith("no answer within 0.2 s")


def test_the_table_has_medians_and_ratios_of_rounds_side_by_side() -> None:
    one, two = side("one", ""), side("two", "")
    one.rates, two.rates = [100.0, 300.0, 200.0], [50.0, 300.0, 50.0]
    rows = [line.split() for line in report([one, two]).splitlines() if line.startswith(("one", "two"))]
    assert rows[0] == ["one", "200", "100", "300"]
    assert rows[1] == ["two", "50", "50", "300", "2.00", "(1.00", "to", "4.00)"]


def test_what_a_folder_lacks_is_named(tmp_path: Path) -> None:
    assert missing_packages(tmp_path) == [f"{name} {wanted}".strip() for name, wanted in NEEDS.items()]
    there = {"mjlab": "1.6.0", "rsl_rl_lib": "5.4.2", "mujoco": "4.0.0", "mujoco_warp": "3.11.2", "tensordict": "0.9"}
    for name, version in there.items():
        info = tmp_path / f"{name}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n")
    assert missing_packages(tmp_path) == ["mujoco 3.11 (there is 4.0.0)"]
    with pytest.raises(SystemExit, match=r"misses mujoco 3\.11 \(there is 4\.0\.0\)[\s\S]*pip install --target"):
        main([f"site={tmp_path}"])


@pytest.mark.parametrize("wrong", [[], ["site=x", "round=3"], ["site=x", "rounds=many"], ["site=x", "own_steps=1"]])
def test_wrong_arguments_are_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit, match=r"usage|must be|true or false"):
        main(wrong)
