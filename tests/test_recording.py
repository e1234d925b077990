"""The recording format: what is written comes back bit for bit, and what is damaged is named, never mended."""

from __future__ import annotations

import ast
import json
import os
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from go1exp.config.schema.physics import ContactConfig
from go1exp.logs import recording as rec
from go1exp.logs.recording import Meta, Recording, RecordingError
from go1exp.robot import JOINTS, LEGS
from tests.command import run_alone
from tests.made import meta

META = meta(
    ("shoulder", "elbow"),
    **{"robot": "arm", "rate_hz": 100.0, "kp": (20.0, 10.0), "kd": (0.5, 0.25), "excitation": "chirp"},
    **{"episode": "arm_chirp_0", "versions": {"numpy": "2"}},
)
GO1 = replace(META, robot="go1", joints=JOINTS, kp=(20.0,) * 12, kd=None)


def arm(**extra: np.ndarray) -> Recording:
    """A sound recording of 50 rows, with ``extra`` columns."""
    t = np.arange(50) / 100
    waves = {f"{q}_{j}": np.sin(t + i) for i, q in enumerate(("q", "qd", "q_target")) for j in META.joints}
    return Recording(META, {"t": t, **waves, **extra})


def without(recording: Recording, *names: str) -> Recording:
    return Recording(recording.meta, {k: v for k, v in recording.channels.items() if k not in names})


def same(a: Recording, b: Recording) -> bool:
    """Equal metadata, column order, types and bits."""
    return (
        a.meta == b.meta
        and list(a.channels) == list(b.channels)
        and all(a.channels[k].dtype == b.channels[k].dtype for k in a.channels)
        and all(a.channels[k].tobytes() == b.channels[k].tobytes() for k in a.channels)
    )


def plant(path: Path, columns: dict[str, Any], metadata: dict[bytes, bytes] | None = None) -> Path:
    """Write a Parquet file behind the module's back."""
    about = {rec.KEY: json.dumps(asdict(META)).encode()} if metadata is None else metadata
    pq.write_table(pa.table(columns).replace_schema_metadata(about), path)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "episode.parquet"


def refused(path: Path, match: str) -> None:
    """Reading names the file first, and then what is wrong."""
    with pytest.raises(RecordingError, match=match) as caught:
        rec.read(path)
    assert str(caught.value).startswith(str(path))


# ---------------------------------------------------------------------- there and back


def test_a_recording_comes_back_bit_for_bit(path: Path) -> None:
    extra = {name: np.linspace(-1, 1, 50) for name in ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z", "foot_force_tip")}
    written = arm(**extra, torque_enable=np.arange(50) % 3 > 0)
    rec.write(path, written)
    result = rec.read(path)
    assert same(result, written)
    assert result.channels["torque_enable"].dtype == np.dtype(bool)
    assert all(values.flags.writeable for values in result.channels.values())  # torch takes no others without a warning


finite = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=True)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), rows=st.integers(1, 40))
def test_any_sound_recording_comes_back_bit_for_bit(data: st.DataObject, rows: int, tmp_path: Path) -> None:
    quantities = data.draw(st.lists(st.sampled_from(rec.JOINT_QUANTITIES), unique=True))
    # A step of half the usual one is the least that is sound (RATE_FACTOR), and two rows have one step.
    jitter = data.draw(st.lists(st.floats(0, 0.0049), min_size=rows, max_size=rows))
    channels = {"t": np.arange(rows) / 100 + np.array(jitter)}
    for quantity in quantities:
        for joint in META.joints:
            values = data.draw(st.lists(finite, min_size=rows, max_size=rows))
            channels[f"{quantity}_{joint}"] = np.array(values, dtype=np.float64)
    if data.draw(st.booleans()):
        channels["torque_enable"] = np.array(data.draw(st.lists(st.booleans(), min_size=rows, max_size=rows)))
    meta = replace(
        META, notes=data.draw(st.text(st.characters(codec="utf-8"))), repeat_of=data.draw(st.text() | st.none())
    )
    written = Recording(meta, channels)
    rec.write(tmp_path / "x.parquet", written)
    assert same(rec.read(tmp_path / "x.parquet"), written)


def test_metadata_is_one_json_object_that_any_reader_finds(path: Path) -> None:
    rec.write(path, arm())
    text = pq.read_schema(path).metadata[b"go1exp"]
    result = json.loads(text)
    assert result["joints"] == ["shoulder", "elbow"]
    assert result["format"] == 1
    assert result["tau_limit"] is None
    assert set(result) == set(Meta.__dataclass_fields__) - {"contact"}  # which is left out where it is unknown


def test_the_contact_of_the_model_comes_back_and_files_without_one_have_none(path: Path) -> None:
    rec.write(path, arm())
    assert rec.read(path).meta.contact is None  # as of files that older versions wrote
    contact = ContactConfig(time_constant=0.005, cone="elliptic", impratio=10.0)
    written = Recording(replace(META, contact=contact), arm().channels)
    rec.write(path, written)
    assert same(rec.read(path), written)
    text = json.loads(pq.read_schema(path).metadata[rec.KEY])
    assert text["contact"] == {"time_constant": 0.005, "cone": "elliptic", "impratio": 10.0}
    plant(path, written.channels, {rec.KEY: json.dumps({**text, "contact": {"time_constant": 0.005}}).encode()})
    refused(path, r"metadata\.contact\.cone")


def test_a_joint_quantity_is_returned_in_the_order_of_the_metadata(path: Path) -> None:
    t = np.arange(5) / 100
    rec.write(path, Recording(GO1, {"t": t, **{f"q_{j}": np.full(5, float(JOINTS.index(j))) for j in sorted(JOINTS)}}))
    result = rec.read(path)
    assert list(result.channels)[1] == "q_FL_calf"  # the file's own order is another
    assert np.array_equal(result.joint("q")[0], np.arange(12))
    assert result.joint("q").shape == (5, 12)


def test_an_absent_channel_is_named_and_never_zero() -> None:
    recording = arm()
    assert recording.has("q")
    assert not recording.has("tau_est")
    with pytest.raises(RecordingError, match=r"^arm_chirp_0: no channel 'tau_est_shoulder'"):
        recording.joint("tau_est")
    with pytest.raises(RecordingError, match="no channel 'imu_gyro_y'"):
        recording.block("t", "imu_gyro_y")
    assert np.array_equal(recording.block("t", "q_elbow")[:, 1], recording.channels["q_elbow"])
    assert rec.joint_channel("tau_cmd", "FR_hip") == "tau_cmd_FR_hip"


def test_a_folder_is_read_in_the_order_of_names(tmp_path: Path) -> None:
    for name in ("b", "a", "c"):
        rec.write(tmp_path / "runs" / f"{name}.parquet", Recording(replace(META, episode=name), arm().channels))
    assert [r.meta.episode for r in rec.read_folder(tmp_path / "runs")] == ["a", "b", "c"]
    with pytest.raises(RecordingError, match=r"no \*\.parquet in it"):
        rec.read_folder(tmp_path)
    with pytest.raises(RecordingError, match="no such folder"):
        rec.read_folder(tmp_path / "nothing")


# ---------------------------------------------------------------------- writing


def test_a_recording_that_breaks_the_format_is_not_written(path: Path) -> None:
    with pytest.raises(RecordingError, match="qd: no column qd_elbow"):
        rec.write(path, without(arm(), "qd_elbow"))
    assert not path.exists()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rec.write(path, arm())
    before = path.read_bytes()

    def half(table: pa.Table, where: BinaryIO, **_: Any) -> None:
        where.write(b"PAR1 and then the disk was full")
        raise OSError("no space left on device")

    monkeypatch.setattr(pq, "write_table", half)
    with pytest.raises(OSError, match="no space"):
        rec.write(path, arm(torque_enable=np.ones(50, bool)))
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


# ---------------------------------------------------------------------- damaged files


def test_a_damaged_file_and_one_that_is_no_parquet_are_refused(path: Path) -> None:
    rec.write(path, arm())
    whole = path.read_bytes()
    chunk = pq.ParquetFile(path).metadata.row_group(0).column(1)
    end = chunk.data_page_offset + chunk.total_compressed_size
    contents = [whole[: int(kept * len(whole))] for kept in (0.0, 0.001, 0.1, 0.5, 0.9, 0.99, 0.9999)]
    contents += [whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :] for k in range(end - 100, end, 20)]  # a bit of data
    contents += [b"t,q\n0,1\n", b"PAR1", b"PAR1" * 2, pickle.dumps({"t": [0.0]}), b"\0" * 4096]
    for content in contents:
        path.write_bytes(content)
        refused(path, "not a whole Parquet file")


def test_a_missing_file_a_folder_and_a_parquet_file_of_something_else_are_refused(path: Path) -> None:
    refused(path, "no such file")
    path.mkdir()
    refused(path, "no such file")
    path.rmdir()
    for metadata in ({}, {b"other": b"{}"}):
        refused(plant(path, arm().channels, metadata), "no schema metadata 'go1exp'")


def about(**changes: Any) -> bytes:
    return json.dumps({**asdict(META), **changes}).encode()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"", "metadata = .*invalid JSON"),
        (b"{'robot': 'arm'}", "metadata = .*invalid JSON"),
        (b"\xff\xfe", "metadata = .*invalid JSON"),
        (b"[]", "metadata = .*object"),
        (b"{}", "metadata.robot: required, but not given"),
        (about(rate_hz="100"), "metadata.rate_hz = '100': input should be a valid number"),
        (about(rate_hz=0), "metadata.rate_hz = 0.*greater than 0"),
        (about(rate_hz=float("nan")), "metadata.rate_hz.*finite"),
        (about(kp=[1.0]), "metadata.kp: has 1 values for 2 joints"),
        (about(kd=[1.0] * 3), "metadata.kd: has 3 values for 2 joints"),
        (about(tau_limit=[1.0, -1.0]), "metadata.tau_limit.1 = -1.0"),
        (about(base_quat=None), "metadata.base_quat: must be given for a fixed base"),
        (about(base="floating"), "metadata.base_quat: must be .* null for a floating one"),
        (about(base_quat=[1, 1, 0, 0]), "metadata.base_quat: must have length 1, not 1.41421"),
        (about(base_quat=[1, 0, 0]), "metadata.base_quat"),
        (about(base="hanging"), "metadata.base = 'hanging'"),
        (about(source="real"), "metadata.source = 'real'"),
        (about(format=2), "metadata.format = 2"),
        (about(joints=["shoulder", "shoulder"]), "metadata.joints: must be different"),
        (about(joints=["target_a", "a"]), "metadata.joints: .*q_target_a occurs twice"),
        (about(joints=[]), "metadata.joints"),
        (about(rate=100.0), "metadata.rate: unknown key 'rate'; did you mean 'rate_hz'"),
        (about(joints=["shoulder", "wrist"]), "q_elbow: unknown column"),
    ],
)
def test_metadata_that_breaks_the_format_is_named(path: Path, text: bytes, match: str) -> None:
    refused(plant(path, arm().channels, {rec.KEY: text}), match)


def test_wrong_metadata_cannot_even_be_built() -> None:
    with pytest.raises(ValidationError, match="has 1 values for 2 joints"):
        replace(META, kp=(1.0,))
    with pytest.raises(ValidationError, match="valid tuple"):
        replace(META, kp=[1.0, 2.0])  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["q_shoulder", "t", "torque_enable"])
@pytest.mark.parametrize(
    "kind", [pa.float32(), pa.int64(), pa.string(), pa.binary(), pa.list_(pa.float64()), pa.decimal128(9, 2)]
)
def test_columns_of_other_types_are_refused(path: Path, name: str, kind: pa.DataType) -> None:
    nothing = pa.array([None] * 50, kind)
    refused(plant(path, {**arm().channels, name: nothing}), f"{name}[^:]*: is stored as")


def test_a_column_of_another_kind_or_with_gaps_is_refused(path: Path) -> None:
    refused(plant(path, {**arm().channels, "q_elbow": np.ones(50, bool)}), "q_elbow: is stored as boolean")
    refused(plant(path, {**arm().channels, "torque_enable": np.ones(50)}), "torque_enable: is stored as double")
    gappy = pa.array([0.0] * 49 + [None], pa.float64())
    refused(plant(path, {**arm().channels, "q_elbow": gappy}), "q_elbow: has empty values")


class Foreign(pa.ExtensionType):
    """A column type with code of its own, on top of plain numbers."""

    def __init__(self) -> None:
        super().__init__(pa.float64(), "go1exp.test.foreign")

    def __arrow_ext_serialize__(self) -> bytes:
        return b""

    @classmethod
    def __arrow_ext_deserialize__(cls, storage: pa.DataType, serialized: bytes) -> Foreign:
        return cls()


def test_an_extension_column_is_refused_whether_pyarrow_knows_its_type_or_not(path: Path) -> None:
    pa.register_extension_type(Foreign())
    try:
        column = pa.ExtensionArray.from_storage(Foreign(), pa.array(np.zeros(50)))
        plant(path, {**arm().channels, "q_elbow": column})
        refused(path, "q_elbow: is of an extension type")
    finally:
        pa.unregister_extension_type("go1exp.test.foreign")
    refused(path, "q_elbow: is of an extension type")


def test_nothing_here_can_unpickle() -> None:
    source = ast.parse(Path(rec.__file__).read_text())
    names = {a.name for n in ast.walk(source) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module or "" for n in ast.walk(source) if isinstance(n, ast.ImportFrom)}
    assert not names & {"pickle", "cloudpickle", "dill", "marshal", "shelve", "joblib", "torch", "pandas"}
    called = {n.attr for n in ast.walk(source) if isinstance(n, ast.Attribute)}
    assert not called & {"load", "loads", "read_pickle", "deserialize"}


def test_two_columns_of_one_name_are_refused(path: Path) -> None:
    table = pa.table([pa.array(v) for v in arm().channels.values()] * 2, names=list(arm().channels) * 2)
    pq.write_table(table.replace_schema_metadata({rec.KEY: about()}), path)
    refused(path, "q_elbow: 2 columns of this name")


# ---------------------------------------------------------------------- channels that break the format


def spoilt(name: str, row: int, value: float) -> Recording:
    recording = arm()
    recording.channels[name][row] = value
    return recording


def turned(axis_scale: float, name: str = "imu_quat") -> Recording:
    return arm(**{f"{name}_{c}": np.full(50, axis_scale * (c == "w")) for c in "wxyz"})


BROKEN: dict[str, tuple[Callable[[], Recording], str]] = {
    "nan": (lambda: spoilt("q_elbow", 7, np.nan), "q_elbow: must be finite.*nan in row 7"),
    "inf": (lambda: spoilt("qd_elbow", 3, -np.inf), "qd_elbow: must be finite.*-inf in row 3"),
    "nan_time": (lambda: spoilt("t", 3, np.nan), "t: must be finite"),
    "shuffled_time": (lambda: arm(t=np.random.default_rng(0).permutation(arm().t)), "t: must increase strictly"),
    "repeated_time": (lambda: spoilt("t", 10, 0.09), r"t: must increase strictly, but row 10 has 0.09 s after 0.09 s"),
    "milliseconds": (
        lambda: arm(t=arm().t * 1000),
        "t: steps by 10 s .median., but rate_hz = 100 says 0.01 s",
    ),
    "no_time": (lambda: without(arm(), "t"), "t: required, but not given"),
    "no_rows": (lambda: Recording(META, {"t": np.empty(0)}), "t: must be one column of at least one row"),
    "partial": (lambda: without(arm(), "q_target_elbow"), "q_target: no column q_target_elbow"),
    "partial_imu": (lambda: arm(imu_acc_x=np.zeros(50)), "imu_acc: no column imu_acc_y, imu_acc_z"),
    "misspelt": (
        lambda: arm(tau_est_elbov=np.zeros(50)),
        "tau_est_elbov: unknown column; did you mean 'tau_est_elbow'",
    ),
    "foreign": (lambda: arm(**{"7": np.zeros(50)}), "7: unknown column; joints are shoulder, elbow"),
    "nameless_leg": (lambda: arm(foot_force_=np.zeros(50)), "foot_force_: unknown column"),
    "quat": (lambda: turned(1.01), "imu_quat: must have length 1, but row 0 has 1.01"),
    "base_quat": (lambda: turned(0.0, "base_quat"), "base_quat: must have length 1, but row 0 has 0"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_channel_is_named_on_reading_and_on_writing(path: Path, case: str) -> None:
    make, match = BROKEN[case]
    with pytest.raises(RecordingError, match=match):
        rec.write(path, make())
    refused(plant(path, make().channels), match)


def test_a_recording_in_memory_may_not_have_other_types_or_lengths(path: Path) -> None:
    wrong: dict[str, Any] = {
        "must be an array of float64, not float32": np.zeros(50, np.float32),
        r"must have shape \(50,\) like t, not \(49,\)": np.zeros(49),
        r"must have shape \(50,\) like t, not \(50, 1\)": np.zeros((50, 1)),
        "must be an array of float64, not list": [0.0] * 50,
        "must be an array of float64, not object": np.array([0.0] * 50, dtype=object),
    }
    for match, values in wrong.items():
        with pytest.raises(RecordingError, match=f"q_elbow: {match}"):
            rec.write(path, Recording(META, {**arm().channels, "q_elbow": values}))
    with pytest.raises(RecordingError, match="torque_enable: must be an array of bool, not float64"):
        rec.write(path, arm(torque_enable=np.ones(50)))


def test_every_problem_is_reported_at_once() -> None:
    recording = spoilt("q_elbow", 0, np.nan)
    recording.channels["speed"] = np.zeros(50)
    recording.channels["t"][9] = 0.0
    assert len(rec.problems(recording)) == 3
    assert rec.problems(arm()) == []


def test_a_go1_has_the_legs_of_a_go1() -> None:
    t = np.arange(5) / 100
    feet = {f"foot_force_{leg}": t for leg in LEGS}
    assert rec.problems(Recording(GO1, {"t": t, **feet})) == []
    assert rec.problems(Recording(GO1, {"t": t, **feet, "foot_force_RF": t}))[0].startswith("foot_force_RF: unknown")
    del feet["foot_force_RL"]
    assert "foot_force: no column foot_force_RL" in rec.problems(Recording(GO1, {"t": t, **feet}))[0]


def test_a_quaternion_rounded_to_three_decimals_and_a_jittering_clock_with_gaps_pass() -> None:
    quat = np.random.default_rng(0).normal(size=(50, 4))
    quat = np.round(quat / np.linalg.norm(quat, axis=1, keepdims=True), 3)
    t = np.cumsum(np.random.default_rng(0).gamma(4, 0.0025, 50))
    t[30:] += 5.0
    rounded = {f"imu_quat_{c}": quat[:, i] for i, c in enumerate("wxyz")}
    assert rec.problems(Recording(META, {**arm().channels, **rounded, "t": t})) == []


def test_importing_the_format_loads_no_engine() -> None:
    code = (
        "import sys, go1exp.logs.recording; "
        "print([m for m in ('torch', 'mujoco', 'hydra', 'gymnasium', 'pyarrow', 'scipy') if m in sys.modules])"
    )
    done = run_alone(Path.cwd(), code=code)
    assert done.stdout.strip() == "[]", done.stderr
