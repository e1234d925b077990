"""Two clocks as competing models: which is taken, on which windows, and what later stages make of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.config.schema.registry import ConfigError
from go1exp.gap import files
from go1exp.gap.comparison import _last_check, clock_taken, compare, prepare
from go1exp.gap.data.cutting import even_clock
from go1exp.gap.data.windows import splits
from go1exp.gap.result import ClockChoice, GapResult
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.score.initial_state import rescaled
from go1exp.gap.score.likelihood import Scorer, grouped
from go1exp.gap.search import clocks
from go1exp.gap.search.clocks import beginnings, rows_of, same_rows
from go1exp.gap.search.state import Search
from go1exp.gap.stages.apply import read_as
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import Recording
from tests import test_gap_machines as machines
from tests.test_gap_machines import few, machine, played, recording  # noqa: F401  (few is a fixture)

pytestmark = pytest.mark.usefixtures("few")
QUICK = replace(machines.QUICK, effects=("coulomb",), shortlist=1, bootstraps=0, overlays=0, confirm_fraction=0.2)
EVERY = 10
"""Steps of 0.5 ms between two rows: 200 Hz."""


def pendulum(clock: str = "compare") -> FixedBase:
    return machine("xl330_pendulum", tolerances={}, clock=clock)


@pytest.fixture(scope="module")
def motions() -> list[tuple[np.ndarray, ...]]:
    """Times, angles, true speeds and targets of four motions of the pendulum with friction within its tolerance."""
    made: list[tuple[np.ndarray, ...]] = []
    steps = np.arange(0.0, 7.0, 0.0005)
    phase = steps[:, None] * np.array([3.0, 4.0, 6.0, 8.0])
    target = (0.8 * np.sin(phase) + 0.4 * np.sin(2.3 * phase))[..., None]
    every = played(pendulum("recorded"), {"coulomb": {"bound": 0.01}}, target, 1)
    for n, fine in enumerate(np.moveaxis(every, 1, 0)):
        q = fine[::EVERY] + 2e-4 * np.random.default_rng(n).standard_normal((len(steps[::EVERY]), 1))
        made.append((steps[::EVERY], q, np.gradient(fine, 0.0005, axis=0)[::EVERY], target[::EVERY, n]))
    return made


def logs(motions: list[tuple[np.ndarray, ...]], stretched: float = 1.0, speeds: Any = lambda qd: qd) -> list[Recording]:
    """Recordings whose written times are ``stretched`` times the true ones, and whose speeds are ``speeds`` of them."""
    return [
        recording(
            ("pendulum",),
            stretched * t,
            {"q": q, "qd": speeds(qd), "q_target": target},
            kp=(3.0,),
            kd=(0.05,),
            episode=f"e{n}",
            excitation=f"motion {n}",
        )
        for n, (t, q, qd, target) in enumerate(motions)
    ]


def late(qd: np.ndarray, share: float = 0.3) -> np.ndarray:
    """Speeds behind a filter that goes a ``share`` of the way with each row: 0.3 is 15 ms."""
    slow = qd.copy()
    for k in range(1, len(qd)):
        slow[k] = slow[k - 1] + share * (qd[k] - slow[k - 1])
    return slow


def noisy(qd: np.ndarray) -> np.ndarray:
    """Speeds a tenth too large, with noise."""
    return 1.1 * qd + 0.5 * np.random.default_rng(0).standard_normal(qd.shape)


# ---------------------------------------------------------------------- what is taken


def taken(recordings: list[Recording]) -> ClockChoice:
    """Return the choice of a clock, by which the comparison goes on."""
    robot, choice = clock_taken(recordings, pendulum(), QUICK)
    assert choice is not None
    assert isinstance(robot, FixedBase)
    assert robot.config.clock == choice.taken
    return choice


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_of_stretched_times_those_of_the_speeds_are_taken(motions: list[tuple[np.ndarray, ...]]) -> None:
    choice = taken(logs(motions, stretched=1.1))
    assert (choice.taken, choice.decided, choice.reason) == ("speeds", True, "")
    assert choice.gain > choice.interval[0] > 0.0
    assert choice.errors["speeds"] < 0.5 * choice.errors["recorded"]
    assert choice.rate_hz["recorded"] == pytest.approx((200 / 1.1, 200 / 1.1), rel=1e-3)
    assert choice.rate_hz["speeds"] == pytest.approx((200, 200), rel=0.01)
    assert "The times from the speeds are taken: in the median of" in clocks.sentence(choice)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize("speeds", [late, noisy])
def test_of_speeds_that_are_wrong_the_written_times_are_taken(
    motions: list[tuple[np.ndarray, ...]], speeds: Any
) -> None:
    choice = taken(logs(motions, speeds=speeds))
    assert (choice.taken, choice.decided) == ("recorded", True)
    assert choice.gain < choice.interval[1] < 0.0
    assert choice.errors["recorded"] < choice.errors["speeds"]


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_where_both_clocks_are_right_nothing_is_decided_and_that_is_said(motions: list[tuple[np.ndarray, ...]]) -> None:
    choice = taken(logs(motions))
    assert (choice.taken, choice.decided) == ("recorded", False)
    assert choice.reason
    undecided = f"Which clock is right is not decided: {choice.reason}. The written times are taken"
    assert undecided in clocks.sentence(choice)


def test_a_clock_with_holes_in_most_windows_does_not_compete(motions: list[tuple[np.ndarray, ...]]) -> None:
    choice = taken(logs(motions, speeds=lambda qd: late(qd, 0.05)))
    assert (choice.taken, choice.decided) == ("recorded", False)
    assert "by times from the speeds only" in choice.reason
    assert "windows are without holes" in choice.reason


def test_without_speeds_there_is_one_clock(motions: list[tuple[np.ndarray, ...]]) -> None:
    several = logs(motions)
    del several[2].channels["qd_pendulum"]
    choice = taken(several)
    assert (choice.taken, choice.decided) == ("recorded", False)
    assert choice.reason == "1 of 4 recordings have no speeds, so there is one clock only"
    assert choice.errors == {}
    assert "The clocks could not be compared: 1 of 4" in clocks.details(choice)


def test_too_few_windows_decide_nothing(motions: list[tuple[np.ndarray, ...]]) -> None:
    short = [Recording(r.meta, {name: v[:200] for name, v in r.channels.items()}) for r in logs(motions)[:3]]
    choice = taken(short)
    assert not choice.decided
    assert "stretches of held-out windows remain" in choice.reason


def test_uneven_written_times_are_told() -> None:
    even = ClockChoice("recorded", False, "so", steps=(1.0, 1.0))
    assert "uneven" not in clocks.details(even)
    assert "uneven: nine of ten steps are 0.8 to 1.3 of the median" in clocks.details(replace(even, steps=(0.8, 1.3)))


# ---------------------------------------------------------------------- how it is decided


def choice_of(**figures: Any) -> ClockChoice:
    usual: dict[str, Any] = {"gain": 0.3, "p": 0.001, "nominal_gain": 0.2, "nominal_p": 0.2, "stretches": 12}
    return ClockChoice("recorded", False, "", **(usual | figures))


@pytest.mark.parametrize(
    ("figures", "taken", "reason"),
    [
        ({}, "speeds", ""),
        ({"gain": -0.3}, "recorded", ""),
        ({"p": 0.02}, "recorded", "not significant (p = 0.02 of 12 stretches)"),
        ({"gain": 0.015}, "recorded", "the two do as well"),
        ({"nominal_gain": -0.2, "nominal_p": 0.001}, "recorded", "the other clock is the better one"),
        ({"nominal_gain": -0.2, "nominal_p": 0.2}, "speeds", ""),
    ],
)
def test_a_clock_is_taken_only_if_the_figures_prefer_it(figures: dict[str, Any], taken: str, reason: str) -> None:
    choice = clocks.decided(choice_of(**figures), 0.01)
    assert (choice.taken, choice.decided) == (taken, not reason)
    assert reason in choice.reason


def test_windows_of_one_stretch_count_as_one() -> None:
    """Twelve windows in four stretches: of 2^4 flips 2 are as large, and never fewer however many windows there are."""
    recorded, speeds = np.full(12, 2.0), np.full(12, 1.0)
    rng = np.random.default_rng(0)
    gain, interval, p = clocks.compared({"recorded": recorded, "speeds": speeds}, np.repeat(np.arange(4), 3), rng)
    assert (gain, *interval) == pytest.approx((1.0, 1.0, 1.0))
    assert p == pytest.approx(2 / 16, abs=0.02)
    gain, interval, p = clocks.compared({"recorded": recorded, "speeds": speeds}, np.arange(12), rng)
    assert p < 0.005
    swapped, (low, high), _ = clocks.compared({"recorded": speeds, "speeds": recorded}, np.arange(12), rng)
    assert (swapped, low, high) == pytest.approx((-1.0, -1.0, -1.0))


def test_every_window_judges_once_by_a_fit_that_has_not_seen_it(
    motions: list[tuple[np.ndarray, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a search that does nothing, and twice the same clock: no difference at all."""
    comparison = compare(logs(motions), pendulum("recorded"), QUICK)
    parts = comparison.split(np.random.default_rng(0))
    made: list[Any] = []

    def nothing(search: Search) -> Search:
        made.append(search.splits)
        return search

    monkeypatch.setattr(clocks, "run", nothing)
    side = clocks.Contestant(comparison.scorer, comparison.dt)
    choice = clocks.contest({"recorded": side, "speeds": side}, parts, QUICK)
    assert len(made) == 4
    for half in made:
        assert not set(half.train) & set(half.select)
        assert not set(parts.confirm) & {*half.train, *half.select}
    judging = np.concatenate([half.select for half in made[::2]])
    assert sorted(judging) == sorted([*parts.train, *parts.select])
    assert choice.windows == len(judging)
    assert (choice.gain, *choice.interval, choice.p) == (0.0, 0.0, 0.0, 1.0)
    assert choice.errors["recorded"] == choice.errors["speeds"] > 0.0
    assert choice.reason == "the two do as well"


# ---------------------------------------------------------------------- the windows


def test_both_clocks_are_judged_on_the_same_rows(motions: list[tuple[np.ndarray, ...]]) -> None:
    several, robot = logs(motions, stretched=1.1), pendulum()
    ready = {name: prepare(several, robot.by_clock(name, "ignored"), QUICK)[1] for name in ("recorded", "speeds")}
    recordings = {name: each.recordings for name, each in ready.items()}
    spared = [np.zeros(len(r.t), dtype=bool) for r in several]
    spared[0][300:700] = True
    cuts: Any = {n: lambda places, n=n: robot.by_clock(n, "ignored").windows(ready[n], places) for n in ready}
    windows, left = same_rows(recordings, cuts, QUICK, spared)
    first, second = windows["recorded"], windows["speeds"]
    assert len(first) == len(second) > 40
    assert left == {"recorded": len(first), "speeds": len(first)}
    np.testing.assert_array_equal(first.scale, second.scale)
    np.testing.assert_array_equal(first.q_sd, second.q_sd)
    for k in range(len(first)):
        assert first.episode[k] == second.episode[k]
        np.testing.assert_array_equal(first.y[k, first.valid[k], 0], second.y[k, second.valid[k], 0])
        assert 35 < first.valid[k].sum() <= 51
    lasting = [np.median([np.ptp(w.t[k, w.valid[k]]) for k in range(len(w))]) for w in (first, second)]
    assert lasting[1] / lasting[0] == pytest.approx(1 / 1.1, rel=0.02)
    taken = rows_of(first, np.arange(len(first)), recordings["recorded"])
    assert not (taken[0] & spared[0]).any()
    assert sum(mask.sum() for mask in taken) > 2000


def test_a_window_begins_where_the_motion_is_smooth() -> None:
    t = np.arange(0.0, 3.0, 0.005)
    q = np.sin(4 * t)[:, None]
    q[150:160, 0] += 0.1 * np.random.default_rng(0).standard_normal(10)
    rows = beginnings([t, 0.9 * t], q, QUICK, np.zeros(len(t), dtype=bool))
    assert np.all(np.diff(rows) >= 0.3 / 0.0045 * 0.6)
    assert not any(145 <= row <= 165 for row in rows)
    assert beginnings([t], q, QUICK, np.ones(len(t), dtype=bool)) == []


def test_the_last_check_of_neither_clock_has_a_part_in_the_choice(motions: list[tuple[np.ndarray, ...]]) -> None:
    """What is spared is what the search itself keeps: the same split of the same windows."""
    several, robot = logs(motions, stretched=1.1), pendulum()
    for name in ("recorded", "speeds"):
        kept = _last_check(several, robot.by_clock(name), QUICK)
        comparison = compare(several, robot.by_clock(name), QUICK)
        parts = comparison.split(np.random.default_rng(QUICK.seed))
        assert len(parts.confirm) > 5
        again = rows_of(comparison.windows, parts.confirm, comparison.recordings)
        for one, two in zip(kept, again, strict=True):
            np.testing.assert_array_equal(one, two)
        others = np.setdiff1d(np.arange(len(comparison.windows)), parts.confirm)
        clock = [even_clock(r) for r in comparison.recordings]
        first = np.searchsorted(clock[0], comparison.windows.begin[others][comparison.windows.episode[others] == 0])
        assert not kept[0][first].all()
    metas = [r.meta for r in several]
    assert len(splits(metas, np.zeros(9, dtype=int), 0.0, np.random.default_rng(0)).confirm) == 0


def test_a_floor_is_changed_leg_by_leg() -> None:
    """Of a robot of several groups, columns of the initial state are in units of the joint's own noise."""
    machine_of_two: Any = SimpleNamespace(groups=((0, 2), (1, 3)), joints=tuple("abcd"))
    windows: Any = SimpleNamespace(t=np.zeros((3, 5)))
    rng = np.random.default_rng(0)
    scale, factor, change = (
        rng.uniform(1, 2, (3, 2, 4)),
        rng.uniform(1, 2, (3, 2, 4)),
        rng.standard_normal((3, 5, 2, 4)),
    )
    replayer: Any = SimpleNamespace(machine=machine_of_two, windows=windows)
    score = Scorer(replayer, scale, grouped(machine_of_two, change / scale[:, None])[..., None])
    again = rescaled(score, factor)
    np.testing.assert_allclose(again.scale, scale * factor)
    direct = grouped(machine_of_two, change / (scale * factor)[:, None])[..., None]
    np.testing.assert_allclose(again.state, direct, rtol=1e-6)


# ---------------------------------------------------------------------- what becomes of it


@pytest.mark.slow("go1exp/gap/")
def test_an_answer_says_its_clock_and_later_stages_read_it_back(
    motions: list[tuple[np.ndarray, ...]], tmp_path: Path
) -> None:
    result = explain(logs(motions, stretched=1.1), pendulum(), QUICK)
    assert result.clock is not None
    assert result.clock.taken == "speeds"
    assert "The times from the speeds are taken: in the median of" in result.sentence
    assert any("Rows come at 181.8 Hz by written times" in line for line in result.warnings)
    assert any(line.startswith("Times were worked out from speeds") for line in result.warnings)
    files.save(result, tmp_path)
    again = files.load(tmp_path)
    assert again.clock == result.clock
    later = read_as(pendulum(), again)
    assert isinstance(later, FixedBase)
    assert later.config.clock == "speeds"


def test_a_result_by_another_clock_is_refused() -> None:
    plain = GapResult("no gap", "")
    compared = replace(plain, clock=ClockChoice("speeds", True))
    assert read_as(pendulum("recorded"), plain).config.clock == "recorded"  # type: ignore[attr-defined]
    with pytest.raises(files.GapFileError, match=r"model.clock = recorded: compare in the search that found this"):
        read_as(pendulum("recorded"), compared)
    with pytest.raises(files.GapFileError, match=r"model.clock = compare: another one in the search"):
        read_as(pendulum(), plain)


def test_a_clock_of_a_file_must_be_one(tmp_path: Path) -> None:
    files.save(GapResult("no gap", "", clock=ClockChoice("recorded", False, "so")), tmp_path)
    kept = files.load(tmp_path).clock
    assert kept is not None
    assert (kept.taken, kept.decided, kept.reason) == ("recorded", False, "so")
    assert np.isnan([kept.gain, kept.p, *kept.interval]).all()
    content = json.loads((tmp_path / files.RESULT).read_text())
    content["clock"]["taken"] = "sundial"
    (tmp_path / files.RESULT).write_text(json.dumps(content))
    with pytest.raises(files.GapFileError, match=r"clock\.taken 'sundial'"):
        files.load(tmp_path)


def test_a_wrong_key_is_told_and_an_open_clock_cuts_nothing(motions: list[tuple[np.ndarray, ...]]) -> None:
    with pytest.raises(ConfigError, match=r"model.clock = 'sundial'"):
        pendulum("sundial")
    with pytest.raises(ValueError, match=r"model.clock = 'compare': take a clock first"):
        prepare(logs(motions), pendulum(), QUICK)
