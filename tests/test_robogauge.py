"""The grades of RoboGauge against figures by hand, and who gets them: robots that walk, stand or fall."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.evaluate.agents import PolicyAgent
from go1exp.evaluate.protocol.grading import (
    CHANNELS,
    METRICS,
    Graded,
    channels,
    highest_level,
    metrics,
    quality,
    score,
    worse_half,
)
from go1exp.evaluate.protocol.ground import Lanes
from go1exp.evaluate.protocol.plan import Motion, Plan
from go1exp.evaluate.protocol.playing import Rates, play
from go1exp.evaluate.protocol.stage import Stage
from go1exp.mdp.types import Snapshot
from go1exp.sim.env.core import Go1Core
from go1exp.sim.terrain import build_terrain
from tests.test_protocols import selected

LARGEST = (1.0, 1.0, 1.5)


# ---------------------------------------------------------------------- metrics by hand


def test_the_metrics_are_those_by_hand() -> None:
    """One sample after another of one robot, each number of which is one of the six definitions."""
    sampled = np.zeros((2, 1, CHANNELS))
    sampled[0, 0, :6] = [0.7, 0.0, 0.4, 0.0, 0.3, 1.0]  # 0.5 m/s and hypot(0.3, 0.5) rad/s beside what is wanted
    sampled[0, 0, 6:9] = [0.2, 0.05, 30.0]
    sampled[1, 0, 9:] = 6.0  # every torque is 6 N m more than before
    wanted = np.array([[[1.0, 0.0, 0.5]], [[0.0, 0.0, 0.0]]])
    found = dict(zip(METRICS, metrics(sampled, wanted, LARGEST)[0, 0], strict=True))
    assert found["lin_vel"] == pytest.approx(1.0 - 0.5 / math.sqrt(2.0))
    assert found["ang_vel"] == pytest.approx(1.0 - math.hypot(0.3, 0.5) / 1.5)
    assert found["dof_limits"] == pytest.approx(0.95)
    assert found["dof_power"] == pytest.approx(0.7)
    assert found["orientation"] == pytest.approx(0.8)
    assert found["torque_smoothness"] == 1.0  # nothing came before
    assert metrics(sampled, wanted, LARGEST)[1, 0, 5] == pytest.approx(1.0 - 6.0 / 30.0)
    sampled[0, 0, 8] = 500.0
    assert metrics(sampled, wanted, LARGEST)[0, 0, 3] == 0.0  # never below zero


def test_the_channels_are_what_the_robot_does(stands: PolicyAgent) -> None:
    core = Go1Core(stands.task, 1, noise=False)
    core.reset()
    s: Snapshot = core.snapshot()
    q = torch.tensor(robot.JOINT_POS_LIMITS.mean(1), dtype=torch.float32).repeat(1, 1)
    stops = robot.JOINT_POS_LIMITS
    q[0, 1] = float(stops[1, 1])  # a thigh at its stop is 0.3 of its range beyond the middle 40 %
    q[0, 2] = float(stops[2, 1])  # of calves nothing is asked
    torque = torch.zeros(1, 12)
    torque[0, 3], speed = 10.0, torch.full((1, 12), -3.0)
    sine = math.sin(0.5)
    changes = {"joint_pos": q, "joint_torque": torque, "joint_vel": speed}
    s = dataclasses.replace(s, projected_gravity_b=torch.tensor([[0.3, sine, -0.5]]), **changes)
    found = channels(s)[0]
    assert found[6:9].tolist() == pytest.approx([sine, 0.3 / math.sqrt(8.0), 30.0 / math.sqrt(12.0)], rel=1e-5)
    assert found[9:].tolist() == torque[0].tolist()


def test_velocities_count_twice_in_the_quality() -> None:
    assert quality(np.ones(6)) == pytest.approx(1.0)
    assert quality([0.5, 1.0, 1.0, 1.0, 1.0, 1.0]) == pytest.approx(0.5 ** (2.0 / 8.0))
    assert quality([1.0, 1.0, 1.0, 1.0, 0.5, 1.0]) == pytest.approx(0.5 ** (1.0 / 8.0))
    assert 0.0 < quality(np.zeros(6)) < 1e-8


def test_the_worse_half_is_rounded_down() -> None:
    assert worse_half([0.9, 0.1, 0.3, 0.5, 0.7]) == pytest.approx(0.2)
    assert worse_half([0.4]) == 0.4


# ---------------------------------------------------------------------- level and score


@pytest.mark.parametrize("level", range(11))
def test_the_level_is_the_highest_passed(level: int) -> None:
    shares = [1.0] * level + [0.6] * (10 - level)
    assert highest_level(shares, 0.8) == level
    assert highest_level([0.8] * level + [0.79] * (10 - level), 0.8) == level


def test_more_robots_that_pass_are_never_a_lower_level() -> None:
    """Of robots that pass all levels up to their own."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        limits = rng.integers(0, 11, 5)
        better = np.minimum(limits + rng.integers(0, 4, 5), 10)
        of = [highest_level([(each >= k).mean() for k in range(1, 11)], 0.8) for each in (limits, better)]
        assert of[0] <= of[1]


def test_the_score_is_a_tenth_a_level() -> None:
    assert score(10, 1.0) == pytest.approx(1.0)
    assert score(1, 0.5) == pytest.approx(0.095)
    assert score(7, 0.4) == pytest.approx(0.09 * 6 + 0.19 * 0.4)
    assert score(0, 1.0) == 0.0


def rows(levels: dict[str, tuple[int, int]], worst: float) -> list[dict[str, Any]]:
    """Rows of two robots with a friction each, which pass up to their level and have one quality everywhere."""
    made_rows: list[dict[str, Any]] = []
    for n, friction in enumerate((0.4, 0.8)):
        who = {"friction": friction, "robot": n}
        for name, of_robot in levels.items():
            passed = {f"level_{k}": k <= of_robot[n] for k in range(1, 11)}
            made_rows.append({**who, "ground": name, **passed, "quality_worst": worst if of_robot[n] else None})
        made_rows.append({**who, "ground": "flat", "quality_worst": worst})
    return made_rows


def test_the_table_of_fixed_figures_has_the_score_by_hand() -> None:
    protocol: Any = selected("robogauge").protocol
    fixed = rows({"waves": (4, 0), "obstacles": (2, 8)}, 0.5)
    figures = {(d.name, d.condition.get("ground")): d for d in protocol.derived(fixed)}

    def of(name: str, ground: str | None) -> float:
        those = [r for r in fixed if ground in (None, r["ground"])]
        return figures[name, ground].function(those)

    waves = 0.5 * (0.09 * 3 + 0.19 * 0.5 + 0.0)
    obstacles = 0.5 * (0.09 * 1 + 0.09 * 7 + 2 * 0.19 * 0.5)
    assert of("level", "waves") == 2.0
    assert of("score", "waves") == pytest.approx(waves)
    assert of("score", "obstacles") == pytest.approx(obstacles)
    assert of("score", "flat") == 0.5
    assert of("overall_score", None) == pytest.approx((waves + obstacles + 0.5) / 3.0)
    assert of("overall_level", None) == pytest.approx(0.5 * (2.0 + 5.0))


# ---------------------------------------------------------------------- robots


def test_a_fall_makes_every_later_sample_zero() -> None:
    """One robot falls half through a sub-task of which it does everything else right; the other stays up."""
    protocol: Any = selected("robogauge", "settle_s=0.0").protocol
    steps, dt = 300, 0.02
    (task,) = [s for s in protocol.subtasks(LARGEST) if s.group == "pairs" and s.command == (1.0, 1.0, 0.0)]
    figures, command = np.zeros((steps, 2, CHANNELS)), np.tile(task.command, (steps, 2, 1))
    figures[..., :2] = command[..., :2]
    alive = np.ones((steps, 2), bool)
    alive[150:, 0] = False
    zeros, nobody = np.zeros((steps, 2)), np.zeros(2, bool)
    lives: dict[str, Any] = {"alive": alive, "fell": np.array([True, False]), "left_map": nobody}
    moved: dict[str, Any] = {"velocity": command, "height": zeros, "way": zeros, "front_right": zeros}
    motion = Motion(dt=dt, t=np.arange(1.0, steps + 1.0) * dt, command=command, figures=figures, **moved, **lives)
    graded = Graded(motion, LARGEST, 0.0)
    fallen, up = (graded.row([(i, task)]) for i in (0, 1))
    assert (up["quality"], up["quality_worst"], up["fell"]) == (pytest.approx(1.0), pytest.approx(1.0), False)
    assert (fallen["quality"], fallen["quality_worst"]) == (pytest.approx(0.5), pytest.approx(0.0, abs=1e-9))
    assert (fallen["fell"], fallen["lin_vel"]) == (True, pytest.approx(1.0))
    assert fallen["moving_s"] == pytest.approx(3.0)


def test_the_subtasks_are_the_published_ones() -> None:
    protocol: Any = selected("robogauge").protocol
    tasks = protocol.subtasks(protocol.flat)
    assert [s.command for s in tasks if s.group == "axes"][:2] == [(2.0, 0.0, 0.0), (-2.0, 0.0, 0.0)]
    assert (len(tasks), len({s.command for s in tasks if s.group == "pairs"})) == (14, 8)
    assert {(s.until, s.then, s.length) for s in tasks} == {(5.0, 0.0, 7.0), (3.0, -1.0, 6.0)}
    slopes = protocol.assessed["slope_forward"].levels
    np.testing.assert_allclose(np.tan(np.radians(slopes)), 0.1 + 0.047 * np.arange(1, 11), atol=2e-3)
    assert protocol.assessed["stairs_backward"].levels[::9] == (0.08, 0.23)


def test_a_robot_that_stands_passes_nothing_and_does_not_follow(stands: PolicyAgent) -> None:
    result = play(selected("robogauge", "~grounds", *SMALL), stands, Rates(seed=1))
    figures: dict[tuple[str, Any], Any] = {
        (name, e["condition"].get("ground")): f["estimate"] for e in result.summary for name, f in e["figures"].items()
    }
    assert (figures["level", "slope"], figures["score", "slope"]) == (0.0, 0.0)
    flat = [r for r in result.played.rows if r["ground"] == "flat"]
    assert len(flat) == 2
    # Standing misses diagonals and yaw altogether, x and y by 1 of hypot(1, 1), and nothing while it is to stand.
    assert all(0.0 < r["quality_worst"] < 0.3 < r["quality"] < 0.6 < r["torque_smoothness"] for r in flat)
    assert figures["overall_score", None] == pytest.approx(0.5 * figures["score", "flat"])


SMALL = (
    *("robots=1", "frictions=[0.5,1.0]", "flat=[1.0,1.0,1.0]", "move_s=0.4", "stand_s=0.2", "pair_s=0.4"),
    *("settle_s=0.2", "noise=false"),
    "grounds={slope:{lane:slope_up,levels:[1.0,2.0],course:0.5,speed:1.0,seconds:0.4,backward:false}}",
)


def test_who_passes_follows_the_commands_in_the_middle_of_the_highest_level(
    stands: PolicyAgent, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Robots that are said to have come far with the first friction, and not with the second."""
    plans: list[Plan] = []
    run = Stage.run

    def seen(stage: Stage, plan: Plan) -> Motion:
        plans.append(plan)
        motion = run(stage, plan)
        far = np.array([10.0, 10.0, 0.0, 0.0]) if plan.finish else 0.0
        return dataclasses.replace(motion, way=motion.way + far)

    monkeypatch.setattr(Stage, "run", seen)
    result = play(selected("robogauge", "~grounds", *SMALL), stands, Rates(seed=1))
    walked, followed, flat = plans
    assert (walked.robots, followed.robots, flat.robots) == (4, 14, 28)
    assert isinstance(followed.ground, Lanes)
    assert (followed.ground.levels, followed.ground.start) == ((2.0,), 0.5 * followed.ground.course)
    assert followed.friction is not None
    assert {float(each) for bound in followed.friction for each in np.ravel(bound)} == {0.5}
    assert (np.abs(followed.command).max((0, 1)) == (1.0, 1.0, 1.5)).all()
    assert (np.abs(flat.command).max((0, 1)) == (1.0, 1.0, 1.0)).all()
    assert (followed.command[:10] == 0.0).all()
    (row, other) = [r for r in result.played.rows if r["ground"] == "slope"]
    assert (row["level_1"], row["level_2"], other["level_1"]) == (True, True, False)
    assert (row["fell"], other["fell"], other.get("quality_worst")) == (False, None, None)
    (found,) = [
        e["figures"]["score"]
        for e in result.summary
        if e["condition"] == {"ground": "slope"} and "score" in e["figures"]
    ]
    assert row["quality_worst"] > 0.0
    assert found["estimate"] == pytest.approx(0.5 * (0.09 + 0.19 * row["quality_worst"]), rel=1e-4)


def test_each_robot_has_its_own_friction(stage: Stage) -> None:
    friction = np.array([0.2, 0.9, 0.4])
    core = stage.session(Plan(np.zeros((1, 3, 3)), friction=(friction, friction))).core
    feet = core.backend.field("geom_friction")[:, core.backend.ids("geom", robot.FEET), 0]
    np.testing.assert_allclose(feet.numpy(), np.tile(friction[:, None], (1, 4)), rtol=1e-6)


def test_the_figures_of_a_plan_take_the_memory_that_is_said(stage: Stage) -> None:
    motion = stage.run(Plan(np.zeros((3, 2, 3)), figures=channels))
    assert motion.figures is not None
    assert motion.figures.shape == (3, 2, CHANNELS)
    further = stage.bytes_per_second(2, None, CHANNELS)[0] - stage.bytes_per_second(2, None, 0)[0]
    assert motion.figures.nbytes == pytest.approx(further * 3 * stage.policy_dt)


# ---------------------------------------------------------------------- ground


def test_lanes_for_backward_walking_are_the_mirror_image() -> None:
    ahead, behind = (build_terrain(Lanes(ground="stairs_up", levels=(0.1,), backward=b)) for b in (False, True))
    x = np.linspace(-1.5, 8.5, 60)
    y = np.full_like(x, 0.3)
    np.testing.assert_allclose(ahead.height_at(np.stack([x, y], 1)), behind.height_at(np.stack([-x, y], 1)), atol=1e-6)


def test_a_start_in_the_middle_is_on_the_difficulty() -> None:
    lanes = Lanes(ground="slope_up", levels=(10.0, 20.0), course=10.0, start=5.0, width=12.0)
    origins = build_terrain(lanes).tile_origins[0]
    np.testing.assert_allclose(origins[:, 2], 5.0 * np.tan(np.radians([10.0, 20.0])), rtol=1e-4)
    assert lanes.goal == pytest.approx(5.5)


def test_the_highest_block_lies_in_the_way() -> None:
    lanes = Lanes(ground="obstacles", levels=(0.1, 0.25), course=6.0)
    terrain = build_terrain(lanes)
    for k, level in enumerate(lanes.levels):
        x = np.linspace(-2.0, lanes.goal + 1.0, 400)
        height = terrain.height_at(np.stack([x, np.full_like(x, terrain.tile_origins[0, k, 1])], 1))
        assert height.max() == pytest.approx(level, rel=1e-4)
        assert terrain.heights.max() == pytest.approx(0.25, rel=1e-4)
        assert (height[x < lanes.goal - lanes.course - 0.6] == 0.0).all()
