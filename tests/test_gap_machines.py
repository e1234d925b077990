"""Robots other than the Go1: their models against closed forms, what is made of their recordings, what is found."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from go1exp.base.paths import data_root
from go1exp.cli.hydra_main import choices_from_files
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.gap.answer import name_terms
from go1exp.gap.comparison import NotComparable, compare, prepare
from go1exp.gap.data.prepare import MOST_WINDOWS, clock_of_speeds, noise_in_time, slope
from go1exp.gap.data.windows import averaged
from go1exp.gap.replay.rows import Theta
from go1exp.gap.report.words import next_recordings
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.description import ModelConfig, parse_model
from go1exp.gap.robots.fixed_base import FixedBase, robot_of
from go1exp.gap.robots.go1 import SuspendedGo1
from go1exp.gap.search import tolerances
from go1exp.gap.search.certainty import resampled_values
from go1exp.gap.search.state import LastCheck, begun
from go1exp.gap.stages.explain import explain
from go1exp.logs.importers import import_recordings
from go1exp.logs.recording import Recording, joint_channel
from go1exp.sim.effects.tolerances import declared
from go1exp.sim.physics.fixed_base import FixedBaseError, build_fixed_base
from tests import made
from tests.laboratory import at_rest

MODELS = sorted(f.stem for f in (data_root() / "conf/model").glob("*.yaml") if f.stem != "go1")
LEVEL = (1.0, 0.0, 0.0, 0.0)
G = 9.81


def description(name: str, **changes: Any) -> dict[str, Any]:
    found = OmegaConf.to_container(OmegaConf.load(data_root() / f"conf/model/{name}.yaml"))
    assert isinstance(found, dict)
    return {**found, **changes}


def machine(name: str, **changes: Any) -> FixedBase:
    config = parse_model(description(name, **changes))
    assert isinstance(config, ModelConfig)
    found = robot_of(config, None)  # type: ignore[arg-type]
    assert isinstance(found, FixedBase)
    return found


def still(name: str, q: Any) -> tuple[np.ndarray, np.ndarray]:
    """Torques that hold a model at ``q``, and its inertia there."""
    model = machine(name).model(0.001, LEVEL)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(model, data, full)
    return data.qfrc_bias.copy(), full


# ---------------------------------------------------------------------- models


@pytest.mark.parametrize("name", MODELS)
def test_every_model_is_a_robot_of_its_joints(name: str) -> None:
    found = machine(name)
    model = found.model(0.001, LEVEL)
    assert [model.joint(k).name for k in range(model.njnt)] == list(found.joints)
    assert sorted(k for group in found.groups for k in group) == list(range(len(found.joints)))
    assert all(model.body(joint).id > 0 for joint in (*found.joints, "trunk"))
    backend, setup = found.build(2, 0.001, LEVEL, 1)
    assert backend.qpos.shape == (2, len(found.joints))
    assert torch.all(setup.effort_limit > 0)
    assert not setup.floating


def test_the_servo_pendulum_is_a_point_mass() -> None:
    for q in (0.0, 0.7, -2.0):
        torque, inertia = still("xl330_pendulum", q)
        assert torque[0] == pytest.approx(0.49 * G * 0.1 * np.sin(q), abs=1e-9)
        assert inertia[0, 0] == pytest.approx(0.49 * 0.1**2 + 0.005, abs=2e-6)  # and the mass's own 1e-6


@pytest.mark.parametrize(
    ("name", "m1", "r1", "i1", "l1", "m2", "r2", "i2"),
    [
        ("ak80_double_pendulum_a", 0.608, 0.275, 0.0547, 0.3, 0.630, 0.166, 0.0252),
        ("ak80_double_pendulum_c", 0.548, 0.2, 0.0242, 0.2, 0.598, 0.275, 0.0535),
    ],
)
def test_the_double_pendulums_are_the_textbooks(
    name: str, m1: float, r1: float, i1: float, l1: float, m2: float, r2: float, i2: float
) -> None:
    rotor = 6.1e-5 * 6**2
    for q1, q2 in ((0.0, 0.0), (0.8, -1.3), (-2.0, 0.4)):
        torque, inertia = still(name, (q1, q2))
        low = m2 * r2 * G * np.sin(q1 + q2)
        np.testing.assert_allclose(torque, [(m1 * r1 + m2 * l1) * G * np.sin(q1) + low, low], atol=1e-9)
        cross = m2 * l1 * r2 * np.cos(q2)
        expected = [[i1 + i2 + m2 * l1**2 + 2 * cross + rotor, i2 + cross], [i2 + cross, i2 + rotor]]
        np.testing.assert_allclose(inertia, expected, atol=1e-7)


def test_a_servo_is_a_motor_at_a_voltage_if_its_model_says_so() -> None:
    """Stall torque and top speed are the ends of the motor's line, the limit cuts it; gains are still asked for."""
    one = torch.ones(1, 1, dtype=torch.float64)
    for given, stall in ((1.01, 1.01), (None, 0.81)):
        motor = machine("xl330_pendulum", stall_torque=given)
        _, setup = motor.build(1, 0.001, LEVEL, 1)
        drive: Any = motor.drive()(setup)
        drive.kp.fill_(3.0)
        drive.kd.zero_()
        line = ((0.1, 0.0, 0.3), (9.0, 0.0, 0.81), (9.0, 12.0, 0.25 * stall), (9.0, 16.0, 0.0))
        for error, speed, torque in line:
            assert float(drive.torque(error * one, 0.0 * one, speed * one)) == pytest.approx(torque, abs=1e-12)
    with pytest.raises(NotComparable, match="says no gains"):
        prepare([servo()], machine("xl330_pendulum", firmware=None, kp=None, kd=None), GapSettings())


def test_a_straight_leg_of_the_go2_hangs_like_a_plumb_line() -> None:
    """About the thigh's axis only what lies before it pulls; about the hip's, what lies beside it."""
    torque, _ = still("go2", np.zeros(12))
    calf = (0.154, 0.00548), (0.04, 0.0)
    pulls = 1.152 * -0.00374 + sum(m * x for m, x in calf)
    np.testing.assert_allclose(torque[[1, 4, 7, 10]], -G * pulls, atol=1e-6)
    left = 0.678 * 0.00194 + 1.152 * (0.0955 - 0.0223) + 0.154 * (0.0955 - 0.000975) + 0.04 * 0.0955
    np.testing.assert_allclose(torque[[0, 3, 6, 9]], G * left * np.array([-1, 1, -1, 1]), atol=1e-6)


def test_the_arm_is_held_up_by_its_servos() -> None:
    torque, _ = still("so101", np.zeros(5))
    wrist = 0.079 * 0.0386 + 0.099 * (0.0611 + 0.029)
    elbow = 0.104 * 0.0981 + (0.079 + 0.099) * 0.1349 + wrist
    pitch = elbow + (0.104 + 0.079 + 0.099) * 0.028 + 0.103 * 0.0084
    np.testing.assert_allclose(torque[1:4], -G * np.array([pitch, elbow, wrist]), rtol=1e-6)
    assert torque[0] == pytest.approx(0.0, abs=1e-9)
    upright, _ = still("so101", (0.0, 0.0, -np.pi / 2, 0.0, 0.0))  # forearm up too
    assert abs(upright[2]) < 0.05 * abs(torque[2])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"mjcf": "assets/nowhere.xml"}, "model.mjcf = "),
        ({"mjcf": "assets/SOURCES.md"}, "not a MuJoCo model"),
        ({"base": "table"}, "model.base = 'table': no body of"),
        ({"joints": ["shoulder", "wrist"]}, "model.joints: 'wrist' is no hinge of"),
        ({"joints": ["elbow", "shoulder"]}, "model.joints: must be in the order of"),
        ({"groups": [["shoulder"], ["elbow"]]}, "model.groups: shoulder and elbow must be in one group"),
        ({"groups": [["shoulder"]]}, "model.groups: must have every joint once"),
        ({"torque_limit": {"elbow": 3.0}}, "model.torque_limit: gives shoulder no value"),
        ({"torque_limit": 0.0}, "model.torque_limit = 0.0: every value must be at least"),
        ({"kp": 3.0}, "model.drive = 'torque': takes no kp, kd or firmware"),
        ({"stall_torque": 3.0}, "model.drive = 'torque': takes no stall_torque; drive: voltage does"),
        ({"drive": "current"}, "model.drive = 'current': "),
        ({"masss": 1.0}, "model.masss: unknown key 'masss'"),
        ({"tolerances": {"colomb": {"bound": 1.0}}}, "model.tolerances.colomb: unknown effect 'colomb'; did you mean"),
        ({"tolerances": {"coulomb": {"bond": 1.0}}}, "model.tolerances.coulomb.bond: unknown parameter 'bond'"),
        ({"tolerances": {"stribeck": {"speed": 1.0}}}, "model.tolerances.stribeck.speed: is a shape"),
        (
            {"firmware": {"note": "P gain", "kp": 1.0}, "drive": "position"},
            "note = 'P gain': must have one group, the number",
        ),
    ],
)
def test_a_wrong_description_is_told_by_its_key(changes: Mapping[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        machine("ak80_double_pendulum_a", **changes)
    assert said in str(error.value)
    assert str(error.value).startswith("model.")


def test_the_go1_is_the_model_without_a_file() -> None:
    robot: Any = object()
    assert robot_of(parse_model({"mjcf": None}), robot) == SuspendedGo1(robot)
    with pytest.raises(ConfigError, match=r"model.mjcf: is null, which is the Go1; base would do nothing"):
        parse_model({"mjcf": None, "base": "trunk"})
    with pytest.raises(ConfigError, match=r"model = 'go7': must be a choice"):
        parse_model("go7")


def test_a_users_own_file_names_its_model_from_where_it_lies(tmp_path: Path) -> None:
    source = data_root() / "assets/xl330_pendulum/xl330_pendulum.xml"
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/mine.xml").write_text(source.read_text())
    own = {**description("xl330_pendulum"), "mjcf": "parts/mine.xml", "search": {"window_s": 0.7}}
    OmegaConf.save(OmegaConf.create(own), tmp_path / "mine.yaml")
    given = choices_from_files([f"model={tmp_path}/mine.yaml"], "gap")
    container = compose("gap", given)
    model = parse_model(container["model"])
    assert model is not None
    assert model.mjcf == str(tmp_path / "parts/mine.xml")
    assert container["search"]["window_s"] == 0.7
    assert compose("gap", [*given, "search.window_s=0.2"])["search"]["window_s"] == 0.2
    assert compose("gap", [])["search"]["window_s"] == GapSettings().window_s
    FixedBase.from_config(model)


def test_a_robot_carries_its_tolerances_and_another_robot_beside_it_has_others() -> None:
    key = ("base_tilt", "roll")
    go2, go1 = machine("go2"), SuspendedGo1(None)  # type: ignore[arg-type]
    assert go2.tolerances.param(key).tolerance == 0.05
    assert go1.tolerances.param(key) == declared(key)


# ---------------------------------------------------------------------- recordings


def recording(joints: tuple[str, ...], t: np.ndarray, channels: Mapping[str, np.ndarray], **about: Any) -> Recording:
    usual: dict[str, Any] = {"robot": "servo_pendulum_xl330", "rate_hz": 1 / float(np.median(np.diff(t)))}
    usual |= {"excitation": "sine", "source": "measured"}
    columns = {"t": t} | {
        joint_channel(k, j): v[:, i].copy() for k, v in channels.items() for i, j in enumerate(joints)
    }
    return Recording(made.meta(joints, **(usual | about)), columns)


def servo(episode: str = "one", seconds: float = 6.0, **about: Any) -> Recording:
    t = np.arange(0.0, seconds, 0.005)
    q = np.stack([np.sin(4 * t) + 1e-3 * np.random.default_rng(1).standard_normal(len(t))], 1)
    qd = np.stack([4 * np.cos(4 * t)], 1)
    about = {"notes": "Position gain 200 in the firmware's own unit", "episode": episode} | about
    return recording(("pendulum",), t, {"q": q, "qd": qd, "q_target": q + 0.3 * np.cos(3 * t)[:, None]}, **about)


def test_gains_come_from_the_recording_else_from_its_notes_else_from_the_model() -> None:
    xl330 = machine("xl330_pendulum")
    _, ready = prepare([servo(), servo("two", kp=(1.5,), kd=(0.1,))], xl330, GapSettings())
    assert [(r.meta.kp, r.meta.kd) for r in ready.recordings] == [((0.0029 * 200,), (0.0,)), ((1.5,), (0.1,))]
    assert any("guess: kp 0.58 1.5, kd 0 0.1" in line for line in ready.warnings)
    without = machine("xl330_pendulum", firmware=None)
    with pytest.raises(NotComparable, match="says no gains"):
        prepare([servo()], without, GapSettings())
    with pytest.raises(NotComparable, match="is of the robot 'go2'"):
        prepare([servo(robot="go2")], xl330, GapSettings())


def test_a_speed_that_disagrees_with_the_angle_is_not_compared() -> None:
    xl330 = machine("xl330_pendulum")
    good, bad = servo(), servo("two")
    assert prepare([good], xl330, GapSettings())[1].ignored == ()
    bad.channels["qd_pendulum"] *= 1.15
    fitting, ready = prepare([good, bad], xl330, GapSettings())
    assert ready.ignored == ("qd",)
    assert "times the change of q_pendulum" in ready.warnings[0]
    windows = fitting.windows(ready)
    assert np.all(np.isinf(windows.scale[:, 1]))
    assert np.all(np.isfinite(windows.scale[:, 0]))
    lacking = Recording(good.meta, {k: v for k, v in good.channels.items() if k != "qd_pendulum"})
    fitting, ready = prepare([lacking], xl330, GapSettings())
    assert "1 of 1 recordings have none" in ready.warnings[0]
    np.testing.assert_allclose(ready.recordings[0].joint("qd")[5:-5], good.joint("qd")[5:-5], atol=0.8)


def test_one_bad_recording_of_many_is_left_out_and_said() -> None:
    xl330 = machine("xl330_pendulum")
    many = [servo(f"e{k}") for k in range(4)]
    _, ready = prepare([*many, servo("strange", robot="other")], xl330, GapSettings())
    assert [r.meta.episode for r in ready.recordings] == ["e0", "e1", "e2", "e3"]
    assert any(line.startswith("Left out: strange: is of the robot 'other'") for line in ready.warnings)
    half = [servo("x", robot="other"), servo("y", robot="other")]
    with pytest.raises(NotComparable) as refused:
        prepare([many[0], *half], xl330, GapSettings())
    assert len(refused.value.flaws) == 2
    assert "x, y: is of the robot 'other'" in str(refused.value)
    assert str(refused.value).count("is of the robot") == 1
    assert refused.value.warnings == ()


def test_hours_of_recordings_cost_no_more_than_minutes() -> None:
    fitting, ready = prepare([servo(seconds=200.0)], machine("xl330_pendulum"), GapSettings())
    assert ready.settings.stride_s == pytest.approx(200.0 / MOST_WINDOWS, rel=0.01)
    assert any("s in every" in line for line in ready.warnings)
    assert len(fitting.windows(ready)) <= MOST_WINDOWS


def test_a_slope_is_that_of_a_parabola() -> None:
    t = np.array([0.0, 0.011, 0.019, 0.03, 0.041, 0.052, 0.058])
    np.testing.assert_allclose(slope(t, 3.0 * t), 3.0)
    assert np.all(slope(t[:2], t[:2]) == 0.0)


def test_a_clock_is_rebuilt_from_speeds() -> None:
    rng = np.random.default_rng(0)
    true = np.cumsum(rng.uniform(0.003, 0.006, 3000))
    phase = np.array([0.0, 1.0, 2.5, 4.0])
    q, qd = np.sin(9 * true[:, None] + phase), 9 * np.cos(9 * true[:, None] + phase)
    rows = 0.005 * np.arange(len(true))
    found = clock_of_speeds(rows, q, qd)
    np.testing.assert_allclose(np.diff(found), np.diff(true), rtol=0.02)
    assert np.std(np.diff(rows) - np.diff(true)) > 20 * np.std(np.diff(found) - np.diff(true))
    np.testing.assert_allclose(clock_of_speeds(rows, 0 * q, 0 * qd), rows)  # at rest only the rows tell


def test_noise_of_uneven_samples_is_that_about_the_motion() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.003, 0.006, 3000))
    q = np.sin(9 * t)[:, None] + 2e-3 * rng.standard_normal((3000, 1))
    assert noise_in_time([recording(("pendulum",), t, {"q": q})])[0] == pytest.approx(2e-3, rel=0.1)


def test_a_held_signal_is_averaged_over_steps() -> None:
    rng = np.random.default_rng(0)
    at = np.concatenate([[-0.01], np.sort(rng.uniform(0.0, 0.1, 15))])
    values, times = rng.standard_normal((16, 2)), 0.001 * np.arange(100)
    found = averaged((at, values), times)

    def area(x: np.ndarray) -> np.ndarray:  # under the signal up to x
        ends = np.append(at[1:], np.inf)
        return np.clip(np.minimum(x[:, None], ends) - at, 0.0, None) @ values

    np.testing.assert_allclose(found, (area(times + 0.001) - area(times)) / 0.001, atol=1e-9)


# ---------------------------------------------------------------------- what is found


def played(robot: FixedBase, effects: Mapping[str, Mapping[str, Any]], target: np.ndarray, every: int) -> np.ndarray:
    """Play targets of N robots (K, N, J), one per 0.5 ms step, on the model with effects; return angles (., N, J)."""
    kp, kd = (0.0, 0.0) if robot.config.drive == "torque" else (3.0, 0.05)
    plant = at_rest(robot, effects, target[0], kp, kd, 0.0005)
    found = []
    for k, row in enumerate(torch.as_tensor(target)):
        if k % every == 0:
            found.append(plant.q.numpy().copy())
        plant.step(row)
    return np.array(found)


def swung(
    robot: FixedBase, effects: Mapping[str, Mapping[str, Any]], wide: float, speeds: Sequence[float], seconds: float
) -> list[Recording]:
    """Record the servo that swings its pendulum, ``wide`` rad, by two sines of each speed; noise of 0.2 mrad."""
    steps, logs = np.arange(0.0, seconds, 0.0005), []
    phase = steps[:, None] * np.array(speeds)
    target = (wide * np.sin(phase) + 0.4 * np.sin(2.3 * phase))[..., None]
    for n, q in enumerate(np.moveaxis(played(robot, effects, target, 10), 1, 0)):
        noisy = q + 2e-4 * np.random.default_rng(n).standard_normal(q.shape)
        about: dict[str, Any] = {"kp": (3.0,), "kd": (0.05,), "episode": f"e{n}"}
        logs.append(recording(("pendulum",), steps[::10], {"q": noisy, "q_target": target[::10, n]}, **about))
    return logs


QUICK = GapSettings(
    window_s=0.25,
    stride_s=0.3,
    effects=("coulomb", "stribeck"),
    shortlist=2,
    iterations=2,
    max_terms=1,
    bootstraps=20,
    overlays=1,
    threads=1,
)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only some of the nominal parameters may vary, so that a replay has ten variants and not forty."""
    few = ("strength", "coulomb", "viscous", "link_mass", "base_tilt")
    monkeypatch.setattr(tolerances, "nominal", lambda machine: few)


@pytest.mark.usefixtures("few")
def test_a_gap_that_nothing_explains_beside_impossible_rows_is_laid_to_the_log() -> None:
    robot = machine("xl330_pendulum", tolerances={})
    (log,) = swung(robot, {"coulomb": {"bound": 0.12}}, 0.8, (3.0,), 4.0)
    lost = np.random.default_rng(0).random(len(log.t)) < 0.01
    log.channels["q_pendulum"][lost] = 0.0
    result = explain([log], robot, dataclasses.replace(QUICK, effects=("cogging",)))
    assert (result.verdict, result.named) == ("bad log", ())
    assert "rows of these logs cannot be right" in result.sentence
    assert next_recordings(result) == []
    assert any("q_pendulum" in line and "zeros between" in line for line in result.warnings)


@pytest.mark.usefixtures("few")
@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/", "conf/model/")
def test_friction_hidden_in_a_servo_is_named() -> None:
    robot = machine("xl330_pendulum", tolerances={})
    logs = swung(robot, {"coulomb": {"bound": 0.12}}, 0.8, (3.0, 5.0, 8.0), 6.0)
    result = explain(logs, robot, QUICK)
    assert [n.effect for n in result.named] == ["coulomb"], result.sentence
    assert result.named[0].params["bound"]["pendulum"] == pytest.approx(0.12, abs=0.01)
    assert result.box["base_tilt"]["pitch"].keys() == {"robot"}
    assert any("Speeds are not compared" in line for line in result.warnings)


@pytest.mark.usefixtures("few")
@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/", "conf/model/")
def test_strength_beside_guessed_gains_is_one_set_with_them() -> None:
    """Also where the torque meets its limit, which a strength moves and a gain does not."""
    narrow = {"kp_scale": {"scale": 0.3}, "kd_scale": {"scale": 0.3}}
    robot = machine("xl330_pendulum", tolerances=narrow, firmware=None, kp=3.0, kd=0.05)
    logs = swung(robot, {"strength": {"scale": 2.0}}, 0.8, (3.0, 5.0, 8.0), 6.0)
    silent = [dataclasses.replace(log, meta=dataclasses.replace(log.meta, kp=None, kd=None)) for log in logs]
    (named,) = explain(silent, robot, dataclasses.replace(QUICK, effects=("strength",))).named
    assert set(named.alias_set) == {"strength", "kp_scale", "kd_scale"}


@pytest.mark.usefixtures("few")
@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/", "conf/model/")
@pytest.mark.parametrize("external", [0.0, 1.0])
def test_friction_of_loaded_gears_is_told_from_dry_friction_and_by_its_law(external: float) -> None:
    """A weight that is swung up to the level loads the gears by up to 0.5 N m, hanging down by nothing."""
    robot = machine("xl330_pendulum", tolerances={"coulomb": {"bound": 0.01}})
    hidden = {"load_friction": {"coefficient": 0.2, "external": external}}
    logs = swung(robot, hidden, 1.0, (2.0, 3.0, 5.0, 8.0), 6.0)
    result = explain(logs, robot, dataclasses.replace(QUICK, effects=("coulomb", "load_friction")))
    assert [n.effect for n in result.named] == ["load_friction"], result.sentence
    assert result.named[0].params["external"]["pendulum"] == external
    assert result.named[0].params["coefficient"]["pendulum"] == pytest.approx(0.2, abs=0.02)
    low, high = result.named[0].interval["coefficient"]["pendulum"]
    assert low < 0.2 < high
    assert "external" not in result.named[0].interval
    assert ("external 1" in result.sentence) == (external == 1.0)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.usefixtures("few")
def test_a_value_that_is_held_has_no_interval() -> None:
    """The law of a loaded gear's friction is chosen and held; only the coefficient is fitted, and uncertain."""
    robot = machine("xl330_pendulum", tolerances={})
    hidden = {"coefficient": 0.2, "external": 1.0}
    logs = swung(robot, {"load_friction": hidden}, 1.0, (2.0, 3.0, 5.0), 3.0)
    rng = np.random.default_rng(0)
    found = compare(logs, robot, QUICK)
    search = begun(found.scorer, found.split(rng), found.settings, found.dt, rng)
    theta: Theta = {("load_friction", name): np.array([value]) for name, value in hidden.items()}
    state = dataclasses.replace(search.state, terms=("load_friction",), theta=theta).converged(1)
    aliases = {"load_friction": ("load_friction",)}
    search = dataclasses.replace(search, state=state, aliases=aliases, select_chi2=state.held_out())
    fitted, drawn = resampled_values(search)
    assert fitted["load_friction", "external"] == 1.0
    assert {name for effect, name in drawn if effect == "load_friction"} == {"coefficient"}
    (named,) = name_terms(search, fitted, drawn, True, LastCheck(True, math.nan))
    assert named.params["external"] == {"pendulum": 1.0}
    assert named.interval.keys() == {"coefficient"}


@pytest.mark.usefixtures("few")
@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/", "conf/model/")
def test_friction_hidden_in_a_double_pendulum_of_torque_drives_is_named() -> None:
    robot = machine("ak80_double_pendulum_a", tolerances={})
    steps, logs, joints = np.arange(0.0, 2.5, 0.0005), [], ("shoulder", "elbow")
    for n, speed in enumerate((3.0, 4.0, 6.0)):
        torque = np.stack([0.9 * np.sin(speed * steps), 0.5 * np.sin(1.7 * speed * steps)], 1)
        q = played(robot, {"coulomb": {"bound": {"elbow": 0.15}}}, torque[:, None], 4)[:, 0]
        q += 2e-4 * np.random.default_rng(n).standard_normal(q.shape)
        about = {"robot": "ak80_double_pendulum_a", "episode": f"e{n}"}
        logs.append(recording(joints, steps[::4], {"q": q, "tau_cmd": torque[::4]}, **about))
    result = explain(logs, robot, QUICK)
    assert [n.effect for n in result.named] == ["coulomb"], result.sentence
    assert result.named[0].joints == ("elbow",)
    assert result.named[0].params["bound"]["elbow"] == pytest.approx(0.15, abs=0.015)


@pytest.mark.parametrize(
    ("source", "folder", "name"),
    [
        ("go2_in_air", "go2_in_air", "go2"),
        ("ak80_double_pendulum", "ak80_double_pendulum/design_A_0", "ak80_double_pendulum_a"),
        ("ak80_double_pendulum", "ak80_double_pendulum/design_C_0", "ak80_double_pendulum_c"),
        ("servo_pendulum_xl330", "servo_pendulum_xl330", "xl330_pendulum"),
        ("so101_arm", "so101_arm/step_response.npz", "so101"),
    ],
)
def test_real_recordings_can_be_compared(source: str, folder: str, name: str) -> None:
    robot = machine(name)
    logs = import_recordings(source, made.real(folder), {})[:4]
    defaults = {k: v for k, v in dataclasses.asdict(robot.config.search).items() if v is not None}
    fitting, ready = prepare(logs, robot, GapSettings(**defaults))
    assert ready.ignored == ("qd",)
    windows = fitting.windows(ready)
    assert len(windows) >= 20
    assert np.all(np.isfinite(windows.scale[:, 0]))


def test_the_go2s_rows_are_closer_than_its_file_says() -> None:
    """The clock that hips and thighs tell fits the calves, which had no part in it."""
    (log,) = import_recordings("go2_in_air", made.real("go2_in_air"), {})
    tell = np.array([not j.endswith("calf") for j in log.meta.joints])
    found = clock_of_speeds(log.t, log.joint("q")[:, tell], log.joint("qd")[:, tell])
    assert len(found) / (found[-1] - found[0]) == pytest.approx(226.0, abs=4.0)
    calves = noise_in_time([Recording(log.meta, {**log.channels, "t": found})])[~tell]
    assert np.all(calves < 0.85 * noise_in_time([log])[~tell])


def test_a_model_that_is_no_xml_is_told_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text("<mujoco>\n<worldbody>\n<body>\n</worldbody>\n</mujoco>\n")
    with pytest.raises(ConfigError, match=r"arm\.xml': not a MuJoCo model \(XML parse error .* Line number=3"):
        machine("ak80_double_pendulum_a", mjcf=str(tmp_path / "arm.xml"))


# ---------------------------------------------------------------------- files of a robot of one's own


LINK = '<inertial><mass value="0.3"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
URDF = f"""<robot name="bench"><link name="base_link">{LINK}</link><link name="arm_link">{LINK}{{visual}}</link>
<joint name="arm" type="revolute"><parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="2" velocity="8"/></joint></robot>"""
MJCF = """<mujoco><compiler fusestatic="true"/><worldbody><body name="base_link">
<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><body name="arm_link"><joint name="arm"/>
<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("name", "text"), [("arm.urdf", URDF.format(visual="")), ("arm.xml", MJCF)])
def test_a_base_without_a_joint_remains_a_body(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    model = build_fixed_base(tmp_path / name, "base_link", ["arm"], [2.0], 0.001)
    assert [model.body(k).name for k in range(model.nbody)] == ["world", "trunk", "arm"]


def test_a_joint_that_mimics_another_is_held(tmp_path: Path) -> None:
    finger = f'<link name="finger">{LINK}</link><joint name="mimic" type="revolute"><parent link="arm_link"/>'
    finger += '<child link="finger"/><axis xyz="0 1 0"/><mimic joint="arm" multiplier="0.1"/></joint></robot>'
    (tmp_path / "arm.urdf").write_text(URDF.format(visual="").replace("</robot>", finger))
    model = build_fixed_base(tmp_path / "arm.urdf", "base_link", ["arm"], [2.0], 0.001)
    assert (model.njnt, model.neq) == (1, 0)


def test_a_mesh_that_is_missing_is_named_in_one_line(tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="meshes/link.stl"/></geometry></collision>'
    (tmp_path / "arm.urdf").write_text(URDF.format(visual=mesh))
    with pytest.raises(FixedBaseError, match=r"^mjcf = .*arm\.urdf.*link\.stl") as caught:
        build_fixed_base(tmp_path / "arm.urdf", "base_link", ["arm"], [2.0], 0.001)
    assert len(str(caught.value).splitlines()) == 1


def test_a_body_without_mass_is_named_as_in_the_file(tmp_path: Path) -> None:
    text = URDF.format(visual="").replace(LINK, "", 1)
    (tmp_path / "arm.urdf").write_text(text)
    model = partial(build_fixed_base, tmp_path / "arm.urdf", "base_link", ["arm"], [2.0], 0.001)
    assert model().nv == 1
    with pytest.raises(FixedBaseError, match=r"body 'base_link' can move in its mount: its mass and inertia must be"):
        model(mounted=True)
    (tmp_path / "arm.urdf").write_text(text.replace(LINK, ""))
    with pytest.raises(FixedBaseError, match=r"body 'arm_link' is moved by joint 'arm': its mass and inertia must be"):
        model()


def test_names_and_references_of_a_file_are_its_own(tmp_path: Path) -> None:
    inertial = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
    text = f"""<mujoco><worldbody><light mode="targetbody" target="stand"/><body name="stand">{inertial}<body name="b">
      <joint name="a"/>{inertial}<body name="a"><joint name="b"/>{inertial}<body name="trunk">{inertial}</body></body>
      </body></body></worldbody><contact><exclude body1="stand" body2="b"/></contact>
      <equality><connect body1="a" body2="stand" anchor="0 0 0"/></equality></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    model = build_fixed_base(tmp_path / "arm.xml", "stand", ["a", "b"], [2.0, 2.0], 0.001)
    assert [model.body(k).name for k in range(4)] == ["world", "trunk", "a", "b"]
    assert [model.body(int(side[0])).name for side in (model.eq_obj1id, model.eq_obj2id)] == ["b", "trunk"]
    (tmp_path / "arm.xml").write_text(text.replace('joint name="b"', 'joint name="trunk"'))
    with pytest.raises(FixedBaseError, match="joints: 'trunk' is a name of the base"):
        build_fixed_base(tmp_path / "arm.xml", "stand", ["a", "trunk"], [2.0, 2.0], 0.001)


def test_a_link_whose_mass_lies_on_its_joint_takes_another_mass(tmp_path: Path) -> None:
    """MuJoCo calls such a body simple, and refuses to move its centre of mass afterwards."""
    text = """<mujoco><worldbody><body name="stand"><inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="arm"><joint name="arm" axis="0 0 1"/>
        <inertial mass="0.1" pos="0 0 0" diaginertia="1e-2 1e-2 1e-2"/></body></body></worldbody></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    model = build_fixed_base(tmp_path / "arm.xml", "stand", ["arm"], [2.0], 0.001)
    assert model.body_simple[model.body("arm").id] == 0
    model.body("arm").ipos[:] = [0.05, 0.0, 0.0]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    assert data.M[0] == pytest.approx(1e-2 + 0.1 * 0.05**2)
