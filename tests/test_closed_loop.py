"""``benchmarks/closed_loop.py``: the hidden robot on its feet, its figures by hand, and the loop itself."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from benchmarks import closed_loop, closed_loop_figures, commands
from benchmarks.closed_loop import Place
from benchmarks.closed_loop_figures import Walks
from benchmarks.closed_loop_sizes import SIZES
from benchmarks.gap import hidden
from benchmarks.gap.motions import RATE
from benchmarks.gap.truth import Truth
from benchmarks.gap.walking import LOAD_AT, PERIOD, Ground, build, follow, squat, walk
from go1exp import robot
from go1exp.config.compose import compose
from go1exp.sim.task import TrainConfig, parse_train

NONE = np.zeros(robot.NUM_JOINTS, dtype=bool)


def quiet() -> np.random.Generator:
    return np.random.default_rng(0)


# ---------------------------------------------------------------------- the robot on its feet


def test_a_squat_is_plain_mujoco() -> None:
    """The nominal robot against ten lines of MuJoCo with the same ground, one robot, its own integrator."""
    dt, gains = 5e-4, (35.0, 0.6)
    target = squat(np.arange(400) / RATE, quiet())
    rows = follow(Truth(), Ground(), target[:, None], [gains], dt, quiet(), NONE)
    model = build(Truth(), Ground(), dt)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    data.qpos[:] = [0.0, 0.0, robot.NOMINAL_HEIGHT, 1.0, 0.0, 0.0, 0.0, *target[0]]
    effort, angles = robot.per_joint(robot.EFFORT_LIMIT), np.empty_like(target)
    for step in range(-1200, 1600):
        if step >= 0 and step % 4 == 0:
            angles[step // 4] = data.qpos[7:]
        torque = gains[0] * (target[max(step // 4, 0)] - data.qpos[7:]) - gains[1] * data.qvel[6:]
        data.ctrl[:] = np.clip(torque, -effort, effort)
        mujoco.mj_step(model, data)
    assert np.ptp(angles, axis=0).max() > 0.2
    np.testing.assert_allclose(rows.samples.q[:, 0], angles, atol=2e-3)


def test_a_robot_that_stands_feels_its_weight() -> None:
    """The accelerometer reads gravity, the IMU is level, and a payload is carried by the legs' torques."""
    still = np.tile(robot.NOMINAL_STANCE, (50, 1))[:, None]
    loaded = Truth()
    loaded.payload = 5.0
    plain, heavy = (follow(t, Ground(), still, [(80.0, 2.0)], 5e-4, quiet(), NONE) for t in (Truth(), loaded))
    np.testing.assert_allclose(np.linalg.norm(plain.acc[-1, 0]), 9.81, rtol=0.01)
    assert abs(plain.gyro[-1]).max() < 0.02
    knees = [abs(rows.samples.torque[-1, 0, 2::3]).sum() for rows in (plain, heavy)]
    assert knees[1] / knees[0] == pytest.approx(1 + 5.0 / 12.743, abs=0.08)
    model = build(loaded, Ground(), 5e-4)
    assert model.body_mass.sum() == pytest.approx(12.743 + 5.0, abs=0.01)
    np.testing.assert_allclose(model.body("payload").pos, LOAD_AT)


def test_a_soft_ground_lets_feet_sink() -> None:
    heights = []
    for ground in (Ground(), Ground(time_constant=0.1)):
        model = build(Truth(), ground, 5e-4)
        data = mujoco.MjData(model)
        data.qpos[:] = [0.0, 0.0, robot.NOMINAL_HEIGHT, 1.0, 0.0, 0.0, 0.0, *robot.NOMINAL_STANCE]
        for _ in range(1000):
            data.ctrl[:] = 80.0 * (robot.NOMINAL_STANCE - data.qpos[7:]) - 2.0 * data.qvel[6:]
            mujoco.mj_step(model, data)
        heights.append(min(data.geom(f"{leg}_foot").xpos[2] for leg in robot.LEGS))
    assert heights[1] < heights[0] - 0.005


def held(readings: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stand still, whatever is asked."""
    stance = np.tile(robot.NOMINAL_STANCE, (len(readings["command"]), 1))
    return {"joint_target": stance, "action": np.zeros_like(stance)}


def folded(readings: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fold the legs: the trunk comes down."""
    stance = np.tile([0.0, 1.4, -2.7] * 4, (len(readings["command"]), 1))
    return {"joint_target": stance, "action": np.zeros_like(stance)}


def test_a_robot_that_stands_or_lies_misses_its_whole_command() -> None:
    robot_, commands = hidden.nominal(Ground()), ((0.5, 0.0, 0.0), (0.0, 0.0, 0.8))
    for policy, falls in ((held, False), (folded, True)):
        errors, fell = hidden.evaluated(robot_, policy, commands, 2, 2.0, 0)
        assert fell.tolist() == [falls] * 4
        np.testing.assert_allclose(errors, [0.5, 0.5, 0.8 * hidden.LEVER, 0.8 * hidden.LEVER], atol=0.01)


def test_first_poses_and_noise_are_those_of_the_seed() -> None:
    """Whatever the robot and the policy: the first readings of all are the same but for what the robot hides."""
    first: list[Mapping[str, np.ndarray]] = []

    for policy in (held, folded):

        def listening(readings: Mapping[str, np.ndarray], policy: Any = policy) -> Any:
            first.append(readings)
            return policy(readings)

        walk(Truth(), Ground(), listening, np.zeros((3, 3)), 0.04, 5e-4, np.random.default_rng([7, 3]), NONE)
    for name, values in first[0].items():
        np.testing.assert_array_equal(values, first[2][name])
    assert abs(first[1]["joint_pos"] - first[3]["joint_pos"]).max() > 0.01


def test_logs_do_not_say_what_the_robot_hides() -> None:
    for name in ("friction", "payload"):
        secret = hidden.make(name, 0, Ground())
        made = hidden.record_hung(secret, name, 0, 4, 0.4)
        made += hidden.record_ground(secret, name, 0, 1, 1.2, held, np.zeros((1, 3)))
        assert [r.meta.base for r in made] == ["fixed"] * 4 + ["floating"] * 2
        for recording in made:
            about = recording.meta
            assert (about.tool, about.notes, about.versions, about.source) == ("logger", "", {}, "measured")
            assert name not in f"{about}"
            assert recording.has("tau_est")
        assert made[-1].t[-1] - made[-1].t[0] == pytest.approx(1.2, abs=0.01)


def test_hung_logs_have_several_gains_and_those_for_a_net_that_of_the_walk() -> None:
    made = hidden.record_hung(hidden.nominal(Ground()), "friction", 0, 6, 0.2)
    fresh = [r.meta.kp[0] for r in made if r.meta.repeat_of is None and r.meta.kp]
    assert fresh == [20.0, 35.0, 20.0, 35.0, 20.0]
    (again,) = [r for r in made if r.meta.repeat_of]
    assert again.meta.kp == next(r.meta.kp for r in made if r.meta.episode == again.meta.repeat_of)
    made = hidden.record_for_net(hidden.nominal(Ground()), "friction", 0, 3, 0.2)
    assert [(r.meta.kp[0], r.meta.kd[0], r.meta.repeat_of) for r in made if r.meta.kp and r.meta.kd] == [
        (20, 0.5, None)
    ] * 3


# ---------------------------------------------------------------------- figures, by hand


def test_the_share_won_back_is_that_of_the_table() -> None:
    """0.10 on the nominal robot, 0.30 before, 0.15 after: 0.15 of 0.20 is won back."""
    wobble = np.array([-0.02, -0.01, 0.01, 0.02])
    share = closed_loop_figures.won_back(0.10 + wobble, 0.30 + wobble, 0.15 + 2 * wobble)
    assert share.estimate == pytest.approx(0.75)
    assert share.low < 0.75 < share.high
    assert share.n == 4
    worse = closed_loop_figures.won_back(0.10 + wobble, 0.30 + wobble, 0.40 + wobble)
    assert worse.estimate == pytest.approx(-0.5)


def test_a_robot_that_adds_nothing_has_no_share() -> None:
    wobble = np.array([-0.02, -0.01, 0.01, 0.02])
    assert np.isnan(closed_loop_figures.won_back(0.10 + wobble, 0.10 - wobble, 0.05 + wobble).estimate)


def test_the_median_leaves_out_robots_without_a_share() -> None:
    median = closed_loop_figures.median_over([0.5, float("nan"), 0.9, 0.7])
    assert (median.estimate, median.n) == (0.7, 3)
    assert (median.low, median.high) == (0.5, 0.9)


def walks(errors: float, falls: int) -> Walks:
    return Walks((errors + np.linspace(-0.01, 0.01, 10))[None], (np.arange(10) < falls)[None])


def test_falls_won_back_are_those_of_all_robots() -> None:
    """1 of 10 falls nominally; 6 and 3 before, 2 and 1 after: 6 of the 7 that the robots add are gone."""
    nominal = walks(0.1, 1)
    robots = [{"before": walks(0.3, b), "effects": walks(0.2, a)} for b, a in ((6, 2), (3, 1))]
    share = closed_loop_figures.falls_won_back(nominal, robots, "effects")
    assert share.estimate == pytest.approx(6 / 7)
    assert np.isnan(
        closed_loop_figures.falls_won_back(nominal, [{"before": nominal, "effects": nominal}], "effects").estimate
    )


def test_figures_and_tables_hold_what_the_rows_hold(tmp_path: Path) -> None:
    nominal = walks(0.1, 0)
    verdict = {"logs": "suspended", "verdict": "explained", "named": ["coulomb (certified)"]}
    each = [
        {"before": walks(0.3, 2), "plain": walks(0.25, 2), "net": walks(0.2, 1), "effects": walks(0.12, 0)},
        {"before": walks(0.5, 2), "plain": walks(0.5, 2), "net": walks(0.3, 1), "effects": walks(0.14, 1)},
        {"before": walks(0.1, 0), "plain": walks(0.1, 0), "net": walks(0.1, 0), "effects": walks(0.09, 0)},
    ]
    names = ("friction", "late", "soft_ground")
    rows = [closed_loop_figures.row_of(n, verdict, nominal, w) for n, w in zip(names, each, strict=True)]
    assert rows[0]["before_falls"] == 2
    assert rows[0]["won_back_effects"] == pytest.approx(0.9)
    figures = closed_loop_figures.figures_of(rows, nominal, each)
    assert figures["closed_loop_won_back"] == pytest.approx(0.9)
    assert figures["closed_loop_won_back_plain"] == pytest.approx(0.125)
    assert figures["closed_loop_won_back_net"] == pytest.approx(0.5)
    assert figures["closed_loop_falls_won_back"] == pytest.approx(0.75)
    assert (figures["closed_loop_robots"], figures["closed_loop_robots_hurt"]) == (3, 2)
    closed_loop_figures.write_table(tmp_path, rows)
    assert json.loads((tmp_path / "robots.json").read_text())[2]["won_back_net"] is None
    assert len((tmp_path / "robots.csv").read_text().splitlines()) == 4
    assert "coulomb (certified)" in closed_loop_figures.table(rows)


def test_of_several_trainings_the_mean_counts_and_each_is_shown() -> None:
    """0.1 nominal, 0.3 before; 0.12 and 0.2 after: 0.9 and 0.5 are won back, 0.7 in the mean."""
    one, other = walks(0.12, 0), walks(0.2, 4)
    twice = Walks(np.concatenate((one.errors, other.errors)), np.concatenate((one.fell, other.fell)))
    each = {"before": walks(0.3, 8), "plain": twice, "net": twice, "effects": twice}
    row = closed_loop_figures.row_of("late", {"logs": "", "verdict": "", "named": []}, walks(0.1, 0), each)
    assert row["won_back_effects"] == pytest.approx(0.7)
    assert row["won_back_effects_each"] == "0.900 0.500"
    assert row["effects_falls"] == 4
    assert row["effects_error"] == pytest.approx(0.16)
    figures = closed_loop_figures.figures_of([row], walks(0.1, 0), [each])
    assert figures["closed_loop_falls_won_back"] == pytest.approx(0.75)  # 2 of 10 are left of 8 of 10
    assert figures["closed_loop_trainings"] == 2


# ---------------------------------------------------------------------- settings, and going on


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "usage"),
        ({"out": "x", "sizes": "small"}, "usage"),
        ({"out": "x", "size": "huge"}, "full, small, tiny"),
        ({"out": "x", "robots": "friction,rust"}, "'rust' must be one of friction"),
        ({"out": "x", "seed": "one"}, "whole numbers"),
        ({"out": "x", "jobs": "0"}, "jobs=0 .* at least 1"),
        ({"out": "x", "trainings": "0"}, "trainings=0: each must be at least 1"),
    ],
)
def test_a_wrong_argument_is_refused(given: dict[str, str], words: str, tmp_path: Path) -> None:
    given = {key: str(tmp_path / "x") if key == "out" else value for key, value in given.items()}
    with pytest.raises(SystemExit, match=words):
        closed_loop.settled(given)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_holds_one_size_and_seed(tmp_path: Path) -> None:
    given = {"out": str(tmp_path), "size": "tiny"}
    assert closed_loop.settled(given)[1] == ("friction",)
    assert closed_loop.settled({**given, "robots": "late,outside"})[1] == ("late", "outside")
    for other in ({"size": "small"}, {"seed": "1"}):
        with pytest.raises(SystemExit, match="another size or seed"):
            closed_loop.settled({**given, **other})


@pytest.mark.parametrize("size", SIZES)
def test_every_training_of_a_size_composes(size: str) -> None:
    """Also the rivals: the hidden robot's effects or drives take the place of those of the task."""
    plan, net = SIZES[size], "actuator.file=assets/go1/actuator_net.npz"

    def composed(*words: str) -> TrainConfig:
        return parse_train(compose("train", [*plan.task, *words, "backend=cpu"]))

    first, walker, plain = composed(*plan.first), composed(*plan.walker), composed(*plan.tuned)
    with_net = composed(*plan.tuned, "actuator=net", net, "actuator.period=resample")
    effects = composed(*plan.tuned, "effect=coulomb")
    for config in (first, walker, plain):
        assert (config.task.actuator.entry.name, config.task.effect, config.task.rand) == ("pd", (), ())
    assert with_net.task.actuator.entry.name == "net"
    assert [term.entry.name for term in effects.task.effect] == ["coulomb"]
    assert plain.ppo == with_net.ppo == effects.ppo
    assert plain.task.sim.physics_dt == plan.physics_dt
    assert plain.task.sim.policy_dt == PERIOD
    assert plain.task.contact.time_constant == plan.ground.time_constant


def test_the_full_plan_has_pairs_and_one_beyond_the_library() -> None:
    full = SIZES["full"].robots
    assert len(full) >= 8
    assert [name for name in full if hidden.SECRETS[name].outside] == ["outside"]
    assert sum(len(hidden.SECRETS[name].effects) == 2 for name in full) >= 2


def test_an_interrupted_training_goes_on_and_a_finished_one_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def listening(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        asked.append(words)
        return 0

    monkeypatch.setattr(commands, "run", listening)
    place, run = Place(tmp_path, SIZES["tiny"], seed=3, jobs=1, threads=1), tmp_path / "plain"
    (run / "checkpoints").mkdir(parents=True)
    closed_loop.tuned(place, run)
    (run / closed_loop.DONE).unlink()
    (run / "checkpoints" / "iteration_1.pt").touch()
    closed_loop.tuned(place, run)
    closed_loop.tuned(place, run)
    first, second = asked
    assert first[0] == "train"
    assert {"seed=3", f"start_from={tmp_path / 'walker'}", "sim.physics_dt=0.005"} <= set(first)
    assert second == ("train", f"resume={run}")
    twice = closed_loop.tuned(dataclasses.replace(place, trainings=2), run)
    assert [each.name for each in twice] == ["plain", "plain_1"]
    assert {"seed=4", f"hydra.run.dir={tmp_path / 'plain_1'}"} <= set(asked[2])
    assert len(asked) == 3


def test_the_feet_are_asked_only_where_hung_logs_give_no_effect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def answering(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        given = dict(word.split("=", 1) for word in words[1:])
        asked.append(given["logs"])
        suspended = given["logs"].endswith("suspended")
        unsure = suspended and "payload" in given["logs"]
        status = "compensating" if unsure else "certified"
        Path(given["out"]).mkdir(parents=True)
        answer = {
            "verdict": "explained",
            "named": [{"effect": "coulomb" if suspended else "payload", "status": status}],
        }
        (Path(given["out"]) / "verdict.json").write_text(json.dumps(answer))
        return 10

    monkeypatch.setattr(commands, "run", answering)
    monkeypatch.setattr(closed_loop, "record", lambda place, name, folder: None)
    place = Place(tmp_path, SIZES["tiny"], seed=0, jobs=1, threads=1)
    for name, support, named in (("friction", "suspended", "coulomb"), ("payload", "ground", "payload")):
        for _ in range(2):  # the second time from what was noted
            verdict = closed_loop.named_effects(place, name)
            assert verdict["logs"] == support
            assert verdict["named"] == [f"{named} (certified)"]
            assert verdict["file"] == str(tmp_path / name / f"gap_{support}" / "effect.yaml")
    assert [Path(logs).relative_to(tmp_path).as_posix() for logs in asked] == [
        "friction/suspended",
        "payload/suspended",
        "payload/ground",
    ]


@pytest.mark.parametrize("jobs", [1, 2])
def test_robots_come_in_order_however_many_are_worked_on(
    jobs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, on threads: what each step does is replaced, and the order of the steps is what counts."""
    steps: list[str] = []

    def noting(what: str, seconds: float = 0.0) -> Callable[..., Any]:
        def step(place: Place, *name: Any) -> Any:
            time.sleep(seconds if name and name[0] == "friction" else 0.0)
            steps.append(" ".join([what, *(str(n) for n in name if isinstance(n, str))]))
            return name[0] if name else None

        return step

    monkeypatch.setattr(closed_loop, "ProcessPoolExecutor", lambda n, *_: ThreadPoolExecutor(n))
    for step in ("walker", "tuned", "evaluate_nominal"):
        monkeypatch.setattr(closed_loop, step, noting(step))
    monkeypatch.setattr(closed_loop, "suspended", noting("suspended", 0.05))
    monkeypatch.setattr(closed_loop, "robot_of", noting("robot_of", 0.05))
    place = Place(tmp_path, SIZES["tiny"], seed=0, jobs=jobs, threads=1)
    assert list(closed_loop.in_turn(place, ["friction", "late"])) == ["friction", "late"]
    for name in ("friction", "late"):
        assert steps.index("walker") < steps.index("tuned") < steps.index(f"robot_of {name}")
        assert jobs == 1 or steps.index(f"suspended {name}") < steps.index(f"robot_of {name}")
    if jobs == 2:  # the quicker one does not wait
        assert steps.index("robot_of late") < steps.index("robot_of friction")


ABOUT = (
    *("benchmarks/closed_loop.py", "benchmarks/closed_loop_figures.py", "benchmarks/closed_loop_sizes.py"),
    *("benchmarks/gap/", "go1exp/train/policy.py", "go1exp/gap/stages/"),
)


@pytest.mark.slow(*ABOUT)
def test_the_whole_loop_at_its_smallest_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped before the last fine-tuning; the second start makes that alone, and the figures."""
    arguments, asked = [f"out={tmp_path}", "size=tiny", "threads=1"], list[str]()
    command = commands.run

    def stopping(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        if any(word.startswith("effect=") for word in words):
            raise KeyboardInterrupt
        return command(*words, allowed=allowed)

    def counting(*words: str, allowed: tuple[int, ...] = (0,)) -> int:
        asked.append(words[0])
        return command(*words, allowed=allowed)

    monkeypatch.setattr(commands, "run", stopping)
    with pytest.raises(KeyboardInterrupt):
        closed_loop.main(arguments)
    assert not (tmp_path / "robots.json").exists()
    monkeypatch.setattr(commands, "run", counting)
    closed_loop.main(arguments)
    assert asked == ["train"]
    (row,) = json.loads((tmp_path / "robots.json").read_text())
    assert "coulomb" in row["named"] or "friction" in row["named"]
    assert row["walks"] == 4
    figures = json.loads((tmp_path / "closed_loop.json").read_text())
    assert figures["closed_loop_robots"] == 1
    assert "size=tiny" in next(iter(figures["made_by"]))
