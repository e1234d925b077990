"""``go1exp record``: what the simulated robot's logger writes, against the truth and against a real one's habits."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import go1exp.logs.excitations
import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
from go1exp import robot
from go1exp.cli.app import parse
from go1exp.cli.record import RecordSettings
from go1exp.config.schema.registry import ConfigError
from go1exp.logs.audit import audit
from go1exp.logs.record import simulate
from go1exp.logs.record.sensors import Channel, SensorConfig
from go1exp.logs.recording import Recording, read_folder
from tests.command import refuse
from tests.laboratory import ordered, recorded

Make = Callable[..., list[Recording]]
NOISELESS = [f"sensors.{name}={{noise: 0.0, step: 0.0}}" for name in ("q", "qd", "tau_est", "gyro", "acc", "attitude")]


def make(*overrides: str) -> list[Recording]:
    return list(recorded(["physics_dt=0.001", *overrides])[1])


@pytest.fixture(scope="module")
def hung() -> list[Recording]:
    return make("excitation=[multisine]", "seconds=4.0", "gains=[[20,0.5],[35,1.2]]", "repeats=1")


def test_each_motion_is_recorded_with_each_gain_set_and_the_first_again(hung: list[Recording]) -> None:
    assert [r.meta.episode for r in hung] == [
        "multisine_kp20_kd0.5_0",
        "multisine_kp35_kd1.2_0",
        "multisine_kp20_kd0.5_0_repeat1",
        "multisine_kp35_kd1.2_0_repeat1",
    ]
    assert [r.meta.repeat_of for r in hung] == [None, None, "multisine_kp20_kd0.5_0", "multisine_kp35_kd1.2_0"]
    assert [(r.meta.kp, r.meta.kd) for r in hung[:2]] == [((20.0,) * 12, (0.5,) * 12), ((35.0,) * 12, (1.2,) * 12)]
    for r in hung:
        assert (r.meta.base, r.meta.base_quat, r.meta.source) == ("fixed", (1.0, 0.0, 0.0, 0.0), "simulated")
        assert r.meta.tau_limit == tuple(robot.per_joint(robot.EFFORT_LIMIT))
        assert len(r.t) == 2000


def test_a_repetition_has_the_same_commands_and_the_same_motion_under_other_noise(hung: list[Recording]) -> None:
    first, again = hung[0], hung[2]
    np.testing.assert_array_equal(first.joint("q_target"), again.joint("q_target"))
    difference = first.joint("q") - again.joint("q")
    assert difference.std() == pytest.approx(np.sqrt(2) * 2e-4, rel=0.03)  # noise, and the encoder's steps beside it
    assert abs(difference.mean()) < 1e-5


def test_the_channels_are_those_of_a_go1_and_no_others(hung: list[Recording]) -> None:
    joints = [f"{q}_{j}" for q in ("q", "qd", "q_target", "tau_est") for j in robot.JOINTS]
    imu = [f"imu_{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"] + [f"imu_quat_{a}" for a in "wxyz"]
    assert set(hung[0].channels) == {"t", *joints, *imu, *(f"foot_force_{leg}" for leg in robot.LEGS)}


def test_the_logger_spoils_the_truth_as_it_is_told_to(hung: list[Recording]) -> None:
    (clean,) = make("excitation=[multisine]", "seconds=4.0", *NOISELESS, "sensors.jitter=0.0")
    spoilt = hung[0]
    np.testing.assert_allclose(clean.t, np.arange(2000) / 500.0, atol=1e-12)
    for quantity, noise, step in (("q", 2e-4, 3e-5), ("qd", 0.02, 0.0039), ("tau_est", 0.1, 0.006)):
        error = spoilt.joint(quantity) - clean.joint(quantity)
        assert error.std() == pytest.approx(noise, rel=0.03), quantity
        steps = spoilt.joint(quantity) / step
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    late = spoilt.t - clean.t
    assert late.min() >= 0
    assert late.max() < 0.002
    assert np.sqrt((late**2).mean()) == pytest.approx(1e-4, rel=0.05)
    acc = spoilt.block("imu_acc_x", "imu_acc_y", "imu_acc_z")
    np.testing.assert_allclose(acc.mean(0), [0.0, 0.0, 9.81], atol=0.02)


def test_the_reported_torque_is_the_law_of_the_drive_on_the_recorded_motion() -> None:
    (r,) = make("excitation=[multisine]", "seconds=2.0", *NOISELESS, "sensors.jitter=0.0")
    expected = 20.0 * (r.joint("q_target") - r.joint("q")) - 0.5 * r.joint("qd")
    # The torque reported with a sample is that of the step before it, 1 ms ago.
    np.testing.assert_allclose(r.joint("tau_est"), expected, atol=0.25)
    assert np.std(r.joint("tau_est") - expected) < 0.05 * np.std(expected)


def test_fixed_point_numbers_show_in_the_reported_torque() -> None:
    plain, cut = (
        make("excitation=[multisine]", "seconds=1.0", *NOISELESS, "sensors.jitter=0.0", *effect)[0].joint("tau_est")
        for effect in ((), ("effect=fixed_point",))
    )
    np.testing.assert_allclose(cut * 256, np.trunc(plain * 256), atol=1e-9)  # gains of 20 and 0.5 are whole steps
    assert np.abs(cut - plain).max() > 0.9 / 256


def test_lost_samples_leave_gaps_and_no_trace() -> None:
    (r,) = make("excitation=[multisine]", "seconds=4.0", "sensors.dropped=0.1", "sensors.jitter=0.0")
    assert 1700 < len(r.t) < 1900
    gaps = np.round(np.diff(r.t) * 500).astype(int)
    assert gaps.min() == 1
    assert (gaps > 1).mean() == pytest.approx(0.1, abs=0.03)


def test_a_hung_trunk_hangs_as_it_is_told() -> None:
    result = make(
        "excitation=[slow_ramps]", "seconds=1.0", "hang=[[0.0,0.0],[0.0,0.5],[0.3,0.0]]", "sensors.truth=true"
    )
    assert len({r.meta.episode for r in result}) == 3
    for r, (roll, pitch) in zip(result, [(0.0, 0.0), (0.0, 0.5), (0.3, 0.0)], strict=True):
        up = [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)]
        acc = r.block("imu_acc_x", "imu_acc_y", "imu_acc_z").mean(0)
        np.testing.assert_allclose(acc, 9.81 * np.array(up), atol=0.05)
        assert r.meta.base_quat is not None
        attitude = r.block(*(f"imu_quat_{a}" for a in "wxyz"))
        np.testing.assert_allclose(attitude.mean(0), np.array(r.meta.base_quat), atol=1e-3)
        assert not any(name.startswith("base_") for name in r.channels)  # nothing to measure


def test_a_standing_robot_carries_its_weight_and_its_base_is_known_only_to_motion_capture() -> None:
    (plain,) = make("excitation=[squat]", "seconds=2.0")
    assert (plain.meta.base, plain.meta.base_quat) == ("floating", None)
    assert not any(name.startswith("base_") for name in plain.channels)
    forces = plain.block(*(f"foot_force_{leg}" for leg in robot.LEGS)).sum(1)
    assert np.median(forces) == pytest.approx(12.743 * 9.81, rel=0.1)
    (known,) = make("excitation=[squat]", "seconds=2.0", "sensors.truth=true")
    height = known.block("base_pos_z_w")[:, 0]
    speed = known.block("base_lin_vel_z_w")[:, 0]
    np.testing.assert_allclose(np.gradient(height, known.t)[5:-5], speed[5:-5], atol=0.05)
    assert 0.15 < height.min() < height.max() < 0.36


def test_a_dropped_robot_falls_before_it_lands() -> None:
    (r,) = make("excitation=[drop]", "seconds=1.0", "sensors.truth=true")
    forces = r.block(*(f"foot_force_{leg}" for leg in robot.LEGS)).sum(1)
    height = r.block("base_pos_z_w")[:, 0]
    flight = np.sqrt(2 * (height[0] - 0.325) / 9.81)
    landed = r.t[np.argmax(forces > 20.0)]
    assert landed == pytest.approx(flight, abs=0.02)
    assert forces.max() > 1.5 * 12.7 * 9.81


def test_drives_that_are_off_make_no_torque_and_come_back_gently() -> None:
    (r,) = make("excitation=[torque_off]", "seconds=6.0", *NOISELESS)
    on = r.channels["torque_enable"]
    assert 0.1 < on.mean() < 0.9
    off = ~on
    late = off & np.roll(off, 1)  # the torque of a row is that of the step before it
    assert not r.joint("tau_est")[late].any()
    assert np.abs(r.joint("tau_est")[on]).max() > 0.5
    for row in np.flatnonzero(on[1:] & off[:-1]) + 1:
        np.testing.assert_allclose(r.joint("q_target")[row], r.joint("q")[row], atol=0.02)


def test_all_recordings_of_a_set_are_of_one_robot_even_if_robots_differ() -> None:
    spread = "+effect.encoder_offset={offset: 0.0, spread: {offset: 0.05}}"
    still = ["excitation=[slow_ramps]", "seconds=0.4", "hang=[[0.0,0.0],[0.0,0.3]]", "repeats=1", *NOISELESS]
    result = make(*still, spread)
    plain = make(*still)
    offsets = [np.mean(a.joint("q") - b.joint("q_target"), axis=0) for a, b in zip(result, plain, strict=True)]
    # The drive closes on its own reading, so that what the readings of two poses share is not the offset alone.
    level = [offsets[0], offsets[2]]
    np.testing.assert_allclose(level[0], level[1], atol=1e-9)
    torques = [r.joint("tau_est").mean(0) for r in (result[0], result[2])]
    np.testing.assert_allclose(torques[0], torques[1], atol=1e-9)
    other = make(*still, spread, "seed=1")
    assert np.abs(other[0].joint("tau_est").mean(0) - torques[0]).max() > 0.01


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["excitation=[chirpy]"], "excitation.chirpy: unknown excitation term 'chirpy'; did you mean 'chirp'?"),
        (["excitation=chirp"], "excitation = 'chirp': must be a list"),
        (["excitation=[{chirp: {band: [3.0, 1.0]}}]"], "excitation.chirp.band"),
        (["physics_dt=0.0015"], "physics_dt = 0.0015: 1 / sensors.rate_hz = 0.002 must be a multiple of it"),
        (["gains=[]"], "gains = []: at least one is needed"),
        (["gains=[[1e9,1.0]]"], "gains.0.0 = 1000000000.0: input should be less than or equal to 1023"),
        (["excitation=[policy]"], "run: required for excitation=[policy]"),
        (["support=ground"], "chirp is for a robot that is suspended"),
        (["effect=nope.yaml"], "effect=nope.yaml: no such file"),
        (["sensors.q.noise=-1"], "sensors.q.noise = -1"),
        (["seeds=[0,0]"], "chirp_kp20_kd0.5_0: two recordings of this name"),
        (["out=file"], "out = 'file': cannot be written to"),
        (["excitation=[policy]", "run=nowhere", "repeats=2"], "are for motions"),
    ],
)
def test_settings_that_do_not_fit_are_refused(arguments: list[str], message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = refuse(tmp_path, "record", "seconds=0.2", "out=new", *arguments)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_hidden_effect_moves_the_robot_and_leaves_no_name_in_the_file(tmp_path: Path) -> None:
    words = ["record", "excitation=[slow_ramps]", "seconds=2.0", "physics_dt=0.001"]
    effects = ["effect=[coulomb,encoder_offset]", "effect.encoder_offset.offset=0.03"]
    assert refuse(tmp_path, *words, *effects, "out=with").returncode == 0
    assert refuse(tmp_path, *words, "out=without").returncode == 0
    (file,) = (tmp_path / "with").iterdir()
    (hidden,), (plain,) = read_folder(tmp_path / "with"), read_folder(tmp_path / "without")
    assert np.abs(hidden.joint("q") - plain.joint("q")).max() > 0.01
    assert hidden.meta == plain.meta
    for secret in (b"coulomb", b"encoder_offset", b"effect"):
        assert secret not in file.read_bytes()


def test_a_tilt_that_nobody_knows_of_shows_in_the_attitude_that_the_imu_tells() -> None:
    tilt = ["+effect.base_tilt={roll: 0.1, pitch: -0.15}", "sensors.truth=true", "seconds=1.0"]
    for motion in ("slow_ramps", "squat"):  # hung and free
        (r,) = make(f"excitation=[{motion}]", *tilt)
        attitude = Rotation.from_quat(r.block(*(f"imu_quat_{a}" for a in "wxyz")), scalar_first=True)
        up = attitude.inv().apply([0.0, 0.0, 1.0]).mean(0)
        acc = r.block("imu_acc_x", "imu_acc_y", "imu_acc_z").mean(0)
        np.testing.assert_allclose(up, acc / np.linalg.norm(acc), atol=0.02)
        if motion == "slow_ramps":
            assert r.meta.base_quat == (1.0, 0.0, 0.0, 0.0)
            assert np.arccos(up[2]) == pytest.approx(np.arccos(np.cos(0.1) * np.cos(0.15)), abs=1e-3)


def test_recordings_of_a_clean_robot_pass_the_audit(hung: list[Recording]) -> None:
    for r in (*hung, *make("excitation=[squat]", "seconds=3.0")):
        report = audit(r)
        assert report.verdict != "bad", report.text()


def test_the_same_seeds_give_the_same_files_and_others_do_not() -> None:
    first, same, other = (make("excitation=[steps]", "seconds=1.0", f"seed={s}")[0] for s in (3, 3, 4))
    for name, values in first.channels.items():
        np.testing.assert_array_equal(values, same.channels[name])
    np.testing.assert_array_equal(first.joint("q_target"), other.joint("q_target"))
    assert not np.array_equal(first.joint("q"), other.joint("q"))


def test_a_policy_is_recorded_until_it_falls(make_task: Callable[..., Any]) -> None:
    settings, rig, _ = ordered(["physics_dt=0.001", "sensors.truth=true"])
    trained = make_task("backend.threads=1")

    def policy(observation: torch.Tensor) -> torch.Tensor:
        kick = torch.zeros(len(observation), 12)
        kick[0] = torch.tensor([8.0, 0.0, 0.0] * 4)  # the first robot throws itself over
        return kick

    walk = simulate.Walk(trained, policy, ["a", "b"], 1.6, None)
    fallen, standing = simulate.play_policy(rig, walk, settings.sensors, 0, lambda done, total: None)
    assert len(standing.t) == 800
    assert len(fallen.t) < 800
    assert standing.meta.excitation == "policy"
    assert standing.meta.kp == (20.0,) * 12
    np.testing.assert_array_equal(standing.joint("q_target")[5], robot.NOMINAL_STANCE.astype(np.float32))
    changes = np.flatnonzero(np.any(np.diff(fallen.joint("q_target"), axis=0) != 0, axis=1)) + 1
    assert (changes % 10 == 0).all()  # a policy of 50 Hz in a log of 500


def test_a_hung_robot_can_tread_the_air_under_a_policy(make_task: Callable[..., Any]) -> None:
    settings, rig, _ = ordered(["physics_dt=0.001"])
    observations: list[torch.Tensor] = []

    def policy(observation: torch.Tensor) -> torch.Tensor:
        observations.append(observation.clone())
        return torch.sin(torch.tensor(float(len(observations)))) * torch.ones(len(observation), 12)

    walk = simulate.Walk(make_task("backend.threads=1", "experiment=ablation/no_noise"), policy, ["a"], 1.0, (0.0, 0.2))
    (r,) = simulate.play_policy(rig, walk, settings.sensors, 0, lambda done, total: None)
    assert (r.meta.base, r.meta.base_quat) == ("fixed", simulate.held_quat((0.0, 0.2)))
    assert np.ptp(r.joint("q"), axis=0).min() > 0.05
    acc = r.block("imu_acc_x", "imu_acc_y", "imu_acc_z").mean(0)
    np.testing.assert_allclose(acc, 9.81 * np.array([-np.sin(0.2), 0.0, np.cos(0.2)]), atol=0.05)
    for observation in observations:  # base velocity, angular velocity, gravity: those of a trunk that does not move
        expected = [0.0] * 6 + [np.sin(0.2), 0.0, -np.cos(0.2)]
        np.testing.assert_allclose(observation[0, :9], expected, atol=1e-6)


def test_a_recording_can_be_audited_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    words = ["excitation=[multisine]", "seconds=2.0", "physics_dt=0.001", "out=."]
    assert refuse(tmp_path, "record", *words).returncode == 0
    (file,) = tmp_path.glob("*.parquet")
    done = refuse(tmp_path, "record", "audit", file.name, "out=audit.json")
    assert done.returncode in (0, 3)
    assert "q_FR_hip" in (tmp_path / "audit.json").read_text()
    assert file.name in done.stdout
    (tmp_path / "another.parquet").write_bytes(file.read_bytes()[:2000])
    done = refuse(tmp_path, "record", "audit", ".")
    assert done.returncode == 2
    assert "another.parquet: not a whole Parquet file" in done.stderr
    assert file.name in done.stdout  # the other one is judged all the same


def test_channels_without_noise_or_steps_are_left_as_they_are() -> None:
    from go1exp.logs.record.sensors import log

    rng = np.random.default_rng(0)
    perfect = Channel(0.0, 0.0)
    names = ("q", "qd", "tau_est", "gyro", "acc", "attitude", "foot_force")
    config = SensorConfig(rate_hz=500.0, jitter=0.0, dropped=0.0, truth=True, **dict.fromkeys(names, perfect))
    rows = 20
    true = {name: rng.normal(size=(rows, 12)) for name in ("q", "qd", "q_target", "tau_est")}
    true |= {name: rng.normal(size=(rows, 3)) for name in ("gyro", "acc", "base_pos", "base_lin_vel", "base_ang_vel")}
    true |= {"quat": np.tile([1.0, 0, 0, 0], (rows, 1)), "base_quat": np.tile([1.0, 0, 0, 0], (rows, 1))}
    true |= {"foot_force": rng.uniform(size=(rows, 4)), "torque_enable": np.ones(rows, dtype=bool)}
    result = log(true, config, rng)
    np.testing.assert_array_equal(result["q_FL_calf"], true["q"][:, robot.JOINTS.index("FL_calf")])
    np.testing.assert_array_equal(result["imu_acc_z"], true["acc"][:, 2])
    np.testing.assert_array_equal(result["base_lin_vel_y_w"], true["base_lin_vel"][:, 1])
    assert "torque_enable" not in result  # on throughout
    switched: dict[str, np.ndarray] = {**true, "torque_enable": np.arange(rows) < 5}
    assert log(switched, config, rng)["torque_enable"].sum() == 5
    assert not any(n.startswith("base_") for n in log(true, dataclasses.replace(config, truth=False), rng))
    with pytest.raises(ConfigError):
        parse(RecordSettings, {"gains": []})
