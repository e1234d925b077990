"""Gait and contact in an evaluation: the recorder against the environment, who counts, the delay margin, the tables."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from go1exp.evaluate import rollout, table
from go1exp.evaluate.recorder import Recorder
from go1exp.evaluate.rollout import EvalConfig, delay_margin, delayed, evaluate, evaluation_task
from go1exp.mdp.measures import every_measure
from go1exp.robot import GRAVITY
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig

MakeTask = Callable[..., TaskConfig]

QUIET = EvalConfig(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), episodes=3, duration_s=1.0, settle_s=0.4)


@pytest.fixture(scope="module")
def task(make_task: MakeTask) -> TaskConfig:
    return make_task("backend.threads=1")


def stand(observation: Tensor) -> Tensor:
    return torch.zeros(len(observation), 12)


def hop() -> Callable[[Tensor], Tensor]:
    """A policy that bends and stretches all legs, four times a second."""
    step = [0]

    def policy(observation: Tensor) -> Tensor:
        step[0] += 1
        bend = 2.0 * np.sin(2 * np.pi * 4.0 * 0.02 * step[0])
        return torch.tensor([0.0, bend, -2.0 * bend] * 4).float().expand(len(observation), 12)

    return policy


@pytest.mark.parametrize("ground", ["flat", "rough"])
def test_what_is_recorded_is_what_the_environment_sees(make_task: MakeTask, ground: str) -> None:
    tiles = ("terrain.rows=3", "terrain.cols=3", "terrain.border=2.0") if ground == "rough" else ()
    task = make_task("backend.threads=1", f"terrain={ground}", *tiles)
    config = dataclasses.replace(QUIET, randomize=True, train_ground=True)
    core = Go1Core(evaluation_task(task, config), 6, 1, noise=False)
    heard: list[Tensor] = []
    core.plant.observer = heard.append
    core.reset()
    policy, recorder, snapshots = hop(), Recorder(core, 40), []
    alive = torch.tensor([True] * 5 + [False])
    core.step(policy(torch.zeros(6, 48)))  # not recorded
    before = core.snapshot().foot_contact.clone()
    for _ in range(40):
        recorder.begin_step()
        core.step(policy(torch.zeros(6, 48)))
        recorder.end_step(alive)
        s = core.snapshot()
        measured = {f.name: getattr(s, f.name) for f in dataclasses.fields(s) if f.name != "height_scan"}
        snapshots.append({name: value.clone().numpy() for name, value in measured.items()})
    assert len(heard) == 41 * 10  # who listened before goes on to
    trace = recorder.trace(slice(0, 6))
    assert trace.counts.tolist() == [alive.tolist()] * 40
    seen = {name: np.stack([s[name] for s in snapshots]) for name in snapshots[0]}
    np.testing.assert_array_equal(trace.contact[9::10], seen["foot_contact"])
    for name in ("joint_vel", "joint_torque", "joint_target", "command", "base_lin_vel_b", "projected_gravity_b"):
        np.testing.assert_array_equal(getattr(trace, name), seen[name], err_msg=name)
    np.testing.assert_allclose(trace.need("foot_peak_force"), seen["foot_peak_force"], rtol=1e-5)
    assert (trace.need("foot_force") <= seen["foot_peak_force"] + 1e-3).all()
    assert (trace.need("foot_height") >= seen["foot_height"] - 1e-5).all()
    landed = np.diff(trace.contact.astype(int), axis=0, prepend=before.numpy()[None]).reshape(40, 10, 6, 4) == 1
    once = landed.sum(1) == 1
    np.testing.assert_array_equal(seen["foot_touchdown"], landed.any(1))
    np.testing.assert_allclose(trace.need("foot_touchdown_speed")[once], seen["foot_touchdown_speed"][once], rtol=1e-5)
    assert once.sum() > 30


def test_positive_power_is_the_work_of_the_drives(task: TaskConfig) -> None:
    """In the air, from rest: what the drives put in and take out is what the robot's energy changes by."""
    core = Go1Core(evaluation_task(task, QUIET), 1, 1, noise=False)
    core.reset()
    core.backend.qpos[:, 2] += 5.0
    recorder = Recorder(core, 3)
    work: list[float] = []
    observer = core.plant.observer
    assert observer is not None

    def listen(target: Tensor) -> None:
        if work or core.plant.torque.any():
            work.append((core.plant.torque * core.plant.qd).clamp(min=0.0).sum().item())
        observer(target)

    core.plant.observer = listen
    for _ in range(3):
        recorder.begin_step()
        core.step(torch.full((1, 12), 0.5))
        recorder.end_step(torch.ones(1, dtype=torch.bool))
    work.append((core.plant.torque * core.plant.qd).clamp(min=0.0).sum().item())
    power = recorder.trace(slice(0, 1)).need("positive_power")
    assert power.sum() * 10 == pytest.approx(sum(work), rel=1e-5)


def test_a_standing_robot_bears_its_weight_and_has_no_gait(task: TaskConfig) -> None:
    report = evaluate(task, stand, dataclasses.replace(QUIET, duration_s=2.0, settle_s=1.0), measures=every_measure())
    standing, sent = (row["measures"] for row in report["commands"])
    mass = 12.743
    assert sum(standing["foot_load"]["mean"]) == pytest.approx(mass * GRAVITY, rel=0.02)
    assert standing["slip_share_all"]["mean"] == 0.0
    assert standing["gait"] == {}
    assert standing["stride_rate"] == {"mean": None, "low": None, "high": None, "n": 0}
    assert sent["stride_rate"]["n"] == 0  # it was told to walk and stands
    assert sent["duty_factor"]["mean"] == [1.0] * 4
    assert report["units"]["stride_rate"] == "Hz"
    json.dumps(report, allow_nan=False)


def test_episodes_that_repeat_another_one_count_once(task: TaskConfig) -> None:
    same = evaluate(task, stand, QUIET, measures=every_measure()[:1])
    assert [row["distinct_falls"]["n"] for row in same["commands"]] == [1, 1]
    assert same["distinct_falls"]["n"] == 2
    varied = evaluate(task, stand, dataclasses.replace(QUIET, randomize=True))
    high = pytest.approx(0.3903, abs=1e-3)
    assert varied["distinct_falls"] == {"count": 0, "share": 0.0, "low": 0.0, "high": high, "n": 6}
    assert "measures" not in varied["commands"][0]


def test_a_policy_that_sees_an_estimated_velocity_is_measured_too(task: TaskConfig) -> None:
    config = dataclasses.replace(QUIET, trunk_velocity="estimated", duration_s=0.4, settle_s=0.2)
    report = evaluate(task, stand, config, measures=every_measure())
    assert report["commands"][0]["measures"]["trunk_height"]["n"] == 1


# ---------------------------------------------------------------------- delay margin


def test_the_delay_of_the_margin_is_that_of_the_effect_and_takes_the_place_of_another(make_task: MakeTask) -> None:
    task = delayed(make_task("effect=command_delay", "backend.threads=1"), 0.03)
    core = Go1Core(evaluation_task(task, QUIET), 2, 1, noise=False)
    core.reset()
    assert list(core.plant.effects.effects) == ["command_delay"]
    values = core.plant.effects.effects["command_delay"].state_dict()
    assert values["delay"].unique().tolist() == pytest.approx([0.03])


@pytest.mark.parametrize(
    ("first_falls", "falls_from", "margin", "run"), [(0, 30, 20, 4), (0, 99, 40, 5), (0, 10, 0, 2), (1, 10, None, 1)]
)
def test_the_margin_is_the_largest_delay_before_the_first_fall(
    task: TaskConfig, monkeypatch: pytest.MonkeyPatch, first_falls: int, falls_from: int, margin: int | None, run: int
) -> None:
    def fake(task: TaskConfig, policy: Any, config: EvalConfig, on_step: Any, controller: Any) -> dict[str, Any]:
        delay = 1000.0 * task.effect[-1].parameters["delay"]
        return {"distinct_falls": {"count": int(delay > falls_from - 1), "n": 5}}

    monkeypatch.setattr(rollout, "evaluate", fake)
    result = delay_margin(task, stand, QUIET, {"count": first_falls, "n": 5})
    assert result["ms"] == margin
    assert [int(ms) for ms in result["falls"]] == [0, 10, 20, 30, 40][:run]


# ---------------------------------------------------------------------- tables


def test_the_tables_fit_a_terminal_and_say_n_and_what_does_not_count(task: TaskConfig) -> None:
    report = evaluate(task, hop(), QUIET, measures=every_measure())
    report["policy"] = {"num_timesteps": 0}
    report["delay_margin"] = {"ms": 20, "falls": {"0": {"count": 0, "n": 2}, "30": {"count": 1, "n": 2}}}
    text = table.text(report)
    lines = text.split("\n")
    assert max(len(line) for line in lines if "RMSE over all" not in line) <= 120
    for part in ("phase FL RR RL", "load % FR FL RR RL", "CoT", "0 of 2 distinct robots"):
        assert part in text
    assert "largest command delay without a fall: 20 ms (falls: 0 ms 0 of 2, 30 ms 1 of 2)" in text
    assert "4 of 6 episodes are repeats" in text
    tables = table.measure_tables(report)
    assert [len(t) for t in tables] == [3, 3]
    assert [row[-1] for row in tables[0]] == ["n", "1", "1"]


def test_columns_and_tables_without_a_figure_are_left_out(task: TaskConfig) -> None:
    chosen = [t for t in every_measure() if t.key in ("trunk_height", "gait")]
    report = evaluate(task, stand, QUIET, measures=chosen)
    [gait] = table.measure_tables(report)
    assert gait[0] == ("command", "height m", "n")  # a robot that stands has no gait
    assert [row[1][:2] for row in gait[1:]] == ["0.", "0."]


def with_measures(units: dict[str, str], *of_commands: dict[str, Any]) -> dict[str, Any]:
    """What ``measure_tables`` reads of a report."""
    commands = [
        {"command": [float(k), 0.0, 0.0], "distinct_falls": {"n": k + 3}, "measures": measures}
        for k, measures in enumerate(of_commands)
    ]
    return {"commands": commands, "units": units}


def test_measures_of_a_users_own_have_a_table_of_their_own() -> None:
    units = {"widest_step": "rad", "style": "name", "ease": "-", "drag": "N", "flight_share": "-"}
    report = with_measures(
        units,
        {"widest_step": {"mean": 0.123456}, "style": {"proud": 2}, "ease": None, "drag": {"mean": [1.0, 2.0, None, 4]}},
        {"widest_step": {"mean": None}, "style": {}, "ease": {"mean": 2e-5}, "drag": {"mean": [None] * 4}},
    )
    assert table.measure_tables(report) == [
        [
            ("command", "widest_step rad", "style", "ease", "drag N FR FL RR RL", "n"),
            ("+0.0 +0.0 +0.0", "0.123", "proud", "-", "1 2 - 4", "3"),
            ("+1.0 +0.0 +0.0", "-", "-", "2e-05", "-", "4"),
        ]
    ]
    for command in report["commands"]:
        command["measures"] = {"flight_share": {"mean": 0.25}, **command["measures"]}
    fixed, further = table.measure_tables(report)
    assert fixed[1] == ("+0.0 +0.0 +0.0", "25", "3")
    assert further[0][1] == "widest_step rad"


def test_further_measures_that_are_too_wide_for_a_line_have_a_second_table() -> None:
    names = [f"{'long' * 10}_{k}" for k in range(5)]
    tables = table.measure_tables(with_measures({}, {name: {"mean": 1.0} for name in names}))
    assert [header[1:-1] for header, _ in tables] == [(names[0], names[1]), (names[2], names[3]), (names[4],)]


def test_each_measure_of_the_package_is_in_a_column_or_for_the_json_alone_unless_it_was_chosen() -> None:
    keys = {term.key for term in every_measure()}
    assert keys == table.FIXED | table.JSON_ONLY
    assert not table.FIXED & table.JSON_ONLY
    every = with_measures({}, {key: {} if key == "gait" else {"mean": 1.0} for key in keys})
    assert len(table.measure_tables(every)) == 2
    chosen = with_measures({}, {"slip_distance": {"mean": 1.0}})
    assert table.measure_tables(chosen)[0][0] == ("command", "slip_distance", "n")
