"""Evaluation on a grid of commands: statistics by hand, gait and contact, delay margin, tables, loaded policies."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate import rollout, table
from go1exp.evaluate.agents import columns
from go1exp.evaluate.recorder import Recorder
from go1exp.evaluate.rollout import EvalConfig, delay_margin, delayed, evaluate, evaluation_task, grid
from go1exp.mdp.measures import every_measure
from go1exp.mdp.types import Snapshot
from go1exp.robot import GRAVITY
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.terms import StepTerms
from go1exp.sim.task import TaskConfig, TrainConfig, parse_train
from go1exp.train import checkpoint
from go1exp.train.policy import Policy, load_policy
from tests.small_run import small, train

MakeTask = Callable[..., TaskConfig]


def settings(*commands: tuple[float, float, float], **changes: Any) -> EvalConfig:
    plain = EvalConfig(commands or ((0.5, 0.0, 0.0),), episodes=2, seconds=1.0, settle_s=0.2)
    return dataclasses.replace(plain, **changes)


def stand(observation: Tensor) -> Tensor:
    return torch.zeros(len(observation), 12)


def topple(rows: Sequence[int], after: int = 0) -> Policy:
    """A policy that throws the robots of ``rows`` over from its step ``after`` on, and lets the others stand."""
    step = [0]

    def policy(observation: Tensor) -> Tensor:
        action = torch.zeros(len(observation), 12)
        if step[0] >= after:
            action[list(rows)] = torch.tensor([5.0, 0.0, -6.0] * 2 + [-5.0, 0.0, 6.0] * 2)
        step[0] += 1
        return action

    return policy


@pytest.fixture
def task(make_task: MakeTask) -> TaskConfig:
    return make_task("backend.threads=1")


def test_an_estimated_velocity_stands_in_the_place_of_the_true_one(task: TaskConfig) -> None:
    """A robot that sways: but for the velocity it sees what it would see anyway, and the estimate follows the truth."""
    by_source: dict[str, list[Tensor]] = {"exact": [], "estimated": []}
    for how, kept in by_source.items():

        def sway(observation: Tensor, kept: list[Tensor] = kept) -> Tensor:
            kept.append(observation.clone())
            swing = 1.5 * math.sin(2 * math.pi * 1.5 * 0.02 * len(kept))
            return torch.tensor([0.0, swing, -swing] * 4).repeat(len(observation), 1)

        evaluate(task, sway, settings(trunk_velocity=how, seconds=2.0))
    exact, estimated = (torch.stack(kept) for kept in by_source.values())
    assert torch.equal(exact[:, :, 3:], estimated[:, :, 3:])
    assert not torch.equal(exact[:, :, :3], estimated[:, :, :3])
    assert exact[25:, :, :3].abs().max() > 0.1
    assert (exact - estimated)[25:, :, :3].square().mean().sqrt() < 0.05


def test_a_policy_that_does_not_see_the_velocity_cannot_be_given_an_estimate(make_task: MakeTask) -> None:
    task = make_task("backend.threads=1", "~observation.base_linear_velocity")
    with pytest.raises(ConfigError, match="the policy does not see base_linear_velocity"):
        evaluate(task, stand, settings(trunk_velocity="estimated"))


# ---------------------------------------------------------------------- statistics


def by_hand(task: TaskConfig, policy: Policy, config: EvalConfig) -> list[dict[str, Any]]:
    """The report's rows from the physics state: lists, numpy, scipy's rotations, one robot at a time."""
    robots = len(config.commands) * config.episodes
    core = Go1Core(evaluation_task(task, config), robots, config.seed, noise=config.noise)
    each = [command for command in config.commands for _ in range(config.episodes)]
    core.command.value[:] = torch.tensor(each)
    observation = core.reset()
    running, times = [True] * robots, [0] * robots
    fell = [False] * robots
    velocities: list[list[np.ndarray]] = [[] for _ in range(robots)]
    dt = core.task.sim.policy_dt
    for step in range(round(config.seconds / dt)):
        result = core.step(policy(observation))
        observation = result.observation
        for i in range(robots):
            if running[i] and (result.terminated[i] or result.truncated[i]):
                running[i], fell[i] = False, bool(result.terminated[i])
            if running[i]:
                times[i] += 1
                qpos, qvel = core.backend.qpos[i].numpy(), core.backend.qvel[i].numpy()
                to_body = Rotation.from_quat(qpos[3:7], scalar_first=True).inv()
                if step * dt >= config.settle_s - 1e-9:
                    velocities[i].append(np.array([*to_body.apply(qvel[:3])[:2], qvel[5]]))
    rows = []
    for k, command in enumerate(config.commands):
        group = range(k * config.episodes, (k + 1) * config.episodes)
        samples = np.array([v for i in group for v in velocities[i]])
        rows.append(
            {
                "command": list(command),
                "mean": samples.mean(0) if len(samples) else None,
                "rmse": np.sqrt(((samples - command) ** 2).mean(0)) if len(samples) else None,
                "falls": sum(fell[i] for i in group),
                "mean_time_s": float(np.mean([times[i] * dt for i in group])),
                "samples": samples,
            }
        )
    return rows


@pytest.mark.parametrize("after", [0, 25], ids=["falls while settling", "falls later"])
def test_the_statistics_are_those_of_a_count_by_hand(after: int, task: TaskConfig) -> None:
    """Three commands; of the second one robot falls, of the third both."""
    config = settings((0.5, 0.0, 0.0), (0.0, -0.3, 1.0), (1.0, 0.0, 0.0), seconds=1.2, settle_s=0.3)
    falling = [2, 4, 5]
    report = evaluate(task, topple(falling, after), config)
    expected = by_hand(task, topple(falling, after), config)
    assert [row["falls"] for row in expected] == [0, 1, 2]  # else the policy does not do what the test needs
    for row, other in zip(report["commands"], expected, strict=True):
        assert row["command"] == other["command"]
        assert row["falls"] == other["falls"]
        assert row["episodes"] == 2
        assert row["mean_time_s"] == pytest.approx(other["mean_time_s"], abs=1e-4)
        for figure in ("mean", "rmse"):
            if other[figure] is None:
                assert row[figure] is None
            else:
                np.testing.assert_allclose([row[figure][a] for a in ("x", "y", "yaw")], other[figure], atol=2e-5)
    errors = [row["samples"] - row["command"] for row in expected if len(row["samples"])]
    overall = np.sqrt((np.concatenate(errors) ** 2).mean(0))
    np.testing.assert_allclose(list(report["rmse"].values()), overall, atol=2e-5)
    assert (report["falls"], report["episodes"]) == (3, 6)


def test_leaving_the_map_ends_the_counting_and_is_no_fall(task: TaskConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [0]

    def cut_short(terms: StepTerms, left_map: Tensor, s: Snapshot) -> Tensor:
        steps[0] += 1
        return torch.tensor([steps[0] == 10, False])

    def fallen(terms: StepTerms, s: Snapshot) -> Tensor:  # long after it has left the map
        return torch.tensor([steps[0] == 20, False])

    monkeypatch.setattr(StepTerms, "cut_short", cut_short)
    monkeypatch.setattr(StepTerms, "terminated", fallen)
    (row,) = evaluate(task, stand, settings(seconds=1.0))["commands"]
    assert row["falls"] == 0
    assert row["mean_time_s"] == pytest.approx((9 * 0.02 + 1.0) / 2, abs=1e-4)


def test_each_robot_gets_the_command_of_its_row_and_its_policy_sees_it(task: TaskConfig) -> None:
    commands = ((1.5, 0.0, 0.0), (0.0, -0.25, 0.75))
    inputs: list[Tensor] = []

    def policy(observation: Tensor) -> Tensor:
        inputs.append(observation.clone())
        return stand(observation)

    evaluate(task, policy, settings(*commands, seconds=0.1, settle_s=0.0))
    start = 0
    for term in task.observation:
        if "command" in term.key:
            break
        start += term.entry.traits["size"]
    for observation in inputs:
        for row, command in zip(observation, [commands[0]] * 2 + [commands[1]] * 2, strict=True):
            np.testing.assert_allclose(row[start : start + 3], command, rtol=1e-6)


def test_progress_is_told_in_steps(task: TaskConfig) -> None:
    progress: list[tuple[int, int]] = []
    evaluate(task, stand, settings(seconds=0.2, settle_s=0.0), lambda done, total: progress.append((done, total)))
    assert progress == [(k, 10) for k in range(1, 11)]
    progress.clear()
    faster = settings(seconds=0.2, settle_s=0.0, policy_dt=0.01)
    evaluate(task, stand, faster, lambda done, total: progress.append((done, total)))
    assert progress[-1] == (20, 20)


def test_at_another_rate_the_previous_action_is_the_mean_over_a_training_period(task: TaskConfig) -> None:
    where = columns(task, "previous_action")
    for policy_dt, cycles in ((None, 1), (0.01, 2), (0.004, 5)):
        inputs: list[float] = []

        def policy(observation: torch.Tensor) -> torch.Tensor:
            inputs.append(float(observation[0, where].mean()))  # noqa: B023
            return torch.full((len(observation), 12), 0.01 * len(inputs))  # noqa: B023

        evaluate(task, policy, settings(seconds=0.2, settle_s=0.0, policy_dt=policy_dt))
        given = [0.0] * cycles + [0.01 * (k + 1) for k in range(len(inputs))]
        assert inputs == pytest.approx([sum(given[k : k + cycles]) / cycles for k in range(len(inputs))], abs=1e-6)


@pytest.mark.parametrize(("policy_dt", "cycles"), [(None, 1), (0.01, 2), (0.004, 5)])
def test_targets_of_a_training_period_differ_by_no_more_than_the_bound_at_any_rate(
    task: TaskConfig, policy_dt: float | None, cycles: int
) -> None:
    where, observed = columns(task, "previous_action"), list[float]()
    task = dataclasses.replace(task, action=dataclasses.replace(task.action, max_step=0.1 * task.action.scale))
    wanted = (0.3 * np.random.default_rng(0).normal(size=60)).tolist()

    def policy(observation: torch.Tensor) -> torch.Tensor:
        observed.append(float(observation[0, where].mean()))
        return torch.full((len(observation), 12), wanted[len(observed) - 1])

    evaluate(task, policy, settings(seconds=0.2, settle_s=0.0, policy_dt=policy_dt))
    actions, means = [0.0] * cycles, [0.0]
    for want in wanted[: len(observed)]:
        actions.append(float(np.clip(want, max(actions[-cycles:]) - 0.1, min(actions[-cycles:]) + 0.1)))
        assert np.ptp(actions[-cycles - 1 :]) < 0.1 + 1e-9
        means.append(sum(actions[-cycles:]) / cycles)
    assert observed == pytest.approx(means[: len(observed)], abs=1e-6)


def test_the_same_seed_gives_the_same_report_which_says_under_what_it_was_made(task: TaskConfig) -> None:
    config = settings(randomize=True, push=True, noise=True, seconds=0.4, settle_s=0.0, seed=7)
    policy: Policy = lambda observation: 0.3 * observation[:, :12]  # noqa: E731
    one = evaluate(task, policy, config)
    assert evaluate(task, policy, config) == one
    assert evaluate(task, policy, dataclasses.replace(config, seed=2)) != one
    assert one["settings"] == {k: v for k, v in dataclasses.asdict(config).items() if k != "commands"}


# ---------------------------------------------------------------------- what is judged


def test_nothing_of_the_training_but_the_robot_stays_unless_asked_for(make_task: MakeTask) -> None:
    task = make_task("backend.threads=1", "terrain=rough", "curriculum=terrain_level", "sim.episode_s=5")
    plain = evaluation_task(task, settings())
    assert (plain.rand, plain.event, plain.curriculum) == ((), (), ())
    assert plain.terrain.kind == "flat"
    assert plain.command.entry.name == "fixed_velocity"
    assert not plain.sim.spread_starts
    assert plain.sim.policy_dt == task.sim.policy_dt
    for kept in ("robot", "actuator", "action", "observation", "termination", "reward", "backend"):
        assert getattr(plain, kept) == getattr(task, kept)
    assert evaluation_task(task, settings(randomize=True)).rand == task.rand != ()
    assert evaluation_task(task, settings(push=True)).event == task.event != ()
    assert evaluation_task(task, settings(train_ground=True)).terrain == task.terrain
    full = evaluation_task(task, settings(randomize=True, push=True, train_ground=True))
    assert full.curriculum == ()  # levels are drawn, not earned
    assert evaluation_task(task, settings(policy_dt=0.01)).sim.decimation == 5


def test_no_time_limit_falls_into_the_evaluation(make_task: MakeTask) -> None:
    task = make_task("backend.threads=1", "sim.episode_s=0.2")
    report = evaluate(task, stand, settings(seconds=0.6))
    assert report["commands"][0]["mean_time_s"] == pytest.approx(0.6, abs=1e-4)


def test_an_episode_that_does_not_fit_into_memory_is_refused_by_its_key(task: TaskConfig) -> None:
    """Without measures nothing is kept, and the first step is made."""
    long = settings(seconds=1e9)
    with pytest.raises(ConfigError, match=r"seconds = 1e\+09: .* at least .* GB are free .* s at most would fit"):
        evaluate(task, stand, long, measures=every_measure())

    def interrupted(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(task, stand, long, interrupted)


# ---------------------------------------------------------------------- grid


CROSSED = ((1.0, 0.0, -1.0), (1.0, 0.0, 0.5), (2.0, 0.0, -1.0), (2.0, 0.0, 0.5))
SINGLE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.25))


def test_a_grid_is_every_combination_or_standing_and_one_axis_at_a_time_each_once() -> None:
    assert grid([1.0, 2.0], [0.0], [-1.0, 0.5], cross=True) == CROSSED
    assert grid([1.0, 0.0, 1.0], [-0.5], [0.25], cross=False) == SINGLE
    assert grid([], [], [], cross=False) == ((0.0, 0.0, 0.0),)


# ---------------------------------------------------------------------- tables

REPORT: dict[str, Any] = {
    "policy": {"iteration": 5, "num_timesteps": 2_500_000, "file": "x"},
    "commands": [
        {
            "command": [0.5, 0.0, -1.0],
            "mean": {"x": 0.456, "y": -0.001, "yaw": -0.9},
            "rmse": {"x": 0.05, "y": 0.123, "yaw": 1.0},
            "falls": 1,
            "episodes": 16,
            "mean_time_s": 19.96,
        },
        {"command": [2, 0, 0], "mean": None, "rmse": None, "falls": 16, "episodes": 16, "mean_time_s": 0.5},
    ],
    "rmse": {"x": 0.05, "y": 0.1234, "yaw": 1.0},
    "falls": 17,
    "episodes": 32,
    "settings": {"noise": True, "randomize": False, "push": True, "train_ground": False, "seconds": 20.0},
}
CELLS = [
    ("+0.50, +0.00, -1.00", "+0.46, -0.00, -0.90", "0.05, 0.12, 1.00", "1/16", "20.0"),
    ("+2.00, +0.00, +0.00", "-", "-", "16/16", "0.5"),
]


def test_the_table_for_a_terminal_stands_in_columns() -> None:
    header, *lines = table.text(REPORT).split("\n")[:3]
    assert len({len(header), *map(len, lines)}) == 1
    for line, cells in zip([header, *lines], [table.HEADER, *CELLS], strict=True):
        ends = [line.index(cell) + len(cell) for cell in cells if cell != "-"]
        assert ends == sorted(ends)
        assert [c.strip() for c in line.split("  ") if c.strip()] == list(cells)
    whole = lines[0]
    for name, cell in zip(table.HEADER, CELLS[0], strict=True):  # right-aligned under its heading
        assert header.rindex(name) + len(name) == whole.index(cell) + len(cell)


def test_a_table_ends_with_what_it_is_of() -> None:
    last = table.text(REPORT).split("\n")[-1]
    for part in ("2.50 M steps", "x 0.050, y 0.123, yaw 1.000", "falls 17 in 32 episodes of 20 s", "noise, push"):
        assert part in last
    quiet = {**REPORT, "rmse": None, "settings": {**REPORT["settings"], "noise": False, "push": False}}
    assert "no noise, randomisation or pushes, on flat ground" in table.text(quiet)
    assert "physics of 4 ms softens impacts" in table.text({**REPORT, "physics_dt": 0.004})
    assert "softens" not in table.text({**REPORT, "physics_dt": 0.002})


# ---------------------------------------------------------------------- policies from run folders


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainConfig]:
    run, overrides = tmp_path_factory.mktemp("evaluate") / "run", small("ppo=cpu", "checkpoint.every=1", epochs=2)
    train(run, overrides)
    return run, parse_train(compose("train", overrides))


def by_hand_network(path: Path, observation: np.ndarray) -> np.ndarray:
    """The actor of a checkpoint in numpy, float64: two layers with ELU, one without."""
    weights = {k: v.double().numpy() for k, v in checkpoint.read(path)["policy"].items()}
    for layer in ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2"):
        observation = observation @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"]
        observation = np.where(observation > 0, observation, np.expm1(observation))
    return observation @ weights["action_net.weight"].T + weights["action_net.bias"]


@pytest.mark.parametrize("which", [None, 1])
def test_a_loaded_policy_is_the_mean_of_the_trained_one(which: int | None, trained: tuple[Path, TrainConfig]) -> None:
    run, config = trained
    path = run / f"checkpoints/{which or 2:06d}.pt"
    policy, about = load_policy(run, config, path if which else None)
    size = checkpoint.read(path)["policy"]["mlp_extractor.policy_net.0.weight"].shape[1]
    observation = np.random.default_rng(0).normal(size=(5, size))
    got = policy(torch.as_tensor(observation, dtype=torch.float32))
    np.testing.assert_allclose(got.numpy(), by_hand_network(path, observation), atol=1e-5)
    assert not got.requires_grad
    assert about == {"iteration": which or 2, "num_timesteps": 16 * (which or 2), "file": str(path)}


def test_a_folder_without_checkpoints_is_named(trained: tuple[Path, TrainConfig], tmp_path: Path) -> None:
    _, config = trained
    with pytest.raises(FileNotFoundError, match=str(tmp_path)):
        load_policy(tmp_path, config)


QUIET = EvalConfig(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), episodes=3, seconds=1.0, settle_s=0.4)


@pytest.mark.parametrize(("episodes", "expected"), [(2, [0, 3]), (5, [0, 1, 2, 3, 4]), (7, [0, 1, 2, 3, 4, 5, 0])])
def test_commands_are_compared_on_the_same_kinds_of_ground(
    make_task: MakeTask, monkeypatch: pytest.MonkeyPatch, episodes: int, expected: list[int]
) -> None:
    tiles = ("terrain.rows=2", "terrain.cols=6", "terrain.tile_size=4.0", "terrain.border=2.0")
    task = make_task("backend.threads=1", "terrain=rough", *tiles)
    seen: list[list[int]] = []

    def drawn(core: Go1Core) -> dict[str, Any]:
        seen.append(core.tile_column.tolist())
        assert np.allclose(core.spawn[:, 1], core.terrain.tile_origins[0, core.tile_column, 1])
        return {}

    monkeypatch.setattr(rollout, "drawn", drawn)
    config = dataclasses.replace(QUIET, episodes=episodes, train_ground=True, seconds=0.1, settle_s=0.0)
    evaluate(task, lambda observation: torch.zeros(len(observation), 12), config)
    assert seen == [expected * 2]


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
        measured = {f.name: getattr(s, f.name) for f in dataclasses.fields(s)}
        snapshots.append({name: v.clone().numpy() for name, v in measured.items() if v is not None})
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
    report = evaluate(task, stand, dataclasses.replace(QUIET, seconds=2.0, settle_s=1.0), measures=every_measure())
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
    config = dataclasses.replace(QUIET, trunk_velocity="estimated", seconds=0.4, settle_s=0.2)
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
