"""``go1exp gap`` on the command line: which recordings it takes under which names, and what it leaves in its folder."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from go1exp.cli.gap import APP, DOES_NOT_HOLD
from go1exp.cli.places import long_enough, read_all
from go1exp.config.schema.registry import ConfigError
from go1exp.gap import files
from go1exp.gap.result import EXIT_CODES, GapResult, NamedEffect
from go1exp.logs.recording import Recording, RecordingError, read, write
from tests.test_gap_report import answer

DEMO = sorted(Path("assets/demo/suspended_go1").glob("*.parquet"))


def named_so(path: Path, episode: str, repeat_of: str | None = None) -> Path:
    (recording,) = read_all(str(DEMO[0]))
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, replace(recording, meta=replace(recording.meta, episode=episode, repeat_of=repeat_of)))
    return path


def test_recordings_of_one_name_in_two_folders_are_told_apart(tmp_path: Path) -> None:
    for day in ("day1", "day2"):
        named_so(tmp_path / day / "run_0.parquet", "run_0")
        named_so(tmp_path / day / "again.parquet", f"again_{day}", repeat_of="run_0")
    recordings = read_all([str(tmp_path / "day1"), str(tmp_path / "day2")])
    about = {(r.meta.episode, r.meta.repeat_of) for r in recordings}
    assert about == {
        ("day1/run_0", None), ("again_day1", "day1/run_0"), ("day2/run_0", None), ("again_day2", "day2/run_0"),
    }  # fmt: skip
    alone = read_all(str(tmp_path / "day1"))
    assert {r.meta.episode for r in alone} == {"run_0", "again_day1"}


def test_folders_of_one_name_are_told_apart_by_those_above(tmp_path: Path) -> None:
    places = [str(named_so(tmp_path / a / "logs/run_0.parquet", "run_0").parent) for a in ("left", "right")]
    assert [r.meta.episode for r in read_all(places)] == ["left/logs/run_0", "right/logs/run_0"]


def test_a_recording_given_twice_and_a_copy_are_refused(tmp_path: Path) -> None:
    file = named_so(tmp_path / "run_0.parquet", "run_0")
    with pytest.raises(RecordingError, match=r"run_0.parquet: given twice"):
        read_all([str(tmp_path), str(file)])
    copy = named_so(tmp_path / "run_1.parquet", "run_0")
    with pytest.raises(RecordingError, match=r"run_1.parquet: is a copy of .*run_0.parquet"):
        read_all(str(tmp_path))
    write(copy, slower(read(copy), 1.1))
    assert [r.meta.episode.split("/")[-1] for r in read_all(str(tmp_path))] == ["run_0", "run_1"]


def slower(recording: Recording, factor: float) -> Recording:
    return replace(recording, channels={**recording.channels, "t": factor * recording.t})


def test_times_in_other_units_and_short_logs_are_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """The unit is the audit's to tell: here by the speeds, without them by the length of the steps."""
    (recording,) = read_all(str(DEMO[0]))
    short = replace(recording, channels={name: v[:5] for name, v in recording.channels.items()})
    bare = replace(recording, channels={k: v for k, v in recording.channels.items() if not k.startswith("qd_")})
    odd = [slower(r, factor) for factor in (1e3, 1e6) for r in (recording, bare)]
    assert long_enough([recording, *odd, slower(bare, 1e-3), short], 0.37) == [recording]
    milli, asked, micro, asked_micro, small, few = capsys.readouterr().out.splitlines()
    assert "it is in milliseconds, not in seconds" in milli
    assert asked.endswith("Is it in milliseconds?")
    assert "it is in microseconds, not in seconds" in micro
    assert asked_micro.endswith("Is it in microseconds?")
    assert small.endswith("Are its times 1000 times too small, by a wrong unit?")
    assert "5 rows, " in few
    assert few.endswith(" s: too short; windows take 0.37 s")


def test_a_slow_log_whose_speeds_fit_is_left_out_and_not_taken_for_milliseconds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (recording,) = read_all(str(DEMO[0]))
    t = 0.25 * np.arange(400)
    joints = recording.meta.joints
    q, qd = np.sin(0.5 * t), 0.5 * np.cos(0.5 * t)
    channels = {"t": t, **{f"q_{j}": q for j in joints}, **{f"qd_{j}": qd for j in joints}}
    assert long_enough([replace(recording, channels=channels)], 0.37) == []
    assert capsys.readouterr().out.endswith("a log of joints must step by at most 0.1 s\n")


def test_logs_that_are_all_too_short_are_bad_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (recording,) = read_all(str(DEMO[0]))
    write(tmp_path / "short.parquet", replace(recording, channels={k: v[:5] for k, v in recording.channels.items()}))
    assert APP.run([f"logs={tmp_path}", f"out={tmp_path / 'gap'}"]) == EXIT_CODES["bad log"]
    assert "none of these recordings can be compared" in capsys.readouterr().err


def test_what_an_earlier_answer_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in ("effect.yaml", "applied.json", "report.html", "mine.txt", "next.csv"):
        (tmp_path / name).write_text("{}")
    assert files.remove_older(tmp_path) == ["effect.yaml", "applied.json", "report.html"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "next.csv"]


def test_a_bad_log_takes_the_effect_of_an_earlier_answer_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gap"
    out.mkdir()
    (out / "effect.yaml").write_text("coulomb: {bound: 0.2}\n")
    (recording,) = read_all(str(DEMO[0]))
    still = {k: np.full_like(v, v[0]) if k.startswith("q_") and "target" not in k else v for k, v in
             recording.channels.items()}  # fmt: skip
    write(tmp_path / "frozen.parquet", replace(recording, channels=still))
    assert APP.run([f"logs={tmp_path / 'frozen.parquet'}", f"out={out}"]) == EXIT_CODES["bad log"]
    assert "removed, of the earlier answer" in capsys.readouterr().out
    assert not (out / "effect.yaml").exists()


@pytest.mark.parametrize("certified", [True, False])
def test_the_status_that_is_printed_is_that_of_the_command(
    certified: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only what is certified can fail to hold at training's step."""
    result: GapResult = answer("explained")
    names: tuple[NamedEffect, ...] = tuple(
        replace(n, status="certified" if certified else "compensating") for n in result.named
    )
    files.save(replace(result, named=names), tmp_path)
    (tmp_path / "applied.json").write_text(json.dumps({"holds": False}))
    status = APP.run(["stage=report", f"out={tmp_path}"])
    assert status == (DOES_NOT_HOLD if certified else EXIT_CODES["explained"])
    assert f"(exit code {status})" in capsys.readouterr().out


@pytest.mark.parametrize(("word", "hint"), [("nxt", "did you mean 'next'?"), ("chek", "'check'")])
def test_a_stage_that_does_not_exist_is_refused_with_the_nearest(word: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(hint)):
        APP.run([f"stage={word}", "logs=x"])
