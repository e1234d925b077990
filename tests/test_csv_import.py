"""Any CSV as a recording: the mapping of columns to channels, units and signs, and what is said of wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.runtime.job import ON_WIRE
from go1exp.logs import recording
from go1exp.logs.importers import import_recordings
from go1exp.logs.importers.csv import UNITS
from go1exp.logs.recording import JOINT_QUANTITIES, VECTORS, Recording, RecordingError
from go1exp.robot.go1_fields import TORQUE_NOTE
from tests.command import LIGHT, run

ROWS = 40
K = np.arange(ROWS)
TABLE = {
    "stamp": 5.0 * K + 1000.0,  # ms
    "angle [deg]": np.round(20.0 * np.sin(0.1 * K), 3),
    "goal": np.round(0.4 * np.sin(0.1 * K + 0.2), 4),
    "ticks": K % 7,
    "volt": 12.0 + 0 * K,
}
COLUMNS: dict[str, Any] = {
    "t": {"column": "stamp", "unit": "ms"},
    "q_knee": {"column": "angle [deg]", "unit": "deg", "scale": -1.0, "offset": 0.5},
    "q_target_knee": "goal",
    "tau_est_knee": {"column": "ticks", "unit": "mN m"},
}
OPTIONS: dict[str, Any] = {"robot": "arm", "columns": COLUMNS, "kp": 3.0, "kd": {"knee": 0.1}, "excitation": "sine"}


def lay(path: Path, delimiter: str = ",", decimal: str = ".", before: str = "", header: bool = True) -> Path:
    names = [delimiter.join(TABLE)] if header else []
    rows = [delimiter.join(f"{v:g}".replace(".", decimal) for v in row) for row in zip(*TABLE.values(), strict=True)]
    path.write_text(before + "\n".join([*names, *rows]) + "\n")
    return path


def imported(path: Path, **changes: Any) -> Recording:
    (one,) = import_recordings("csv", path, {**OPTIONS, **changes})
    return one


def refusal(path: Path, **changes: Any) -> str:
    with pytest.raises((ConfigError, RecordingError)) as caught:
        imported(path, **changes)
    return str(caught.value)


def test_columns_become_channels_with_unit_sign_and_offset(tmp_path: Path) -> None:
    r = imported(lay(tmp_path / "run_7.csv"))
    np.testing.assert_allclose(r.t, 0.005 * K, atol=1e-12)
    np.testing.assert_allclose(r.joint("q")[:, 0], 0.5 - np.radians(TABLE["angle [deg]"]), atol=1e-7)
    np.testing.assert_allclose(r.joint("q_target")[:, 0], TABLE["goal"], atol=1e-7)
    np.testing.assert_allclose(r.joint("tau_est")[:, 0], 1e-3 * TABLE["ticks"], atol=1e-12)
    meta = r.meta
    assert (meta.robot, meta.joints, meta.episode, meta.rate_hz) == ("arm", ("knee",), "run_7", 200.0)
    assert (meta.kp, meta.kd, meta.tau_limit, meta.base_quat) == ((3.0,), (0.1,), None, (1.0, 0.0, 0.0, 0.0))
    assert (meta.source, meta.excitation, r.has("qd")) == ("measured", "sine", False)
    assert "left out: volt" in meta.notes
    recording.write(tmp_path / "run_7.parquet", r)
    np.testing.assert_array_equal(recording.read(tmp_path / "run_7.parquet").t, r.t)


@pytest.mark.parametrize(
    ("robot", "torque", "noted"),
    [
        ("go1", np.round((K - 15) / 256, 4), True),
        ("arm", (K - 15) / 256, False),
        ("go1", 0.1 * np.sin(0.3 * K), False),
        ("go1", 2.0 * K / 256, False),  # coarser steps are another drive's
        ("go1", 3.0 * K / 256, False),
        ("go1", np.where(K < 9, (K + 1) / 256, 0.0), False),  # too few
    ],
)
def test_torques_of_a_go1s_packets_are_noted_as_in_recordings_of_deploy(
    tmp_path: Path, robot: str, torque: np.ndarray, noted: bool
) -> None:
    path = tmp_path / "a.csv"
    rows = zip(TABLE["stamp"], TABLE["goal"], torque.tolist(), strict=True)
    path.write_text("\n".join(["stamp,q,tau", *(f"{t},{q},{tau}" for t, q, tau in rows)]) + "\n")
    columns = {"t": COLUMNS["t"], "q_knee": "q", "tau_est_knee": "tau"}
    r = imported(path, robot=robot, columns=columns)
    assert (TORQUE_NOTE in r.meta.notes) == noted
    assert TORQUE_NOTE in ON_WIRE


def test_the_same_table_in_other_notations_is_the_same_recording(tmp_path: Path) -> None:
    usual = imported(lay(tmp_path / "a.csv"))
    european = imported(lay(tmp_path / "b.csv", ";", ",", "made by X\n\n"), delimiter=";", decimal=",", skip_lines=2)
    numbered = {
        name: {**value, "column": list(TABLE).index(value["column"]) + 1} if isinstance(value, dict) else 3
        for name, value in COLUMNS.items()
    }
    quoted = {k: {**v, "column": str(v["column"])} if isinstance(v, dict) else v for k, v in numbered.items()}
    nameless, as_text = (
        imported(lay(tmp_path / "c.csv", header=False), columns=columns, header=False) for columns in (numbered, quoted)
    )
    marked = tmp_path / "d.csv"
    marked.write_text("\ufeff" + lay(tmp_path / "a.csv").read_text().replace(",", " , ", 4), encoding="utf-8")
    for other in (european, nameless, as_text, imported(marked)):
        assert other.channels.keys() == usual.channels.keys()
        for name, values in usual.channels.items():
            np.testing.assert_array_equal(other.channels[name], values, name)


def test_nanoseconds_since_1970_keep_their_steps(tmp_path: Path) -> None:
    start = 1_700_000_000_123_456_789
    (tmp_path / "x.csv").write_text("n,p\n" + "".join(f"{start + 1_000_001 * k},0.{k}\n" for k in range(5)))
    r = imported(tmp_path / "x.csv", columns={"t": {"column": "n", "unit": "ns"}, "q_knee": "p"})
    np.testing.assert_allclose(np.diff(r.t), 1.000001e-3, rtol=1e-9)
    assert "t = 0 is 1700000000123456789 in the column 'n'" in r.meta.notes


def test_a_column_may_become_broken_numbers_after_a_million_whole_ones(tmp_path: Path) -> None:
    rows = ["0,0"] * 400_000 + ["0,0.25"]  # more than a block of Arrow's reader
    (tmp_path / "x.csv").write_text("p,c\n" + "\n".join(rows) + "\n")
    r = imported(tmp_path / "x.csv", columns={"q_knee": "c"}, rate_hz=500.0)
    assert (r.joint("q")[-1, 0], len(r.t)) == (0.25, 400_001)


def test_without_a_clock_the_rate_makes_the_time(tmp_path: Path) -> None:
    r = imported(lay(tmp_path / "x.csv"), **mapped(t=None), rate_hz=250.0)
    np.testing.assert_allclose(r.t, K / 250.0)
    assert "No clock in the source" in r.meta.notes


def test_a_flag_is_zero_or_one(tmp_path: Path) -> None:
    columns, path = {**COLUMNS, "torque_enable": "on"}, tmp_path / "x.csv"
    head, *rows = lay(path).read_text().splitlines()
    path.write_text("\n".join([head + ",on", *(f"{row},{k % 2}" for k, row in enumerate(rows))]) + "\n")
    assert imported(path, columns=columns).channels["torque_enable"].tolist() == [False, True] * 20
    path.write_text(path.read_text() + f"{rows[-1].replace('1195', '1200')},2\n")
    assert "column 'on' (for torque_enable): must be 0 or 1" in refusal(path, columns=columns)


def test_every_quantity_has_units_of_which_the_first_is_ours() -> None:
    assert UNITS.keys() == {"t", *JOINT_QUANTITIES, *VECTORS, "foot_force", "torque_enable"}
    assert all(next(iter(units.values())) == 1.0 for units in UNITS.values())
    assert UNITS["qd"]["rpm"] == pytest.approx(2 * np.pi / 60)


def mapped(**columns: Any) -> dict[str, Any]:
    """The columns with some others; None leaves one out."""
    return {"columns": {k: v for k, v in (COLUMNS | columns).items() if v is not None}}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"columns": None}, "importer.csv.columns: required, but not given; "),
        ({"columns": None}, "has the columns stamp, angle [deg], goal, ticks, volt"),
        (mapped(q_knee="Angle"), "no column 'Angle' (for q_knee); did you mean 'angle [deg]'?"),
        (mapped(q_targt_knee="goal"), "columns.q_targt_knee: unknown channel; did you mean"),
        (mapped(qdd_knee="goal"), "columns.qdd_knee: unknown channel; did you mean 'qd_knee'"),
        (mapped(current="volt"), "columns.current: unknown channel; channels are t, q_JOINT"),
        (mapped(t={"column": "stamp", "unit": "sec"}), "columns.t.unit = 'sec': unknown unit; s, ms"),
        (mapped(q_knee={"colum": "goal"}), "columns.q_knee.colum: unknown key 'colum'; did you mean"),
        (mapped(q_knee={"column": "goal", "scale": 0.0}), "columns.q_knee.scale = 0.0: must not be 0"),
        (mapped(q_knee=["goal"]), "columns.q_knee = ['goal']: must be a name, a number or"),
        (mapped(t=None), "importer.csv.columns: no t; name the column of the time (t: time) or give rate_hz"),
        (mapped(q_knee=None), "importer.csv.columns: no angle of a joint"),
        (mapped(q_hip="goal") | {"kd": 0.1}, "columns: no q_target_hip; q_target is needed of all joints"),
        ({"joints": ["knee", "hip"], "kd": 0.1}, "columns: no q_hip; q is needed of all joints"),
        ({"joints": ["hip"], "kd": 0.1}, "columns.q_knee: unknown channel; joints are hip"),
        ({"kp": [1.0, 2.0]}, "importer.csv.kp: 2 values for 1 joints"),
        ({"kd": {"hip": 2.0}}, "importer.csv.kd: no joint is called 'hip'"),
        ({"kp": -1.0}, "importer.csv.kp = -1.0: every value must be at least 0"),
        ({"delimiter": ";"}, "is the delimiter ','?"),
        ({"rate_hz": 20.0}, "t: steps by 0.005 s (median), but rate_hz = 20"),
    ],
)
def test_whatever_is_wrong_is_told_by_its_name(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    assert said in refusal(lay(tmp_path / "x.csv"), **changes)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1200,hot,0,0,12", "column 'angle [deg]': must be numbers, but line 42 has 'hot'"),
        ("1200,,0,0,12", "column 'angle [deg]': 1 cell is empty or NaN, the first in line 42"),
        ("1200,inf,0,0,12", "column 'angle [deg]': inf in line 42; every value must be finite"),
        ("1200,1,0", "line 42 has 3 cells, but line 1 has 5; every line must have as many as the first"),
        ("1195,1,0,0,12", "(for t): must increase strictly, but line 42 has 1195 after 1195 (1 such row); leave"),
    ],
)
def test_a_bad_row_is_told_by_column_and_line(tmp_path: Path, row: str, said: str) -> None:
    path = lay(tmp_path / "x.csv")
    path.write_text(path.read_text() + row + "\n")
    message = refusal(path)
    assert message.startswith(str(path))
    assert said in message


def test_lines_are_counted_as_an_editor_does(tmp_path: Path) -> None:
    path = lay(tmp_path / "x.csv", before="made by X\n\n")
    lines = path.read_text().splitlines()
    lines[10:10] = ["", ""]
    for row, problem in (("1200,hot,0,0,12", "line 46 has 'hot'"), ("1200,1", "line 46 has 2 cells, but line 3 has 5")):
        path.write_text("\n".join([*lines, row]) + "\n")
        assert problem in refusal(path, skip_lines=2)
    message = refusal(lay(path, before="made by X\n"))  # a line stands before the names
    assert "line 2 has 5 cells, but line 1 has 1" in message
    assert "give skip_lines" in message


@pytest.mark.parametrize(
    ("encoding", "problem"),
    [
        ("latin-1", "x.csv: has characters that are not UTF-8; save it as UTF-8, or give its encoding"),
        ("utf-16", "x.csv: is UTF-16, not UTF-8; save it as UTF-8, or give encoding: utf-16"),
    ],
)
def test_another_encoding_is_told_and_can_be_given(tmp_path: Path, encoding: str, problem: str) -> None:
    path = lay(tmp_path / "x.csv")
    path.write_text(path.read_text().replace("[deg]", "[°]"), encoding=encoding)
    columns = {**COLUMNS, "q_knee": "angle [°]"}
    assert problem in refusal(path, columns=columns)
    r = imported(path, columns=columns, encoding=encoding)
    np.testing.assert_allclose(r.joint("q")[:, 0], TABLE["angle [deg]"])
    path.write_text(path.read_text(encoding=encoding) + "1200,hot,0,0,12\n", encoding=encoding)
    assert "line 42 has 'hot'" in refusal(path, columns=columns, encoding=encoding)
    for name in ("utf-99", "idna"):
        assert f"importer.csv.encoding = {name!r}: unknown encoding; utf-8" in refusal(path, encoding=name)


ROUNDED, COUNTER = np.round(4.0 * K, -1), 1000 * np.arange(100) % 2**16


def clocked(path: Path, stamps: np.ndarray) -> Path:
    path.write_text("stamp,q\n" + "".join(f"{t:g},{k}\n" for k, t in enumerate(stamps)))
    return path


@pytest.mark.parametrize(
    ("stamps", "problem"),
    [
        (ROUNDED, "line 3 has 0 after 0 (23 such rows); its times are rounded: take t out of columns "),
        (ROUNDED, "give rate_hz (about 2"),
        (4 * K[::-1], "line 3 has 152 after 156 (39 such rows); it runs backward: put the rows in the other order"),
        (np.where(K == 20, 100, 10 * K), "line 22 has 100 after 190 (1 such row); sort the rows by time, or leave"),
        (np.where(K == 20, 190, 10 * K), "line 22 has 190 after 190 (1 such row); leave such rows out"),
        (COUNTER, "line 68 has 464 after 65000 (1 such row); it is a counter of 16 bits that overflows: add 65536"),
        (K[:1], "has 1 row of numbers; at least 2 are needed"),
    ],
)
def test_a_clock_that_does_not_increase_is_told_with_its_remedy(
    tmp_path: Path, stamps: np.ndarray, problem: str
) -> None:
    path = clocked(tmp_path / "x.csv", stamps)
    columns = {"t": COLUMNS["t"], "q_knee": "q"}
    for changes in ({}, {"rate_hz": 250.0}):
        message = refusal(path, columns=columns, kd=0.1, **changes)
        assert problem in message
        assert message.startswith(f"{path}: ")


def test_a_german_table_is_asked_about_once(tmp_path: Path) -> None:
    path = lay(tmp_path / "x.csv", ";", ",")
    both = """; is the delimiter ';', and the decimal ','? Then give delimiter: ";" and decimal: ",\""""
    assert refusal(path).endswith(both)
    message = refusal(path, delimiter=";")
    cell = "must be numbers, but line 3 has '1,997'; is the decimal ','? Then give decimal: "
    assert message == f"{path}: column 'angle [deg]' and 1 other column: {cell}" + '","'
    message = refusal(lay(tmp_path / "x.csv", ";"), delimiter=";", decimal=",")
    assert "is the decimal '.'? Then give decimal: \".\"" in message
    message = refusal(lay(tmp_path / "x.csv", ";"))
    assert message.count("is the delimiter ';'? Then give delimiter: \";\"") == 1
    path = lay(tmp_path / "x.csv", ";", ",")
    path.write_text(path.read_text() + "1200;hot;0;0;12\n")
    assert "line 42 has 'hot'" in refusal(path, delimiter=";", decimal=",")  # the word, not the numbers


def test_an_empty_file_and_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("a, a\n1,2\n")
    assert "two columns are called 'a'" in refusal(path)
    path.write_text("a,b\n")
    assert "has no rows" in refusal(path)
    path.write_text("")
    assert str(path) in refusal(path)


def test_columns_come_from_a_file_or_the_command_line(tmp_path: Path) -> None:
    lay(tmp_path / "x.csv")
    (tmp_path / "arm.yaml").write_text("robot: arm\ncolumns: {t: {column: stamp, unit: ms}, q_knee: goal}\n")
    (tmp_path / "map.yaml").write_text("t: {column: stamp, unit: ms}\nq_knee: ticks\n")
    for number, (given, column) in enumerate(
        [
            (["options=arm.yaml"], "goal"),
            (["options=arm.yaml", "columns=map.yaml"], "ticks"),
            (["options={robot: arm}", "columns={t: {column: stamp, unit: ms}, q_knee: volt}"], "volt"),
        ]
    ):
        done = run(tmp_path, "record", "import", "csv", "x.csv", *given, f"out=o{number}")
        assert (done.returncode, done.stderr) == (0, "")
        r = recording.read(tmp_path / f"o{number}/x.parquet")
        np.testing.assert_allclose(r.joint("q")[:, 0], TABLE[column], atol=1e-7)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "columns=map.yaml: no such file"),
        ("", "columns=map.yaml: is empty; without any, leave columns out"),
        ("- t\n", "columns=map.yaml: must be a mapping, or a FILE.yaml that holds one"),
        ("t: [\n", "columns=map.yaml: no YAML (line 2: "),
    ],
)
def test_a_wrong_file_of_columns_is_told(tmp_path: Path, text: str | None, said: str) -> None:
    lay(tmp_path / "x.csv")
    if text is not None:
        (tmp_path / "map.yaml").write_text(text)
    done = run(tmp_path, "record", "import", "csv", "x.csv", "columns=map.yaml", "options={robot: arm}", preload=LIGHT)
    assert done.returncode == 2
    assert said in done.stderr
    assert not (tmp_path / "recordings").exists()


ARM = ["record", "import", "csv", "one", "options=lä/arm.yaml"]


def arm(folder: Path, columns: str) -> Path:
    """Make folders and the options of ``ARM``; return where its table comes."""
    for name in ("one", "lä"):
        (folder / name).mkdir()
    (folder / "lä" / "arm.yaml").write_text(f"robot: arm\ncolumns: {columns}\n")
    return folder / "one" / "a.csv"


def test_what_an_import_replaces_is_told_and_two_files_of_one_name_are_renamed(tmp_path: Path) -> None:
    lay(arm(tmp_path, "{t: {column: stamp, unit: ms}, q_knee: goal}"))
    (tmp_path / "two").mkdir()
    lay(tmp_path / "two" / "a.csv")
    first, again = (run(tmp_path, *ARM, "out=o") for _ in range(2))
    assert (first.returncode, again.returncode) == (0, 0)
    assert first.stdout.startswith("1 recording, 0 s, in o\n")
    assert again.stdout.startswith(
        "note: o holds a.parquet of an earlier call; new ones replace them (or: out=FOLDER)\n"
    )
    both = run(tmp_path, *ARM[:3], ".", ARM[4], "out=both")
    assert both.returncode == 0
    assert sorted(p.name for p in (tmp_path / "both").iterdir()) == ["one_a.parquet", "two_a.parquet"]


SHORT = ("note: a: t steps by 4e-06 s (median); a log of joints must step by at least 5e-05 s", "unit: s}")
LONG = (
    "note: a: t steps by 4 s (median); a log of joints must step by at most 0.1 s. Is it in milliseconds?",
    "unit: ms",
)


@pytest.mark.parametrize(
    ("stamp", "factor", "noted"),
    [("{column: stamp, unit: ms}", 1.0, SHORT), ("stamp", 1000.0, LONG), ("stamp", 1.0, ())],
)
def test_an_import_asks_for_the_unit_of_short_and_long_steps(
    tmp_path: Path, stamp: str, factor: float, noted: tuple[str, ...]
) -> None:
    clocked(arm(tmp_path, f"{{t: {stamp}, q_knee: q}}"), factor * 0.004 * K)
    done = run(tmp_path, *ARM, "out=o")
    assert done.returncode == 0
    for line in (*SHORT, *LONG):
        assert (line in done.stdout) == (line in noted)


def test_a_folder_gives_its_files_whatever_the_case_of_their_ending(tmp_path: Path) -> None:
    for name in ("a.csv", "B.CSV", "c.Csv"):
        clocked(tmp_path / name, 0.004 * K)
    (tmp_path / "d.csv").mkdir()
    (tmp_path / "e.txt").touch()
    columns = {"t": "stamp", "q_knee": "q", "qd_knee": {"column": "q"}}
    read = import_recordings("csv", tmp_path, {"robot": "arm", "columns": columns})
    assert [r.meta.episode for r in read] == ["B", "a", "c"]
    assert all("Column 'q' of the source is q_knee, qd_knee." in r.meta.notes for r in read)


@pytest.mark.parametrize("second", ["0.0", "0.5"])
def test_a_file_without_names_of_columns_is_asked_about(tmp_path: Path, second: str) -> None:
    (tmp_path / "a.csv").write_text(f"0.0,{second}\n0.1,0.2\n")
    with pytest.raises(RecordingError, match=r"first line numbers, not names\? Then give header: false"):
        import_recordings("csv", tmp_path, {"robot": "arm", "columns": {"t": "stamp", "q_knee": "q"}})


def test_a_clock_that_begins_anew_and_a_column_of_episodes_separate_recordings(tmp_path: Path) -> None:
    t = [0.0, 0.01, 0.02, 0.03]
    rows = [f"{e},{s},{10 * e + k}" for e in (0, 1) for k, s in enumerate(t)]
    (tmp_path / "a.csv").write_text("\n".join(["run,t,q", *rows]) + "\n")
    options = {"robot": "arm", "columns": {"t": "t", "q_knee": "q"}}
    for more in ({}, {"episode": "run"}):
        read = import_recordings("csv", tmp_path / "a.csv", options | more)
        assert [r.meta.episode for r in read] == ["a_0", "a_1"]
        assert read[1].channels["q_knee"].tolist() == [10.0, 11.0, 12.0, 13.0]
        assert read[1].t == pytest.approx(t)


def test_lists_in_parquet_are_the_joints(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    state = [[float(k), 10.0 + k] for k in range(4)]
    table = pa.table({"timestamp": [0.0, 0.1, 0.2, 0.3], "observation.state": state})
    pq.write_table(table, tmp_path / "a.parquet")
    columns = {"t": "timestamp", "q": "observation.state"}
    (r,) = import_recordings("csv", tmp_path, {"robot": "arm", "joints": ["a", "b"], "columns": columns})
    assert r.joint("q").tolist() == state


def test_a_line_of_units_repeats_and_binary_files(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,q\nms,deg\n0,0\n5,180\n5,180\n10,90\n")
    options = {"robot": "arm", "columns": {"t": "t", "q_knee": "q"}, "drop_repeats": True}
    (r,) = import_recordings("csv", path, options)
    assert r.t == pytest.approx([0.0, 0.005, 0.01])
    assert r.channels["q_knee"] == pytest.approx([0.0, np.pi, np.pi / 2])
    assert "1 row with the time of the row before" in r.meta.notes
    path.write_bytes(b"SQLite format 3\0" + bytes(100))
    with pytest.raises(RecordingError, match=r"is binary, not text: a \.db3 bag"):
        import_recordings("csv", path, options)
