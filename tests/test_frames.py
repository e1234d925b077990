"""Noise and history of observations: in the environment, in a bundle, and at another rate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from go1exp.config.schema.history import columns_of, history_columns
from go1exp.deploy.export.build import metadata, readings
from go1exp.deploy.export.graph import DeployedPolicy
from go1exp.deploy.runtime.metadata import Block, Metadata, Port, Trained
from go1exp.deploy.runtime.policy import PolicyMemory
from go1exp.evaluate.agents import PolicyAgent
from go1exp.mdp.types import TermSetup
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.terms import Frames
from go1exp.sim.task import TaskConfig
from go1exp.train.ppo import GaussianPolicy

MakeTask = Callable[..., TaskConfig]
STEPS = 12


def three_frames(make_task: MakeTask, *more: str) -> TaskConfig:
    return make_task(
        "backend.threads=1",
        "sim.episode_s=0.16",  # eight steps
        "+observation.joint_position.history=3",
        "+observation.velocity_command.history=2",
        *more,
    )


def test_a_term_with_a_history_shows_what_it_showed_before(make_task: MakeTask) -> None:
    task = three_frames(make_task)
    core = Go1Core(task, 3, seed=1, noise=True)
    command, joints = slice(9, 15), slice(15, 51)
    assert core.observation_size == 48 + 3 + 24
    seen = [core.reset().clone()]
    assert torch.equal(seen[0][:, 15:27], seen[0][:, 27:39])
    ends, rng = [], np.random.default_rng(0)
    for _ in range(STEPS):
        result = core.step(torch.tensor(rng.normal(size=(3, 12)), dtype=torch.float32))
        before, now, last = seen[-1], result.observation, result.final_observation
        over = result.terminated | result.truncated
        ends.append(over)
        for part, wide in ((command, 3), (joints, 12)):
            assert torch.equal(last[:, part][:, wide:], before[:, part][:, :-wide])
            assert torch.equal(now[~over][:, part][:, wide:], before[~over][:, part][:, :-wide])
            frames = now[over][:, part].unflatten(1, (-1, wide))
            assert (frames == frames[:, :1]).all()  # an episode begins with its first frame alone
        assert not torch.equal(now[:, 15:27], before[:, 15:27])
        seen.append(now.clone())
    assert torch.stack(ends).any(0).all()


def test_a_robot_of_a_batch_sees_what_it_would_see_alone_and_goes_on_as_it_was(make_task: MakeTask) -> None:
    task = three_frames(make_task, "+observation.base_linear_velocity.correlation_time=0.1")
    many, alone = Go1Core(task, 3, seed=1), Go1Core(task, 1, seed=1, first_env=2)
    action = torch.zeros(3, 12)
    assert torch.equal(many.reset()[2:], alone.reset())
    for _ in range(STEPS):
        assert torch.equal(many.step(action).observation[2:], alone.step(action[:1]).observation)
    again = Go1Core(task, 3, seed=9)
    again.reset()
    again.load_state_dict(many.state_dict())
    for _ in range(3):
        assert torch.equal(many.step(action).observation, again.step(action).observation)


@pytest.mark.parametrize("time", [0.0, 0.05, 0.3])
def test_correlated_noise_forgets_in_its_time_and_is_as_wide(make_task: MakeTask, time: float) -> None:
    task = make_task(f"+observation.base_linear_velocity.correlation_time={time}")
    frames = Frames(task.observation, TermSetup(400, torch.device("cpu"), 0.02))
    generator, steps = torch.Generator().manual_seed(0), 150
    clean, everyone = torch.zeros(400, frames.size), torch.ones(400, dtype=torch.bool)

    def unit() -> torch.Tensor:
        return 2.0 * torch.rand(clean.shape, generator=generator) - 1.0

    seen = [frames.begun(clean, unit(), everyone)]
    for _ in range(steps):
        ended = frames.ended(clean, unit())
        seen.append(frames.begun(clean, unit(), ~everyone))
        if time:
            assert torch.equal(seen[-1][:, :3], ended[:, :3])  # one instant has one error
    error = torch.stack(seen)[:, :, :3]
    assert error.std().item() == pytest.approx(0.02 / np.sqrt(3.0), rel=0.03)
    lag = 5
    correlation = (error[:-lag] * error[lag:]).mean() / error.square().mean()
    assert correlation.item() == pytest.approx(np.exp(-lag * 0.02 / time) if time else 0.0, abs=0.03)
    assert torch.stack(seen)[:, :, 3:6].std().item() == pytest.approx(0.01 / np.sqrt(3.0), rel=0.03)


def test_columns_of_a_history() -> None:
    columns = columns_of([(2, 1), (2, 3), (1, 2)])
    assert columns.earlier == [4, 5, 6, 7, 9]
    assert columns.newest == [2, 3, 2, 3, 8]
    assert columns.carried == [2, 3, 4, 5, 8]


def about(period: float) -> Metadata:
    """A policy of one joint that sees its angle three times; its action is the angle."""
    ports = [Port(n, s, "", "", "") for n, s in (("joint_pos", 1), ("previous_action", 1), ("past", 2))]
    outputs = [Port(n, s, "", "", "") for n, s in (("joint_target", 1), ("observation", 4), ("action", 1))]
    terms = (Block("q", "joint_position", 0, 3, 0.0, 3), Block("a", "previous_action", 3, 1, 0.0))
    words: dict[str, Any] = {"robot": "r", "joints": ("j",), "legs": (), "conventions": {}, "estimator": {}}
    numbers = {"nominal_stance": (0.0,), "action_scale": 1.0, "action_clip": 1.0, "kp": None, "kd": None}
    limits = {"joint_limits": ((0.0, 1.0),), "torque_limit": (1.0,), "velocity_limit": (1.0,), "command_ranges": {}}
    given = {**words, **numbers, **limits, "trained": None, "policy_dt": period, "physics_dt": period}
    return Metadata(inputs=tuple(ports), outputs=tuple(outputs), observation=terms, **given)


@pytest.mark.parametrize("cycles", [1, 4])
def test_what_a_policy_remembers_is_a_training_period_old(cycles: int) -> None:
    """Four cycles in a training period: it sees the angles of now, 4 and 8 cycles ago, its mean action of 4."""
    memory = PolicyMemory(about(0.02), 0.02 / cycles)

    def policy(given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        observation = np.concatenate([given["joint_pos"], given["past"], given["previous_action"]], axis=1)
        return {"observation": observation, "action": given["joint_pos"], "joint_target": given["joint_pos"]}

    angle = np.arange(1.0, 20.0, dtype=np.float32)
    for k, q in enumerate(angle):
        seen = memory(policy, {"joint_pos": np.array([[q]], np.float32)})["observation"][0]  # type: ignore[arg-type]
        ago = [angle[max(k - n * cycles, 0)] for n in (0, 1, 2)]
        assert seen.tolist() == [*ago, sum(angle[max(k - cycles, 0) : k]) / cycles]


def test_a_bundle_of_another_version_has_no_history() -> None:
    block = {"key": "q", "term": "joint_position", "start": 0, "size": 12, "noise": 0.05}
    assert Block(**block).history == 1  # type: ignore[arg-type]


def test_the_columns_of_the_paper_have_no_history(make_task: MakeTask) -> None:
    assert history_columns(make_task().observation) == ([], [], [])


@pytest.mark.parametrize("removed", [(), ("~observation.previous_action",)])
@pytest.mark.parametrize("rate", [50.0, 100.0])
def test_a_policy_that_runs_faster_than_it_was_trained_sees_frames_of_its_training_period(
    make_task: MakeTask, rate: float, removed: tuple[str, ...]
) -> None:
    task = three_frames(make_task, *removed, "sim.episode_s=10.0", "sim.physics_dt=0.002", "termination={}")
    seen: list[torch.Tensor] = []

    def policy(observation: torch.Tensor) -> torch.Tensor:
        seen.append(observation.clone())
        return 0.3 * torch.sin(len(seen) + torch.arange(24.0)).unflatten(0, (2, 12))

    faster = dataclasses.replace(task, sim=dataclasses.replace(task.sim, policy_dt=1.0 / rate))
    core = Go1Core(faster, 2, noise=False)
    running = PolicyAgent("policy", task, policy).begin(core, "exact", 0)
    observation = core.reset()
    for _ in range(7):
        observation = core.step(running(observation)).observation
    joints, cycles = slice(15, 51), round(rate / 50.0)
    for k, now in enumerate(seen):
        frames = now[:, joints].unflatten(1, (3, 12))
        for n in (1, 2):
            assert torch.equal(frames[:, n], seen[max(k - n * cycles, 0)][:, joints][:, :12])


def test_on_the_robot_a_policy_sees_the_frames_that_the_environment_showed_it(make_task: MakeTask) -> None:
    task = three_frames(make_task, "sim.episode_s=10.0", "+observation.previous_action.history=4")
    core = Go1Core(task, 1, noise=False)
    observation = core.reset()
    policy = GaussianPolicy(Box(-9.0, 9.0, (core.observation_size,)), Box(-1.0, 1.0, (12,)), lambda _: 0.0)
    module = DeployedPolicy(policy, task.observation, task.action)
    about = metadata(task, module.inputs, Trained("made.pt", "", 0, 0))
    memory = PolicyMemory(about, task.sim.policy_dt)

    def run(given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        outputs = module(*(torch.as_tensor(given[port.name]) for port in module.inputs))
        return {port.name: values.detach().numpy() for port, values in zip(module.outputs, outputs, strict=True)}

    for _ in range(6):
        given = {name: values.numpy() for name, values in readings(core).items() if name != "previous_action"}
        outputs = memory(run, given)
        np.testing.assert_allclose(outputs["observation"], observation, rtol=0, atol=1e-6)
        observation = core.step(torch.as_tensor(outputs["action"])).observation
