"""``go1exp gap loop``: when it ends and what it keeps; and the whole circle on a simulated robot."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from go1exp.gap.design.choice import Worth
from go1exp.gap.design.plan import Attitude, Design, DesignError, DesignSettings, Used
from go1exp.gap.design.rehearsal import Rehearsal
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.stages import loop as stage_loop
from go1exp.gap.stages.next import NextResult, Verdict
from go1exp.logs.record.simulate import held_quat
from go1exp.logs.recording import read
from go1exp.robot import JOINTS
from tests.command import refuse
from tests.laboratory import recorded

ONE_OR_TWO = NamedEffect("viscous", JOINTS, {}, {}, ("viscous", "kd_scale"), "certified")
LITTLE, MUCH = Worth(1.0, 1.0, 0.0, 0.1), Worth(1e4, 0.5, 1.0, 1.0)


def rehearsal() -> Rehearsal:
    from go1exp.logs.excitations.motion import always_on
    from go1exp.robot import NOMINAL_STANCE

    attitude = Attitude(0.0, 0.26, held_quat((0.0, 0.26)))
    motion = always_on(np.tile(NOMINAL_STANCE, (100, 1)), "suspended")
    flat = np.zeros((100, 12))
    design = Design("gait", {}, 1.0, (1.0, 2.0), attitude, 3)
    return Rehearsal(design, motion, np.full(12, 20.0), np.full(12, 1.0), flat, flat, Used(0.1, 0.1, 0.1, 1.0))


def designed(verdict: str) -> NextResult:
    pair = Verdict("viscous", "kd_scale", LITTLE, MUCH, "" if verdict == "designed" else "no design does")
    best = rehearsal() if verdict == "designed" else None
    return NextResult(verdict, () if verdict == "nothing left" else (pair,), (), best, 500.0, JOINTS)


@pytest.mark.parametrize(
    ("verdicts", "rounds", "ended"),
    [
        (["designed", "nothing left"], 3, "one name is left"),
        (["designed", "not separable"], 3, "not separable"),
        (["designed", "designed"], 1, "rounds are used up"),
        (["nothing left"], 0, "one name is left"),
        ([DesignError("limits: all go beyond")], 2, "limits: all go beyond"),
    ],
)
def test_the_loop_ends_for_a_reason(
    verdicts: list[Any], rounds: int, ended: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Search, design and recording are stubs here: what counts is when the loop stops and what it hands on."""
    made: list[Any] = []
    _, (like,) = recorded(["seconds=0.2", "physics_dt=0.002", "excitation=[chirp]"])

    def play(rig: Any, episodes: Any, *rest: Any) -> list[Any]:
        made.append(episodes)
        return [like]

    def design(*given: Any, **how: Any) -> NextResult:
        assert how["names_only"]
        verdict = verdicts[len(made) - 1]
        if isinstance(verdict, DesignError):
            raise verdict
        return designed(verdict)

    monkeypatch.setattr(stage_loop, "play", play)
    monkeypatch.setattr(stage_loop, "design", design)
    monkeypatch.setattr(stage_loop, "explain", lambda *given: GapResult("explained", "", named=(ONE_OR_TWO,)))
    turns: list[Any] = []
    anything: Any = None
    rows = stage_loop.loop(
        anything, [anything], anything, anything, GapSettings(), DesignSettings(), rounds, turns.append
    )
    assert rows[-1].ended == ended
    assert len(rows) == len(verdicts) == len(made) == len(turns)
    assert all(not row.ended for row in rows[:-1])
    for number, (episode,) in enumerate(made[1:], start=1):
        assert (episode.name, episode.kp, episode.kd) == (f"next_{number}_gait", 20.0, 1.0)
        assert episode.hang == (0.0, 0.26)
        assert rows[number].robot_seconds == pytest.approx((number + 1) * rows[0].robot_seconds, abs=1e-3)
    if verdicts[0] == "designed":
        assert rows[0].names == (("viscous", "kd_scale"),)
        assert rows[0].power == 0.1
        assert "gait, kp 20, kd 1, roll 0, pitch 0.26" in stage_loop.table(rows)
    if ended == "one name is left":
        assert (rows[-1].names, rows[-1].power) == ((("viscous",),), 1.0)
    if isinstance(verdicts[0], DesignError):  # nobody knows the chance; the search's equals are left
        assert (rows[0].names, rows[0].power) == ((("viscous", "kd_scale"),), None)
        assert json.loads(json.dumps(asdict(rows[0])))["power"] is None
        assert stage_loop.table(rows).splitlines()[1].split()[:3] == ["0", f"{rows[0].robot_seconds:.1f}", "–"]


def test_nothing_named_ends_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_loop, "play", lambda *given: list(recorded(["seconds=0.2", "physics_dt=0.002"])[1]))
    monkeypatch.setattr(stage_loop, "explain", lambda *given: GapResult("no gap", ""))
    anything: Any = None
    (row,) = stage_loop.loop(anything, [], anything, anything, GapSettings(), DesignSettings(), 2, lambda turn: None)
    assert row.ended == "nothing is named: no gap"
    assert row.power is None


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["support=ground"], "support = 'ground': designs are for a suspended robot"),
        (["model=go2"], "model: the simulated robot is a Go1"),
        (["excitation=[policy]"], "excitation: motions only"),
        (["rounds=-1"], "rounds = -1"),
        (["search.alpha=2", "design.seconds=1"], "2 problems"),
    ],
)
def test_what_cannot_be_is_refused(words: list[str], complaint: str, tmp_path: Path) -> None:
    done = refuse(tmp_path, "gap", "loop", *words)
    assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("go1exp/gap/", "go1exp/cli/gap_next.py", "conf/gap_loop.yaml", "tests/")
def test_a_circle_on_the_simulated_robot(tmp_path: Path) -> None:
    """A larger kd in the logs of one gain is kd or friction; one designed recording leaves kd."""
    search = ["window_s=0.2", "physics_dt=0.002", "stride_s=0.6", "bootstraps=5", "shortlist=3", "overlays=0"]
    words = [
        *("effect=kd_scale", "effect.kd_scale.scale=1.7", "excitation=[multisine,gait]", "seeds=[0,1,2]"),
        *("seconds=4", "rounds=1", "physics_dt=0.001", "backend.threads=1", *(f"search.{word}" for word in search)),
        *("design.designs=12", "design.refine=0", "design.seconds=4", "out=loop"),
    ]
    status = refuse(tmp_path, "gap", "loop", *words).returncode
    rows = json.loads((tmp_path / "loop/loop.json").read_text())
    assert [sorted(names) for names in rows[0]["names"]] == [["kd_scale", "viscous"]]  # equals: either comes first
    assert rows[0]["power"] < 0.1
    assert rows[-1]["names"] == [["kd_scale"]]
    assert rows[-1]["robot_seconds"] == pytest.approx(28.0, abs=0.1)
    assert (status, rows[-1]["ended"]) == (0, "one name is left")
    (designed,) = (tmp_path / "loop/recordings").glob("next_1_*.parquet")
    assert read(designed).meta.kd != (0.5,) * 12
    assert (tmp_path / "loop/round_0/next.csv").exists()
    assert not (tmp_path / "loop/round_1/next.csv").exists()
