"""The importers: on the real recordings against what their sources say of them, and on damaged ones."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from go1exp.config.schema.registry import ConfigError, members
from go1exp.logs import recording
from go1exp.logs.importers import import_recordings
from go1exp.logs.recording import Recording, RecordingError
from go1exp.robot import JOINT_POS_LIMITS, JOINTS, NOMINAL_STANCE
from tests.made import real

COUNTS = {"go2_in_air": 1, "ak80_double_pendulum": 18, "servo_pendulum_xl330": 12, "so101_arm": 40}
COUNTS |= {"scaler_walk_mocap": 8, "go1_walk_snippet": 1}


def imported(name: str, **options: Any) -> list[Recording]:
    """All recordings of a real source."""
    return import_recordings(name, real(name), options)


def raw(name: str, episode_file: str) -> dict[str, np.ndarray]:
    with np.load(real(name) / episode_file) as file:
        return {key: file[key] for key in file.files}


def multiples(values: np.ndarray, step: float, tolerance: float) -> bool:
    """Whether all differences are whole numbers of ``step``."""
    turns = (values - values[0]) / step
    return bool(np.abs(turns - turns.round()).max() < tolerance)


# ---------------------------------------------------------------------- every source


@pytest.mark.parametrize("name", COUNTS)
def test_every_recording_is_sound_and_survives_the_file(name: str, tmp_path: Path) -> None:
    recordings = imported(name)
    assert len(recordings) == COUNTS[name]
    assert len({r.meta.episode for r in recordings}) == len(recordings)
    for r in recordings:
        assert recording.problems(r) == []
        assert r.meta.source == "measured"
        assert r.meta.notes
        assert r.has("q")
        assert any(c.startswith("tau_") for c in r.channels) == (name == "ak80_double_pendulum")  # none is invented
    path = tmp_path / "x.parquet"
    recording.write(path, recordings[0])
    again = recording.read(path)
    assert again.meta == recordings[0].meta
    assert all(again.channels[k].tobytes() == v.tobytes() for k, v in recordings[0].channels.items())


# ---------------------------------------------------------------------- one by one


def test_go2_joints_are_in_our_order_and_follow_their_own_targets_that_change_every_fourth_row() -> None:
    (r,) = imported("go2_in_air")
    assert r.t.shape == (8500,)
    assert r.meta.rate_hz == 200.0
    assert r.t[-1] == pytest.approx(8499 / 200)
    assert (r.meta.kp, r.meta.kd) == ((20.0,) * 12, (0.5,) * 12)
    changes = np.flatnonzero((np.diff(r.joint("q_target"), axis=0) != 0).any(axis=1))
    steps = np.diff(changes)
    assert (steps == 4).mean() > 0.99  # the source drifts by a row three times in 8,500
    assert "No clock" in r.meta.notes
    assert r.meta.joints == JOINTS
    assert r.joint("q_target")[0] == pytest.approx([0.0, 0.8, -1.5] * 4)
    first = r.joint("q")[0]  # row 0 of the source: FL -0.0249 0.783 -1.483, FR 0.0191 0.792 -1.494, RL ..., RR ...
    assert first[:6] == pytest.approx([0.019128, 0.791984, -1.49415, -0.0248504, 0.782628, -1.48312])
    assert first[6:] == pytest.approx([0.0212727, 0.793492, -1.48734, -0.0227865, 0.786619, -1.47908])
    q, target = r.joint("q"), r.joint("q_target")
    lagged = np.corrcoef(q[8:].T, target[:-8].T)[:12, 12:]
    assert (lagged.argmax(axis=1) == np.arange(12)).all()


def test_ak80_sits_on_the_steps_of_the_motors_messages_and_has_a_target_where_one_was_followed() -> None:
    recordings = imported("ak80_double_pendulum")
    assert [r.meta.robot for r in recordings].count("ak80_double_pendulum_a") == 9
    for r in recordings:
        assert r.meta.joints == ("shoulder", "elbow")
        assert 495 < r.meta.rate_hz < 670
        assert 5.9 < r.t[-1] < 10.1
        for joint in r.meta.joints:
            assert multiples(r.channels[f"q_{joint}"], 25 / 65535, 1e-3)  # 16 bits over +-12.5 rad: 3.81e-4 rad
            assert multiples(r.channels[f"tau_est_{joint}"], 24 / 4095, 1e-3)  # 12 bits over +-12 N m: 5.86e-3 N m
    followed = {r.meta.episode for r in recordings if r.has("q_target")}
    assert followed == {"ak80_a_trajectory_11", "ak80_c_trajectory_12", "ak80_c_trajectory_13"}
    for r in recordings:
        assert r.has("q_target") == any("q_target" in name for name in r.channels)
        assert r.has("tau_cmd")
        assert r.has("tau_est")


def test_xl330_sits_on_4096_steps_a_turn_follows_its_target_and_says_when_it_is_off() -> None:
    recordings = imported("servo_pendulum_xl330")
    for r in recordings:
        assert r.meta.joints == ("pendulum",)
        assert r.meta.kp is None  # the firmware's gain is no N m/rad
        assert 5.9 < r.t[-1] < 6.1
        assert multiples(r.channels["q_pendulum"], 2 * np.pi / 4096, 1e-6)
        falls = r.meta.excitation == "lift_and_drop"
        assert (280 < r.meta.rate_hz < 290) if falls else (186 < r.meta.rate_hz < 190)
        assert r.channels["torque_enable"].all() != falls
        q, target = r.channels["q_pendulum"], r.channels["q_target_pendulum"]
        if falls:
            assert abs(q[-50:].mean()) < 0.05  # it hangs down
        elif r.meta.excitation != "sin_time_square":  # which outruns the servo at low gain
            assert np.corrcoef(q, target)[0, 1] > 0.95
    assert {r.meta.excitation for r in recordings} == {"sin_sin", "sin_time_square", "up_and_down", "lift_and_drop"}
    assert "gain 800 in the firmware's own unit" in recordings[-1].meta.notes


def test_so101_moves_by_whole_steps_and_the_jaw_is_left_out() -> None:
    for r in imported("so101_arm"):
        assert r.meta.joints == ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
        assert r.meta.rate_hz == pytest.approx(49.85, abs=0.01)
        assert 35 < r.t[-1] < 206
        assert multiples(r.joint("q"), 2 * np.pi / 4096, 1e-4)
        assert "Jaw" not in "".join(r.channels)
    (r,) = import_recordings("so101_arm", real("so101_arm/sinusoidal_sweep.npz"), {"base_quat": [0, 1, 0, 0]})
    source = raw("so101_arm", "sinusoidal_sweep.npz")
    assert r.meta.base_quat == (0, 1, 0, 0)
    assert np.array_equal(r.joint("q_target"), source["cmd_pos"][:, :5])


def test_scaler_reads_gravity_upwards_in_its_world() -> None:
    for r in imported("scaler_walk_mocap", reversed_acceleration=False):
        assert 95 < r.meta.rate_hz < 100
        assert not r.has("qd")  # flawed in the source
        attitude = Rotation.from_quat(r.block("base_quat_x", "base_quat_y", "base_quat_z", "base_quat_w"))
        up = attitude.apply(r.block("imu_acc_x", "imu_acc_y", "imu_acc_z")).mean(axis=0)
        assert up == pytest.approx([0, 0, 9.81], abs=0.15)
        walked = r.block("base_pos_x_w", "base_pos_y_w")
        assert 2.0 < np.linalg.norm(walked[-1] - walked[0]) < 2.5


def test_scaler_at_rest_feels_gravity_whichever_way_it_is_read() -> None:
    both = zip(imported("scaler_walk_mocap"), imported("scaler_walk_mocap", reversed_acceleration=False), strict=True)
    for mended, logged in both:
        rest = mended.t > mended.t[-1] - 0.5  # the vertical has had 5 s of standing to settle
        felt = [r.block("imu_acc_x", "imu_acc_y", "imu_acc_z")[rest].mean(axis=0) for r in (mended, logged)]
        assert felt[0] == pytest.approx(felt[1], abs=0.3)
        assert np.linalg.norm(felt[0]) == pytest.approx(9.81, abs=0.1)


def test_scaler_turns_with_its_gyro() -> None:
    """Rotations over 0.1 s are those of the gyro: axes, signs and clocks fit together; pitch is small in this gait."""
    for r in imported("scaler_walk_mocap"):
        attitude = Rotation.from_quat(r.block("base_quat_x", "base_quat_y", "base_quat_z", "base_quat_w"))
        mocap_turn = (attitude[:-10].inv() * attitude[10:]).as_rotvec()
        gyro = r.block("imu_gyro_x", "imu_gyro_y", "imu_gyro_z")
        turned = np.cumsum(gyro * np.gradient(r.t)[:, None], axis=0)
        agreement = np.corrcoef(mocap_turn.T, (turned[10:] - turned[:-10]).T).diagonal(3)
        assert (agreement > [0.9, 0.4, 0.8]).all()


def test_scaler_has_foot_forces_only_where_a_sensor_worked() -> None:
    legs = {r.meta.episode[-2:]: {c[-2:] for c in r.channels if "foot" in c} for r in imported("scaler_walk_mocap")}
    everything = {"FL", "FR", "RR", "RL"}
    assert {run for run, legs_present in legs.items() if not legs_present} == {"19", "20", "22"}
    assert legs.pop("14") == everything - {"FR"}  # its sensor reads some 1500 N throughout
    assert all(legs_present == everything for run, legs_present in legs.items() if run in ("13", "15", "17", "23"))


def test_scaler_without_near_motion_capture_has_no_truth() -> None:
    for r in imported("scaler_walk_mocap", mocap_tolerance_s=0.004):
        assert not [c for c in r.channels if c.startswith("base_")]
        assert "No ground truth" in r.meta.notes


def test_go1_snippet_explains_its_computed_torque_and_stands_like_a_go1() -> None:
    (r,) = imported("go1_walk_snippet")
    source = raw("go1_walk_snippet", "go1_walk_2021-12-20_05-27-36.npz")
    assert r.t.shape == (54,)
    assert r.meta.rate_hz == 50.0
    assert r.t[-1] - r.t[0] == pytest.approx(1.06)
    assert r.meta.kp is not None
    assert r.meta.kd is not None
    kp, kd = np.array(r.meta.kp), np.array(r.meta.kd)
    torque = kp * (r.joint("q_target")[1:] - r.joint("q")[:-1]) - kd * r.joint("qd")[:-1]
    theirs = source["tau_pd_computed"].reshape(54, 4, 3)[1:, [1, 0, 3, 2]].reshape(53, 12)  # FL FR RL RR -> ours
    assert torque == pytest.approx(theirs, abs=1e-4)
    q = r.joint("q")
    assert r.meta.joints == JOINTS
    assert ((q > JOINT_POS_LIMITS[:, 0]) & (q < JOINT_POS_LIMITS[:, 1])).all()
    hips = [0, 3, 6, 9]
    assert (np.sign(q[:, hips].mean(axis=0)) == np.sign(NOMINAL_STANCE[hips])).all()  # right hips turn out by minus
    quat = r.block("imu_quat_x", "imu_quat_y", "imu_quat_z", "imu_quat_w")
    up = Rotation.from_quat(quat).inv().apply([0, 0, 9.81])
    acc = r.block("imu_acc_x", "imu_acc_y", "imu_acc_z")
    assert acc[0] == pytest.approx(up[0], abs=0.2)  # the first sample, before the steps shake it
    assert not [c for c in r.channels if c.startswith("foot_force")]  # contact is 0 or 1, no force


# ---------------------------------------------------------------------- damaged sources


def refused(importer: str, path: Path, match: str, options: dict[str, Any] | None = None) -> None:
    """An import names the file first, and then what is wrong."""
    with pytest.raises(RecordingError, match=match) as caught:
        import_recordings(importer, path, options or {})
    assert str(caught.value).startswith(str(path))


def npz(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def so101(**changes: Any) -> dict[str, Any]:
    names = np.array(["Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw"])
    whole = {"t": np.arange(9) * 0.02, "joint_names": names} | {k: np.zeros((9, 6)) for k in ("pos", "vel", "cmd_pos")}
    return {k: v for k, v in (whole | changes).items() if v is not None}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"vel": None}, "no array 'vel'; it has"),
        ({"joint_names": None}, "no array 'joint_names'"),
        ({"pos": np.zeros((9, 5))}, r"pos: must be numbers \(T, 6\), not float64 \(9, 5\)"),
        ({"pos": np.array([["a"] * 6] * 9)}, "pos: must be numbers"),
        ({"t": np.zeros((9, 1))}, r"t: must be numbers \(T,\)"),
        ({"t": np.zeros(9)}, r"t: must increase strictly, but row 1 \(from 0\) has 0.0 s after 0.0 s \(8 such rows\)"),
        ({"t": np.arange(8) * 0.02}, r"q_Rotation: must have shape \(8,\) like t, not \(9,\)"),
        ({"pos": np.full((9, 6), np.nan)}, "q_Rotation: must be finite"),
        ({"t": np.array([0, 1, 2, 3, 3, 4, 5, 6, 7]) * 0.02}, "t: must increase strictly, but row 4"),
        ({"joint_names": np.arange(6)}, "joint_names: must be a list of words"),
        ({"joint_names": np.array(list("abcdef"))}, "joint_names: must have 'Jaw' among them"),
        ({"pos": np.array([[None] * 6] * 9, dtype=object)}, "not a whole .npz of plain arrays"),
    ],
)
def test_a_damaged_npz_is_named_with_its_key(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    refused("so101_arm", npz(tmp_path / "x.npz", **so101(**changes)), match)


def test_a_truncated_npz_is_refused_and_a_whole_one_is_not(tmp_path: Path) -> None:
    path = npz(tmp_path / "x.npz", **so101())
    (r,) = import_recordings("so101_arm", path, {})
    assert r.joint("q").shape == (9, 5)
    whole = path.read_bytes()
    for kept in (0.0, 0.2, 0.7, 0.999):
        path.write_bytes(whole[: int(kept * len(whole))])
        refused("so101_arm", path, r"x\.npz: not a whole \.npz")


def test_a_missing_path_and_an_empty_folder_are_named(tmp_path: Path) -> None:
    refused("so101_arm", tmp_path / "none", "no such file or folder")
    refused("so101_arm", tmp_path, r"no \*\.npz in this folder")


def test_the_design_of_a_lone_pendulum_file_must_be_told(tmp_path: Path) -> None:
    keys = [f"{k}{i}" for k in ("pos_meas", "vel_meas", "tau_meas", "tau_con") for i in (1, 2)]
    path = npz(tmp_path / "run.npz", time=np.arange(5) * 0.002, **dict.fromkeys(keys, np.zeros(5)))
    refused("ak80_double_pendulum", path, "set design=A or design=C")
    (r,) = import_recordings("ak80_double_pendulum", path, {"design": "C"})
    assert r.meta.robot == "ak80_double_pendulum_c"
    assert not r.has("q_target")
    path = npz(tmp_path / "run.npz", time=np.arange(5) * 0.002, **dict.fromkeys(keys[:-1], np.zeros(5)))
    refused("ak80_double_pendulum", path, "no array 'tau_con2'", {"design": "C"})


HEADER = [*(f"jpos{i}" for i in range(12)), *(f"jvel{i}" for i in range(12)), *(f"jpos{i}_des" for i in range(12))]
WHOLE = ",".join([*HEADER, "kp", "kd"])


def xl330(**changes: Any) -> str:
    row = {"timestamp": 0.0, "position": 0.0, "speed": 0.0, "goal_position": 0.0, "torque_enable": True}
    row |= {"input_volts": 7.4, "temp": 30, "load": 3}
    rows = [row | {"timestamp": 0.005 * i} | changes for i in range(5)]
    rows = [{k: v for k, v in r.items() if v is not None} for r in rows]
    head = {"mass": 0.5, "length": 0.1, "kp": 100, "vin": 7.4, "motor": "xl330", "trajectory": "sin_sin"}
    return json.dumps(head | {"entries": rows})


DAMAGED_TABLES = [
    ("", "has no rows"),
    ("kp,kd\n", "has no rows"),
    ("kp,kd\n20,0.5\n20\n", "not a table of numbers"),
    ("kp,kd\n20,a\n", "not a table of numbers"),
    ("kp,kd\n20,0.5,1\n", "one name for each of its 3 columns"),
    ("kp,kd\n20,0.5\n", "no column 'jpos0'"),
    (f"{WHOLE}\n" + ("0," * 36 + "20,0.5\n") * 3 + "0," * 36 + "25,0.5\n", "kp: must be one"),
    (",".join([*HEADER, "kp"]) + "\n" + ("0," * 36 + "20\n") * 3, "no column 'kd'"),
    (f"{WHOLE}\n" + ("0," * 36 + "-1,0.5\n") * 3, "metadata.kp.0 = -1.0"),
    (f"{WHOLE}\n" + ("nan," * 36 + "20,0.5\n") * 3, "q_FR_hip: must be finite"),
]
DAMAGED_LOGS = [
    ("", "invalid JSON"),
    (xl330()[:-30], "invalid JSON"),
    ("{}", "mass: required, but not given"),
    (xl330(speed=None), r"entries.0.speed: required, but not given\n(.*\n)+.*and 2 more"),
    (xl330(torque_enable=1), "entries.0.torque_enable = 1"),
    (xl330(position="0"), "entries.0.position = '0'"),
    (xl330(timestamp=1.0), r"t: must increase strictly, but row 1 \(from 0\) has 1.0 s after 1.0 s"),
]
DAMAGED = [("go2_in_air", *case) for case in DAMAGED_TABLES]
DAMAGED += [("servo_pendulum_xl330", *case) for case in DAMAGED_LOGS]


@pytest.mark.parametrize(("importer", "text", "match"), DAMAGED)
def test_a_damaged_text_is_named_with_its_column_or_key(tmp_path: Path, importer: str, text: str, match: str) -> None:
    (tmp_path / "x").write_text(text)
    refused(importer, tmp_path / "x", match)


def test_torques_of_other_gains_are_noticed(tmp_path: Path) -> None:
    imported("go1_walk_snippet")
    source = raw("go1_walk_snippet", "go1_walk_2021-12-20_05-27-36.npz")
    source["tau_pd_computed"] = source["tau_pd_computed"] * 1.01
    path = npz(tmp_path / "x.npz", **source)
    refused("go1_walk_snippet", path, r"tau_pd_computed: does not belong to kp = 20, kd = 0.5")


# ---------------------------------------------------------------------- the registry


def test_names_and_options_are_checked_before_any_file_is_opened() -> None:
    nowhere = Path("nowhere")
    wrong: list[tuple[str, dict[str, Any], str]] = [
        ("so101", {}, "unknown importer 'so101'; did you mean 'so101_arm'"),
        ("go2_in_air", {"rate": 100}, "rate: unknown key 'rate'; did you mean 'rate_hz'"),
        ("go2_in_air", {"rate_hz": -1}, "importer.go2_in_air.rate_hz = -1"),
        ("ak80_double_pendulum", {"design": "B"}, "design = 'B'"),
    ]
    for name, options, match in wrong:
        with pytest.raises(ConfigError, match=match):
            import_recordings(name, nowhere, options)


def test_every_importer_is_listed_with_a_sentence() -> None:
    recordings = members("importer")
    assert set(recordings) == {*COUNTS, "mcap_joint_state", "csv", "unitree_lowstate_go1", "unitree_lowstate_go2"}
    for entry in recordings.values():
        assert entry.doc.endswith(".")
        assert entry.schema.model_fields.keys() == entry.parameters.keys()


# ---------------------------------------------------------------------- MCAP

MSGDEF = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

START = 1_700_000_000_123_456_789
"""ns"""


def message(i: int, names: list[str], stamp: int | None = None, **fields: Any) -> dict[str, Any]:
    """One JointState every 2 ms."""
    ns = START + 2_000_000 * i if stamp is None else stamp
    whole = {"position": [0.1 * i + j for j in range(len(names))], "velocity": [1.0] * len(names), "effort": []}
    header = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": ""}
    return {"header": header, "name": names, **whole, **fields}


Sent = list[tuple[int, str, dict[str, Any]]]


def write_cdr(path: Path, sent: Sent, kind: str = "sensor_msgs/msg/JointState", definition: str = MSGDEF) -> Path:
    """Write (row, topic, message); rows are logged a millisecond late."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(kind, definition)
        for i, topic, content in sent:
            log = START + 2_000_000 * i + 1_000_000
            writer.write_message(topic=topic, schema=schema, message=content, log_time=log, publish_time=log)
        writer.finish()
    return path


def write_json(path: Path, sent: Sent) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("JointState", "jsonschema", b"{}")
        channels: dict[str, int] = {}
        for i, topic, content in sent:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema)
            log = START + 2_000_000 * i + 1_000_000
            writer.add_message(channels[topic], log_time=log, data=json.dumps(content).encode(), publish_time=log)
        writer.finish()
    return path


WRITERS: list[Callable[[Path, Sent], Path]] = [write_cdr, write_json]


def joint_states(folder: Path, sent: Sent, **options: Any) -> Recording:
    """The recording of a log with these messages."""
    (r,) = import_recordings("mcap_joint_state", write_cdr(folder / "log.mcap", sent), options)
    return r


def states(rows: int, names: list[str], **fields: Any) -> Sent:
    return [(i, "/joint_states", message(i, names, **fields)) for i in range(rows)]


@pytest.mark.parametrize("write", WRITERS)
def test_mcap_states_come_by_name_with_the_stamps_of_their_headers(
    tmp_path: Path, write: Callable[[Path, Sent], Path]
) -> None:
    sent = states(20, ["b", "a"])
    sent[7][2]["name"] = ["a", "b"]  # a driver may change its mind
    (r,) = import_recordings("mcap_joint_state", write(tmp_path / "log.mcap", sent), {"robot": "arm"})
    assert r.meta.joints == ("b", "a")
    assert r.meta.rate_hz == 500.0
    assert np.array_equal(r.t, np.arange(20) * 2_000_000 / 1e9)
    expected = 0.1 * np.arange(20)[:, None] + [0, 1]
    expected[7] = expected[7, ::-1]
    assert np.array_equal(r.joint("q"), expected)
    assert (r.joint("qd") == 1).all()
    assert not r.has("tau_est")
    assert not r.has("q_target")
    assert f"{START} ns of the header stamps" in r.meta.notes


def test_mcap_commands_hold_until_the_next(tmp_path: Path) -> None:
    sent = states(10, ["a"], effort=[0.5])
    for at, value in ((2, 7.0), (5, 8.0)):  # sent at the very time of rows 2 and 5
        sent.append((at, "/command", message(at, ["a"], position=[value], velocity=[], effort=[value / 10])))
    r = joint_states(tmp_path, sent, command_topic="/command")
    assert r.channels["q_target_a"].tolist() == [7.0] * 3 + [8.0] * 5
    assert r.channels["tau_cmd_a"].tolist() == [0.7] * 3 + [0.8] * 5
    assert r.channels["tau_est_a"].tolist() == [0.5] * 8
    assert r.channels["q_a"] == pytest.approx(0.1 * np.arange(2, 10))
    assert r.t[0] == pytest.approx(0.004)
    assert "The 2 states before" in r.meta.notes


def test_mcap_of_a_go1_comes_in_our_order_unless_told_otherwise(tmp_path: Path) -> None:
    names = sorted(JOINTS)
    sent = states(5, names)
    r = joint_states(tmp_path, sent, kp=[20.0] * 12, base="fixed", base_quat=[1, 0, 0, 0])
    assert r.meta.joints == JOINTS
    assert np.array_equal(r.joint("q")[0], [float(names.index(j)) for j in JOINTS])
    assert joint_states(tmp_path, sent, joints=["RL_calf", "FR_hip"]).meta.joints == ("RL_calf", "FR_hip")


def test_mcap_without_stamps_takes_the_time_of_logging(tmp_path: Path) -> None:
    sent = states(5, ["a"])
    sent[3] = (3, "/joint_states", message(3, ["a"], stamp=0))
    r = joint_states(tmp_path, sent)
    assert np.array_equal(r.t, np.arange(5) * 2_000_000 / 1e9)
    assert "t is the time of logging" in r.meta.notes
    assert f"{START + 1_000_000} ns of the log" in r.meta.notes


@pytest.mark.parametrize("blank", [0.0, float("nan")])
def test_mcap_fields_that_no_one_filled_in_have_no_column(tmp_path: Path, blank: float) -> None:
    r = joint_states(tmp_path, states(5, ["a", "b"], effort=[blank] * 2, velocity=[blank] * 2))
    assert not r.has("tau_est")
    assert not r.has("qd")
    assert "effort of /joint_states is zero or NaN throughout" in r.meta.notes


def spoilt(**fields: Any) -> Sent:
    sent = states(5, ["a", "b"])
    sent[3][2].update(fields)
    return sent


@pytest.mark.parametrize(
    ("sent", "options", "match"),
    [
        (states(5, ["a"]), {"state_topic": "/joints"}, "no message on topic '/joints'; it has /joint_states"),
        (states(5, ["a"]), {"command_topic": "/go"}, "no message on topic '/go'"),
        (states(5, ["a"]), {"joints": ["c"]}, r"/joint_states: lacks joint c; it has 5 messages of \(a\)"),
        (states(5, ["a"]), {"kp": [1.0, 2.0]}, "metadata.kp: has 2 values for 1 joints"),
        (states(5, ["a"], position=[]), {}, "its messages hold no position"),
        (states(1, ["a"]), {}, "t: has 1 stamp; at least 2 are needed"),
        (spoilt(name=["a", "c"]), {"joints": ["b", "c"]}, "has all of the joints in no single message"),
        (spoilt(position=[1.0]), {}, "message 3 has 2 names, but 1 of position"),
        (spoilt(velocity=[1.0]), {}, "message 3 has 2 names, but 1 of velocity"),
        (spoilt(position=[1.0, float("nan")]), {}, "q_b: must be finite"),
        (spoilt(header=message(2, [])["header"]), {}, "t: must increase strictly, but row 3"),
    ],
)
def test_a_log_that_lacks_something_is_named(tmp_path: Path, sent: Sent, options: dict[str, Any], match: str) -> None:
    refused("mcap_joint_state", write_cdr(tmp_path / "log.mcap", sent), match, options)


def test_a_topic_of_another_type_is_refused(tmp_path: Path) -> None:
    path = write_cdr(tmp_path / "log.mcap", states(5, ["a"]), kind="my_msgs/msg/Joints")
    refused("mcap_joint_state", path, "must be sensor_msgs/msg/JointState, not my_msgs/msg/Joints")
    path = write_json(tmp_path / "log.mcap", [(0, "/joint_states", {"position": [1.0]})])
    refused("mcap_joint_state", path, "/joint_states: message 0: name: required")


def test_of_two_sources_that_move_the_commanded_one_is_taken(tmp_path: Path) -> None:
    sent = states(10, ["a"]) + states(30, ["gripper"])
    sent += [(i, "/command", message(i, ["a"])) for i in range(10)]
    r = joint_states(tmp_path, sent, command_topic="/command")
    assert r.meta.joints == ("a",)
    assert "30 messages of another source (gripper) left out" in r.meta.notes


def swinging(robot: int, row: int) -> list[float]:
    """Angles of two joints of one of two robots."""
    return [0.5 * np.sin(0.01 * row + robot + 1) + 0.3 * robot, 0.3 * np.sin(0.02 * row + robot + 1) - 0.3 * robot]


@pytest.mark.parametrize("every", [2, 3, 8])
def test_robots_that_publish_in_turn_on_one_topic_are_refused(tmp_path: Path, every: int) -> None:
    sent = [(i, "/joint_states", message(i, ["a", "b"], position=swinging(i % every == 0, i))) for i in range(200)]
    refused("mcap_joint_state", write_cdr(tmp_path / "log.mcap", sent), "has several publishers of these joints: in ")
    alone = [(i, "/joint_states", message(i, ["a", "b"], position=swinging(0, i))) for i in range(200)]
    lost = np.random.default_rng(0).random(200) < 0.08
    for i in np.flatnonzero(lost):  # of one publisher, in the place of its readings
        alone[i][2]["position"] = [0.0, 0.0]
    assert len(joint_states(tmp_path, alone).t) == 200


@pytest.mark.parametrize(
    ("every", "robots", "rows", "note"),
    [
        (2, 1, 200, "velocity of /joint_states is in 100 of 200 messages (50%) only and is left out"),
        (3, 1, 200, "velocity of /joint_states is in 67 of 200 messages (34%) only and is left out"),
        (2, 2, 100, "100 messages of a second source of these joints (a, b) left out"),
    ],
)
def test_a_speed_in_some_messages_is_left_out_unless_they_are_of_another_robot(
    tmp_path: Path, every: int, robots: int, rows: int, note: str
) -> None:
    sent = [(i, "/joint_states", message(i, ["a", "b"], position=swinging(i % robots, i))) for i in range(200)]
    for i in range(200):
        if i % every:
            sent[i][2]["velocity"] = []
    r = joint_states(tmp_path, sent)
    assert (len(r.t), r.has("qd")) == (rows, robots > 1)
    assert note in r.meta.notes


@pytest.mark.parametrize(
    ("package", "importer", "match"),
    [
        ("unitree_go", "mcap_joint_state", "not unitree_go/msg/LowState; import it with unitree_lowstate_go1 or _go2"),
        ("unitree_hg", "mcap_joint_state", "not unitree_hg/msg/LowState$"),
        ("unitree_hg", "unitree_lowstate_go2", "not unitree_hg/msg/LowState$"),
    ],
)
def test_an_importer_is_proposed_only_where_it_would_work(
    tmp_path: Path, package: str, importer: str, match: str
) -> None:
    path = write_cdr(tmp_path / "log.mcap", states(5, ["a"]), kind=f"{package}/msg/LowState")
    refused(importer, path, match, {"state_topic": "/joint_states"})


def test_a_damaged_log_is_refused(tmp_path: Path) -> None:
    path = write_cdr(tmp_path / "log.mcap", states(50, ["a", "b"]))
    whole = path.read_bytes()
    for kept in (0, 4, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:kept])
        refused("mcap_joint_state", path, f"not a whole MCAP file \\({'..' if kept else 'it is empty'}")
    chunk = whole.index(b"\x28\xb5\x2f\xfd") + 20  # inside the first block of Zstandard
    path.write_bytes(whole[:chunk] + bytes([whole[chunk] ^ 255]) + whole[chunk + 1 :])
    refused("mcap_joint_state", path, "not a whole MCAP file")


def test_without_the_extra_the_message_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_cdr(tmp_path / "log.mcap", states(5, ["a"]))
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(RecordingError, match=r'pip install "go1exp\[logs\]"'):
        import_recordings("mcap_joint_state", path, {})


LOW_STATE = """unitree_go/IMUState imu_state
unitree_go/MotorState[20] motor_state
int16[4] foot_force
uint32 tick
================================================================================
MSG: unitree_go/IMUState
float32[4] quaternion
float32[3] gyroscope
float32[3] accelerometer
================================================================================
MSG: unitree_go/MotorState
float32 q
float32 dq
float32 tau_est
"""


def low_state(i: int, motors: int = 20) -> dict[str, Any]:
    """Return one LowState every 2 ms, whose tick counts milliseconds."""
    imu = {"quaternion": [1.0, 0.0, 0.0, 0.0], "gyroscope": [0.0] * 3, "accelerometer": [0.5, 0.25, 9.75]}
    state = [{"q": k + i / 64, "dq": -k / 4, "tau_est": k / 8} for k in range(motors)]
    return {"imu_state": imu, "motor_state": state, "foot_force": [20, 30, 40, 50 + i], "tick": 2 * i}


def test_low_states_of_a_go2_come_in_the_order_of_the_motors(tmp_path: Path) -> None:
    sent = [(i, "/lowstate", low_state(i)) for i in range(10)]
    path = write_cdr(tmp_path / "log.mcap", sent, "unitree_go/msg/LowState", LOW_STATE)
    (r,) = import_recordings("unitree_lowstate_go2", path, {})
    assert (r.meta.robot, r.meta.joints, r.meta.base) == ("go2", JOINTS, "floating")
    assert np.array_equal(r.t, np.arange(10) * 2_000_000 / 1e9)
    assert np.array_equal(r.joint("q"), np.arange(12) + np.arange(10)[:, None] / 64)
    assert np.array_equal(r.joint("qd")[3], -np.arange(12) / 4)
    assert np.array_equal(r.joint("tau_est")[3], np.arange(12) / 8)
    assert [r.channels[name][0] for name in recording.VECTORS["imu_acc"]] == [0.5, 0.25, 9.75]
    assert not r.has("imu_gyro")
    assert not r.has("foot_force")
    for note in ("gyroscope is zero throughout", "foot_force is in counts without a unit", "tick counts 1000 a second"):
        assert note in r.meta.notes
    (r,) = import_recordings("unitree_lowstate_go2", path, {"foot_newton": 0.5, "foot_zero": [20, 20, 20, 20]})
    assert [r.channels[f"foot_force_{leg}"][2] for leg in ("FR", "FL", "RR", "RL")] == [0.0, 5.0, 10.0, 16.0]


def test_low_commands_of_a_go1_give_targets_and_gains(tmp_path: Path) -> None:
    sent: Sent = [(i, "/low_state", low_state(i)) for i in range(10)]
    for i, q, kd in ((0, 2.146e9, 0.5), (2, 0.75, 0.5), (5, 1.25, 1.0)):
        sent.append((i, "/low_cmd", {"motorCmd": [{"q": q, "Kp": 20.0, "Kd": kd}] * 20}))
    path = write_json(tmp_path / "log.mcap", sent)
    (r,) = import_recordings("unitree_lowstate_go1", path, {"command_topic": "/low_cmd"})
    assert r.meta.robot == "go1"
    assert (r.meta.kp, r.meta.kd) == ((20.0,) * 12, None)
    assert r.channels["q_target_RL_calf"].tolist() == [0.75] * 3 + [1.25] * 5
    assert np.array_equal(r.channels["q_RL_calf"], 11 + np.arange(2, 10) / 64)
    for note in ("of /low_cmd have no target", "kd of /low_cmd changes", "The 2 states before"):
        assert note in r.meta.notes


def test_low_states_of_too_few_motors_are_refused(tmp_path: Path) -> None:
    path = write_json(tmp_path / "log.mcap", [(i, "/low_state", low_state(i, motors=8)) for i in range(3)])
    refused("unitree_lowstate_go1", path, "/low_state: a message has 8 motors; a go1 has 12")
