"""The sealed benchmark of ``go1exp gap``: its robot obeys closed forms, and a seed fixes its cases."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import go1exp.logs.excitations
import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
from benchmarks.gap import cases, damage, generate, known, laws, logger, outside, score
from benchmarks.gap.motions import HIGH, LOW, MOTIONS, RATE
from benchmarks.gap.simulate import Episode, Samples, build, simulate
from benchmarks.gap.truth import Truth, apply
from benchmarks.gap_solve import solve
from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.cli.app import parse
from go1exp.cli.record import RIG, RecordSettings
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.logs.excitations import Motion
from go1exp.logs.record import plan
from go1exp.logs.record.simulate import Rig, play
from go1exp.logs.recording import RecordingError, read_folder
from go1exp.sim.task import parse_parts

HERE = Path(cases.__file__).parent
ALLOWED = {"go1exp", "go1exp.base.paths", "go1exp.logs.recording", "go1exp.robot"}
EVERY = np.arange(12)
NONE = np.zeros(12, dtype=bool)

# ---------------------------------------------------------------------- nothing of the solver


def imported(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            parent = str(node.module)
            yield from (
                (f"{parent}.{a.name}" for a in node.names) if parent in ("go1exp", "benchmarks.gap") else [parent]
            )


@pytest.mark.parametrize("file", sorted(HERE.glob("*.py")), ids=lambda f: f.stem)
def test_the_benchmark_uses_nothing_of_the_solver(file: Path) -> None:
    names = set(imported(file))
    own = {n.removesuffix(".data_root") for n in names if n.split(".")[0] == "go1exp"}
    assert own <= ALLOWED
    assert {n.split(".")[0] for n in names} & {"torch", "hydra", "omegaconf", "importlib", "runpy"} == set()
    assert "__import__" not in file.read_text()
    assert len(file.read_text().splitlines()) <= 400


def test_the_tolerances_are_those_of_the_library() -> None:
    """Copied, not imported: this is the one place where both are seen."""
    import math

    import go1exp.sim.task  # noqa: F401  (registers every effect)
    from go1exp.config.schema.physics import MUJOCO_CONTACT
    from go1exp.config.schema.registry import members
    from go1exp.sim.effects.tolerances import Tolerances

    library: dict[str, dict[str, float]] = {}
    nulls: dict[tuple[str, str], float] = {}
    for name, entry in members("effect").items():
        params: Any = entry.target.params  # type: ignore[attr-defined]
        library[name] = {p.name: p.tolerance for p in params if p.tolerance != math.inf}
        keys = [(name, p.name) for p in params if p.tolerance != math.inf]
        nulls |= {key: Tolerances(contact=MUJOCO_CONTACT).param(key).null for key in keys}
    assert library == known.TOLERANCES
    assert nulls == {(e, p): known.null(e, p) for e, ps in known.TOLERANCES.items() for p in ps}


# ---------------------------------------------------------------------- laws


@pytest.mark.parametrize("speed", [-12.0, -0.02, 0.02, 3.0])
def test_lugre_slides_at_the_friction_level(speed: float) -> None:
    friction, dt = laws.LuGre((1, 1), 2000.0), 2e-4
    level = np.array([[0.3 if speed > 0 else 0.2]])
    for _ in range(5000):
        torque = friction.step(np.array([[speed]]), level, dt)
    assert torque[0, 0] == pytest.approx(np.sign(speed) * level[0, 0], rel=1e-6)


def test_lugre_is_a_spring_before_it_slides_and_never_explodes() -> None:
    friction, dt = laws.LuGre((1, 1), 1000.0), 2e-4
    level = np.array([[0.5]])
    for _ in range(50):  # 10 ms at 2 mrad/s: 20 µrad of the 500 at which it breaks loose
        torque = friction.step(np.array([[0.002]]), level, dt)
    assert friction.z[0, 0] == pytest.approx(2e-5, rel=0.05)
    assert torque[0, 0] == pytest.approx(1000.0 * 2e-5 + 2 * laws.MICRO_DAMPING * np.sqrt(20.0) * 0.002, rel=0.05)
    for speed in np.random.default_rng(0).normal(0, 30, 2000):
        friction.step(np.array([[speed]]), level, dt)
        assert abs(friction.z[0, 0]) <= 0.5 / 1000.0 * (1 + 1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.0013, 0.002, 0.00507])
def test_a_delay_shifts_a_ramp_by_itself(delay: float) -> None:
    dt = 2e-4
    late = laws.Late(np.array([delay, 0.001]), dt, 1)
    t = np.arange(200) * dt
    out = np.array([late.step(np.array([[x, x]]))[0] for x in 3.0 * t])
    np.testing.assert_allclose(out[50:, 0], 3.0 * (t[50:] - delay), atol=1e-12)
    np.testing.assert_allclose(out[50:, 1], 3.0 * (t[50:] - 0.001), atol=1e-12)


def test_a_lag_answers_a_step_exponentially() -> None:
    dt, lag = 2e-4, laws.Lag(np.array([0.005]), 2e-4)
    lag.step(np.zeros((1, 1)))
    out = [lag.step(np.ones((1, 1)))[0, 0] for _ in range(100)]
    end = np.exp(-dt * np.arange(101) / 0.005)
    np.testing.assert_allclose(out, 1 - (end[:-1] - end[1:]) * 0.005 / dt, atol=1e-12)  # mean over each step


def test_two_masses_swing_at_their_resonance() -> None:
    """Rotor and a free joint on a spring: f = sqrt(k (1 / J_r + 1 / J_j)) / 2 pi."""
    rotor, joint, k, dt = 0.01, 0.006, 800.0, 1e-4
    gears = laws.Gears(np.array([rotor]), np.array([1 / k]), np.zeros(1), 0.0, np.array([True]))
    q, v = np.zeros((1, 1)), np.full((1, 1), 1.0)
    gears.angle, gears.speed = np.zeros((1, 1)), np.full((1, 1), -0.6)  # at rest together
    twist = []
    for _ in range(20000):
        through = gears.step(np.zeros((1, 1)), q, v, dt)
        v = v + dt * through / joint
        q = q + dt * v
        assert gears.angle is not None
        twist.append((gears.angle - q)[0, 0])
    spectrum = np.abs(np.fft.rfft(np.hanning(20000) * np.array(twist)))
    found = np.fft.rfftfreq(20000, dt)[np.argmax(spectrum)]
    assert found == pytest.approx(np.sqrt(k * (1 / rotor + 1 / joint)) / (2 * np.pi), abs=0.6)


def test_play_passes_nothing_until_it_is_used_up() -> None:
    gears = laws.Gears(np.array([0.01]), np.zeros(1), np.array([0.02]), 0.05, np.array([True]))
    q, moved = np.zeros((1, 1)), []
    for _ in range(4000):
        through = gears.step(np.array([[0.5]]), q, np.zeros((1, 1)), 1e-4)
        moved.append((float(gears.angle[0, 0]), float(through[0, 0])))  # type: ignore[index]
    assert all(force == 0 for angle, force in moved if angle < 0.0099)
    assert moved[-1] == pytest.approx((0.01 + 0.5 * laws.FLANK, 0.5), rel=0.02)


def test_the_torque_line_has_the_published_corners() -> None:
    """go1-facts section 9: 23.7 at rest, 15.8 at 10, 7.9 at 20, none at 30 rad/s."""
    v, line = np.array([0.0, 10.0, 20.0, 30.0]), np.array([23.7, 15.8, 7.9, 0.0])
    effort, top, droop = np.full(4, 23.7), np.full(4, 30.0), np.ones(4)
    np.testing.assert_allclose(laws.limit(np.full(4, 99.0), v, effort, top, droop), line, atol=1e-9)
    np.testing.assert_allclose(laws.limit(np.full(4, -99.0), -v, effort, top, droop), -line, atol=1e-9)
    np.testing.assert_allclose(laws.limit(np.full(4, -99.0), v, effort, top, 0.0 * droop), -effort)


# ---------------------------------------------------------------------- the robot


def hold(seconds: float, **changes: Any) -> list[Episode]:
    """Hold the nominal stance, or what ``changes`` says."""
    rows = round(seconds * RATE)
    usual: dict[str, Any] = {
        "target": np.tile(robot.NOMINAL_STANCE, (rows, 1)),
        "on": np.ones(rows, dtype=bool),
        "kp": 35.0,
        "kd": 1.2,
        "hang": (0.0, 0.0),
    }
    return [Episode("e", "hold", **{**usual, **changes})]


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the robot settle for 50 ms only, where it does not matter."""
    monkeypatch.setattr("benchmarks.gap.simulate.SETTLE", 0.05)


def run(truth: Truth, episodes: list[Episode], dt: float = 2.5e-4, on: np.ndarray = NONE) -> Samples:
    return simulate(truth, episodes, dt, np.random.default_rng(0), on)


def test_a_clean_null_is_plain_mujoco_within_the_noise() -> None:
    """Replayed with a robot that is built anew at 0.25 ms, a drive in ten lines and MuJoCo's own integrator."""
    case = cases.make("null", 0, 11, count=3, seconds=1.5)
    assert case.answer["clean"]
    (recording, *_), episode = generate.recordings(case), case.episodes[0]
    model = build(Truth(), 2.5e-4)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    rotation = np.array([np.sin(episode.hang[1]), 0.0, -np.cos(episode.hang[1])])  # gravity of a pitched trunk
    model.opt.gravity[:] = 9.81 * rotation
    data = mujoco.MjData(model)
    data.qpos[:] = episode.target[0]
    found, effort = np.empty((len(episode.target), 12)), robot.per_joint(robot.EFFORT_LIMIT)
    for step in range(-3200, len(found) * 8):
        row = max(step // 8, 0)
        if step >= 0 and step % 8 == 0:
            found[row] = data.qpos
        torque = episode.kp * (episode.target[row] - data.qpos) - episode.kd * data.qvel
        data.ctrl[:] = np.clip(torque, -effort, effort)
        mujoco.mj_step(model, data)
    rows = np.round((recording.t - recording.t[0]) * RATE).astype(int)
    error = recording.joint("q") - found[rows]
    floor = np.hypot(case.logger.q_noise, case.logger.q_step / np.sqrt(12))
    assert np.sqrt(np.mean(error**2)) < 1.15 * floor
    assert np.abs(error.mean(axis=0)).max() < 0.3 * floor


def test_a_held_weight_hangs_where_gravity_says() -> None:
    """Static error = gravity torque / kp, with link masses scaled: independent of the drive's damping."""
    truth = Truth()
    apply(truth, "link_mass", {"scale": np.full(12, 1.2)}, EVERY)
    end = run(truth, hold(1.0)).q[-1, 0]
    model = build(Truth(), 1e-3)
    data = mujoco.MjData(model)
    data.qpos[:] = end
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(35.0 * (robot.NOMINAL_STANCE - end), 1.2 * data.qfrc_bias, atol=2e-3)


@pytest.mark.slow("benchmarks/", "go1exp/sim/effects/")
@pytest.mark.parametrize("effect", cases.SUSPENDED)
@pytest.mark.usefixtures("brief")
def test_every_effect_moves_the_robot(effect: str) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(200) / RATE
    target = robot.NOMINAL_STANCE + 0.6 * np.sign(np.sin(2 * np.pi * 5 * t))[:, None] * np.tile([0.3, 0.5, 1.5], 4)
    truth = Truth()
    apply(truth, effect, cases.draw_values(effect, 5.0, EVERY, rng), EVERY)
    a, b = (run(x, hold(0.4, target=target)).q for x in (truth, Truth()))
    assert np.isfinite(a).all()
    assert np.abs(a - b).max() > (1e-4 if effect in ("base_tilt", "encoder_offset", "joint_stop") else 2e-3)


@pytest.mark.slow("benchmarks/", "go1exp/sim/effects/")
@pytest.mark.parametrize("effect", outside.EFFECTS)
@pytest.mark.usefixtures("brief")
def test_every_effect_beyond_the_library_moves_the_robot(effect: str) -> None:
    truth, rng = Truth(), np.random.default_rng(5)
    truth.outside[effect] = {k: high for k, (_, high) in outside.SIZES[effect].items()}
    target, on = MOTIONS["steps"](np.arange(300) / RATE, rng)
    on_thighs = EVERY % 3 == 1 if effect == "coupled_joints" else ~NONE
    a, b = (run(x, hold(0.6, target=target, on=on), on=on_thighs).q for x in (truth, Truth()))
    assert np.abs(a - b).max() > 3e-3
    assert effect not in known.LIBRARY


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_stay_within_the_joints_range(name: str) -> None:
    target, on = MOTIONS[name](np.arange(2500) / RATE, np.random.default_rng(1))
    assert target.shape == (2500, 12)
    assert ((target >= LOW - 1e-12) & (target <= HIGH + 1e-12)).all()
    assert on.all() == (name != "swings")
    assert not on.all() or (np.ptp(target, axis=0) > 0.05).all()


# ---------------------------------------------------------------------- cases


@pytest.mark.parametrize("kind", cases.KINDS)
@pytest.mark.usefixtures("brief")
def test_a_seed_fixes_a_case_bit_for_bit(kind: str) -> None:
    first, second, other = (cases.make(kind, 1, seed, 2, 0.2) for seed in (5, 5, 6))
    assert first.answer == second.answer
    assert first.name == second.name != other.name
    a, b = generate.recordings(first), generate.recordings(second)
    assert [r.meta for r in a] == [r.meta for r in b]
    for x, y in zip(a, b, strict=True):
        assert x.channels.keys() == y.channels.keys()
        assert all(np.array_equal(x.channels[c], y.channels[c]) for c in x.channels)
    c = generate.recordings(other)[0]
    assert not np.array_equal(c.channels["t"][:50], a[0].channels["t"][:50])


def test_the_case_does_not_depend_on_the_others_and_sizes_go_round() -> None:
    drawn = [cases.make("single", i, 3, 2, 0.1).answer["effects"][0] for i in range(3 * len(cases.SUSPENDED))]
    assert {(e["effect"], e["size"]) for e in drawn} == {(e, s) for e in cases.SUSPENDED for s in cases.SIZES}
    for e in drawn:
        for name in e["sizes"]:
            away = np.abs(np.asarray(e["drawn"][name]) - known.null(e["effect"], name))
            assert away.max() <= 1.16 * e["size"] * known.TOLERANCES[e["effect"]][name]
            if e["effect"] not in ("base_tilt", "asymmetric_friction"):
                assert away.min() >= 0.999 * e["size"] * known.TOLERANCES[e["effect"]][name]


def test_the_background_is_within_the_tolerances() -> None:
    for seed in range(20):
        truth, new = Truth(), Truth()
        cases.background(truth, np.random.default_rng(seed), None)
        assert np.abs(truth.mass - 1).max() < known.TOLERANCES["link_mass"]["scale"]
        assert np.abs(truth.com).max() < known.TOLERANCES["link_com"]["along"]
        assert np.abs(truth.armature - new.armature).max() < 1.01 * known.TOLERANCES["armature"]["added"]
        assert truth.forward.max() < known.TOLERANCES["coulomb"]["bound"]
        assert truth.viscous.max() < known.TOLERANCES["viscous"]["damping"]
        assert np.abs(truth.tilt).max() < known.TOLERANCES["base_tilt"]["roll"]
        assert np.abs(truth.offset).max() < known.TOLERANCES["encoder_offset"]["offset"]


def test_pairs_are_of_two_families_and_beyond_is_beyond() -> None:
    for index in range(30):
        pair = [e["effect"] for e in cases.make("pair", index, 9, 2, 0.1).answer["effects"]]
        assert pair[1] not in known.family(pair[0])
    base, spoilt = Truth(), Truth()
    cases.background(base, np.random.default_rng(4), None)
    cases.background(spoilt, np.random.default_rng(4), "coulomb")
    added = spoilt.forward - base.forward
    assert 1.3 * 0.05 <= added.min() <= added.max() <= 1.5 * 0.05 + 1e-12


def test_a_repeated_episode_differs_by_noise_alone() -> None:
    case = cases.make("single", 12, 8, 4, 0.6)
    found = generate.recordings(case)
    (again,) = [r for r in found if r.meta.repeat_of]
    (old,) = [r for r in found if r.meta.episode == again.meta.repeat_of]
    rows = [np.round((r.t - r.t[0]) * RATE).astype(int) for r in (old, again)]
    _, i, j = np.intersect1d(*rows, return_indices=True)
    spread = np.std(old.joint("q")[i] - again.joint("q")[j]) / np.sqrt(2)
    assert spread == pytest.approx(np.hypot(case.logger.q_noise, case.logger.q_step / np.sqrt(12)), rel=0.1)


def test_the_logger_writes_what_it_is_told() -> None:
    rng = np.random.default_rng(0)
    rows = 20000
    zero = np.zeros((rows, 1, 12))
    quiet = logger.Logger(q_noise=5e-4, qd_noise=0.05, torque_noise=0.1, jitter=4e-5, tick=1e-5, dropped=0.01)
    found = logger.log(quiet, Samples(zero, zero, zero), 0, zero[:, 0], np.ones(rows, dtype=bool), rng)
    assert np.std(found["q_FR_hip"]) == pytest.approx(5e-4, rel=0.05)
    assert np.std(found["tau_est_RL_calf"]) == pytest.approx(0.1, rel=0.05)
    assert len(found["t"]) == pytest.approx(0.99 * rows, rel=2e-3)
    steps = np.diff(found["t"])
    assert steps.min() > 0
    assert np.std(steps[steps < 0.003]) == pytest.approx(np.sqrt(2) * 4e-5, rel=0.05)
    coarse = dataclasses.replace(quiet, q_step=1e-3, torque_noise=None)
    found = logger.log(coarse, Samples(zero, zero, zero), 0, zero[:, 0], np.ones(rows, dtype=bool), rng)
    np.testing.assert_allclose(found["q_FR_hip"] / 1e-3, np.round(found["q_FR_hip"] / 1e-3), atol=1e-9)
    assert not any(c.startswith("tau_est") for c in found)


def test_damage_is_what_it_says() -> None:
    case = cases.make("damaged", 0, 4, 2, 0.5)
    case.damage = None
    whole = generate.recordings(case)

    def harm(kind: str) -> Any:
        return damage.damage(whole, kind, np.random.default_rng(1))[0]

    q = whole[0].joint("q")
    swapped = harm("swapped_joints").joint("q")
    moved = np.flatnonzero((swapped != q).any(axis=0))
    assert len(moved) == 2
    np.testing.assert_array_equal(swapped[:, moved], q[:, moved[::-1]])
    np.testing.assert_allclose(harm("degrees").joint("q"), np.degrees(q))
    assert len(harm("dropped").t) == pytest.approx(0.7 * len(q), rel=0.15)
    assert (harm("flipped_sign").joint("q") == -q).all(axis=0).sum() == 1
    assert np.mean(np.diff(harm("repeated").joint("q")[:, 0]) == 0) > 0.2
    frozen = harm("frozen").joint("q")
    assert (np.ptp(frozen[len(q) // 2 :], axis=0) == 0).sum() == 1
    shifted = harm("shifted_commands").joint("q_target")
    assert not np.array_equal(shifted, whole[0].joint("q_target"))
    with pytest.raises(ValueError, match="no damage"):
        harm("nonsense")


# ---------------------------------------------------------------------- the command


@pytest.mark.usefixtures("brief")
def test_the_command_seals_writes_and_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cases, "DAMAGES", ("flipped_sign", "truncated"))
    out, signals = tmp_path / "cases", tmp_path / "signals"
    words = [f"out={out}", "kinds=single,damaged", "n=2", "seed=4", "episodes=2", "seconds=0.1"]
    generate.main(words)
    answers = tmp_path / "cases.answers.json"
    digest = hashlib.sha256(answers.read_bytes()).hexdigest()
    assert (out / "SEAL").read_text().split()[0] == digest
    assert digest in capsys.readouterr().out
    sealed = json.loads(answers.read_text())
    assert sorted(sealed) == sorted(p.name for p in out.glob("case_*"))
    assert not list(out.rglob("*answer*"))
    bad = 0
    for name, answer in sealed.items():
        if answer.get("damage") == "truncated":
            bad += 1
            with pytest.raises(RecordingError):
                read_folder(out / name)
            continue
        found = read_folder(out / name)
        assert len(found) == 2
        assert found[1].meta.repeat_of == found[0].meta.episode
        for r in found:
            text = json.dumps(dataclasses.asdict(r.meta))
            assert r.meta.source == "measured"
            assert not any(word in text for word in (*known.LIBRARY, *outside.EFFECTS, answer["kind"]))
    assert bad == 1
    removed = next(out / name for name, answer in sealed.items() if answer["kind"] == "single")
    before = (removed / "episode_00.parquet").read_bytes()
    for file in removed.iterdir():
        file.unlink()
    removed.rmdir()
    generate.main([*words, f"signals={signals}"])
    assert (removed / "episode_00.parquet").read_bytes() == before
    assert json.loads((signals / f"{removed.name}.json").read_text())["signal"] > 0.01  # in noises of the angles
    with pytest.raises(SystemExit, match="other settings"):
        generate.main([*words[:3], "seed=5", *words[4:]])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=1"], "usage"),
        (["out=x", "seed=1", "kinds=nil"], "must be one of null, near_null, single"),
        (["out=x", "seed=1.5"], "not a number"),
        (["out=x", "seed=1", "effects=stiction"], "must be one of armature"),
        (["out=x", "seed=1", "answers=x/a.json"], "must not lie beside the cases"),
        (["out=x", "seed=1", "size=3"], "no such setting"),
    ],
)
def test_wrong_settings_are_refused(words: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        generate.settings(words)


def test_the_answer_is_the_robot_and_not_only_what_was_added() -> None:
    case = cases.make("single", cases.SUSPENDED.index("armature"), 5, 2, 0.2)
    (effect,) = case.answer["effects"]
    at = [robot.JOINTS.index(j) for j in effect["joints"]]
    nominal = np.tile(known.NOMINAL["armature"], 4)
    assert not case.answer["clean"]
    np.testing.assert_allclose(effect["params"]["added"], (case.truth.armature - nominal)[at], atol=1e-9)
    assert np.abs(np.subtract(effect["params"]["added"], effect["drawn"]["added"])).max() > 1e-6


# ---------------------------------------------------------------------- the library's effects mean the same

QUIET = [f"sensors.{name}={{noise: 0.0, step: 0.0}}" for name in ("q", "qd", "tau_est", "gyro", "acc", "attitude")]
SIGNED = ("base_tilt", "encoder_offset", "link_com", "cogging", "parallel_stiffness")
SHAPED = (
    *("asymmetric_friction", "torque_speed_limit", "command_delay", "load_friction"),
    *("armature", "stribeck", "point_load"),
)


def library(names: tuple[str, ...], values: dict[str, cases.Values], episode: Episode) -> np.ndarray:
    words = ["backend.threads=1", "physics_dt=0.0005", "sensors.jitter=0.0", "sensors.dropped=0.0", *QUIET]
    container = compose("record", words)
    parts, problems = parse_parts(container, RIG)
    assert problems == []
    settings = parse(RecordSettings, {k: v for k, v in container.items() if k not in (*RIG, "excitation")})
    rig = Rig(**parts, physics_dt=settings.physics_dt)
    terms = []
    for name in names:
        plain = {k: v if isinstance(v, float) else tuple(float(x) for x in v) for k, v in values[name].items()}
        term, found = bind("effect", name, plain, name)
        assert found == []
        assert term is not None
        terms.append(term)
    motion = Motion(episode.target, episode.on, episode.target[0].copy(), "suspended")
    one = plan.Episode("e", "steps", motion, episode.kp, episode.kd, episode.hang, None, 0)
    (recording,) = play(
        dataclasses.replace(rig, effect=tuple(terms)), [one], settings.sensors, 0, lambda done, total: None
    )
    return recording.joint("q")


@pytest.mark.slow("benchmarks/", "go1exp/sim/effects/", "go1exp/logs/excitations/", "go1exp/logs/record/")
def test_both_sides_move_alike_under_the_same_effects() -> None:
    """Each group at 5 tolerances, all of it at once: what the effects change differs by some per cent between both."""
    rng, joints = np.random.default_rng(3), np.arange(12)
    target, on = MOTIONS["steps"](np.arange(400) / RATE, rng)
    episode = Episode("e", "steps", target, on, 35.0, 0.6, (0.0, 0.3))

    def mine(truth: Truth) -> np.ndarray:
        return simulate(truth, [episode], 2.5e-4, rng, np.zeros(12, dtype=bool)).q[:, 0]

    plain, theirs = mine(Truth()), library((), {}, episode)
    for group in (SIGNED, SHAPED):
        values = {name: cases.draw_values(name, 5.0, joints, rng) for name in group}
        truth = Truth()
        for name in group:
            apply(truth, name, values[name], joints)
        here, there = mine(truth) - plain, library(group, values, episode) - theirs
        change, differ = (np.sqrt(np.mean(x**2, axis=0)) for x in (here, here - there))
        assert (change > 2e-3).all()
        assert (differ < 0.1 * change).all(), dict(zip(joints, (differ / change).round(3), strict=True))


# ---------------------------------------------------------------------- a small fixed slice, solved and scored

SEED = 20261121
LAG = 2 * len(cases.SUSPENDED) + cases.SUSPENDED.index("lag")
SLICE = (("null", 1), ("single", LAG), ("outside", 0), ("damaged", 2))
"""Kind and index: a background within tolerances, lag at 5 tolerances, one beyond the library, lost samples."""

FAST = ("damaged",)
ABOUT = ("benchmarks/gap/", "benchmarks/gap_solve.py", "go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/physics/")


@pytest.mark.parametrize(
    ("kind", "index"),
    [pytest.param(*case, id=case[0], marks=[] if case[0] in FAST else [pytest.mark.slow(*ABOUT)]) for case in SLICE],
)
def test_a_sealed_case(kind: str, index: int, tmp_path: Path) -> None:
    case = cases.make(kind, index, SEED, count=6, seconds=3.0)
    generate.write_case(case, out=tmp_path / "cases")
    solve(tmp_path / "cases" / case.name, tmp_path / "out", {})
    results = score.read_results(tmp_path / "out")
    found = score.evaluate({case.name: case.answer}, results)
    failures = {name: lines for name, lines in found.failures.items() if lines}
    if kind == "single":
        assert found.figures["first_exact"][0] == found.figures["in_set"][0] == 1.0, failures
        assert results[case.name]["verdict"] in ("explained", "partly explained")
        assert results[case.name]["closed"] > 0.9
    elif kind == "null":
        assert found.figures["false_names"][0] == 0.0, failures
    elif kind == "outside":
        assert found.figures["outside_handled"][0] == 1.0, failures
    else:
        assert results[case.name]["verdict"] == "bad log"


def test_the_bundled_case_is_what_the_generator_makes() -> None:
    """It hides dry friction at the thighs; its README says how it was made."""
    case = cases.make("single", 2, 5, 6, 3.0, ("coulomb",))
    fresh = {r.meta.episode: r for r in generate.recordings(case)}
    bundled = read_folder(data_root() / "assets/demo/suspended_go1")
    assert {r.meta.episode for r in bundled} == set(fresh)
    for recording in bundled:
        assert recording.meta == fresh[recording.meta.episode].meta
        assert abs(recording.joint("q") - fresh[recording.meta.episode].joint("q")).max() < 1e-9
    (effect,) = json.loads(generate.seal({case.name: case.answer})[0])[case.name]["effects"]
    assert effect["effect"] == "coulomb"
    assert {j.split("_")[1] for j in effect["joints"]} == {"thigh"}
