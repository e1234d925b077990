"""Mirrored samples: what a mirrored robot sees and does, and an update on minibatches joined with their images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.config.schema import plugins
from go1exp.config.schema.registry import ConfigError, Entry, foreign, members
from go1exp.extend.testing import check_term
from go1exp.mdp import mirror
from go1exp.mdp.mirror import Mirror
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TrainConfig, parse_train
from go1exp.train import preflight
from go1exp.train.loss import mirror_of, ppo_loss
from go1exp.train.ppo import AdaptivePPO, GaussianPolicy
from tests.test_capture import Watch

TERMS = {name: entry for name, entry in members("observation").items() if entry not in foreign()}

SMALL = (
    *(
        "ppo=paper",
        "ppo.num_envs=8",
        "ppo.steps=6",
        "ppo.hidden=[16,8]",
        "ppo.init_std=0.5",
        "ppo.matmul_precision=highest",
    ),
    *("sim.episode_s=0.2", "backend.threads=1", "torch_threads=1", "logger=local"),
)

WORLD = (
    *("rand=none", "event=none", "actuator=pd", "contact=soft", "backend.threads=1"),
    *(f"++observation.{name}.noise=0.0" for name in TERMS),
)
"""Nothing is random, and every registered observation is seen."""


def settings(*overrides: str) -> TrainConfig:
    return parse_train(compose("train", [*SMALL, *overrides]))


# ---------------------------------------------------------------------- mirrors


@pytest.mark.parametrize("name", TERMS)
def test_a_mirror_with_a_wrong_sign_or_column_is_caught(name: str) -> None:
    right: Mirror = TERMS[name].traits["mirror"]
    wrong = []
    for k, partner in list(enumerate(right.columns))[:12]:
        signs = list(right.signs)
        for column in {k, partner}:
            signs[column] = -signs[column]
        wrong.append(Mirror(right.columns, tuple(signs)))
    straight = tuple(range(len(right.signs)))
    wrong += [Mirror(straight, right.signs)] if right.columns != straight else []
    for image in wrong:
        entry = Entry("observation", name, TERMS[name].target, {**TERMS[name].traits, "mirror": image})
        with pytest.raises(AssertionError, match="what a mirrored robot observes must be the image that mirror makes"):
            check_term(entry)


def test_actions_stand_about_a_stance_that_is_symmetric() -> None:
    """So that the mirror of the targets is that of the actions, of which they are a multiple."""
    stance = torch.as_tensor(robot.NOMINAL_STANCE)
    assert torch.equal(mirror.ACTION(stance), stance)


def test_blocks_of_columns_are_mirrored_each_by_itself() -> None:
    image = mirror.side_by_side([mirror.POLAR, mirror.LEGS, mirror.unchanged(1)])
    values = torch.arange(8.0) + 1
    assert image(values).tolist() == [1, -2, 3, 5, 4, 7, 6, 8]
    assert mirror.POLAR.repeated(2)(torch.ones(1, 6)).tolist() == [[1, -1, 1, 1, -1, 1]]
    assert mirror.grid(2, 3)(torch.arange(6.0)).tolist() == [2, 1, 0, 5, 4, 3]


@pytest.mark.parametrize(
    ("columns", "signs"),
    [
        ((0, 0), (1.0, 1.0)),
        ((0, 1), (1.0, 0.5)),
        ((0, 1), (1.0,)),
        ((1, 2, 0), (1.0, 1.0, 1.0)),  # a turn, and no mirror
        ((1, 0), (1.0, -1.0)),
    ],
)
def test_what_is_no_mirror_cannot_be_made(columns: tuple[int, ...], signs: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="must be"):
        Mirror(columns, signs)


# ---------------------------------------------------------------------- the robot and its image move alike


def symmetric_bodies(core: Go1Core) -> None:
    """Give each body the mean of its own centre of mass and inertia and of its partner's image."""
    model, fields = core.backend.model, [core.backend.field(f"body_{f}") for f in ("ipos", "inertia", "iquat")]
    plane, opposite = np.diag([1.0, -1.0, 1.0]), {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}

    def inertia(body: int) -> np.ndarray:
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, model.body_iquat[body])
        axes = turned.reshape(3, 3)
        return np.asarray(axes @ np.diag(model.body_inertia[body]) @ axes.T)

    for body in range(1, model.nbody):
        name = model.body(body).name
        partner = model.body(opposite.get(name[:2], name[:2]) + name[2:]).id
        values, axes = np.linalg.eigh((inertia(body) + plane @ inertia(partner) @ plane) / 2)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, axes.flatten())
        centre = (model.body_ipos[body] + plane @ model.body_ipos[partner]) / 2
        for field, value in zip(fields, (centre, values, quat), strict=True):
            field[:, body] = torch.as_tensor(value)
    core.backend.derive_constants(torch.ones(2, dtype=torch.bool))


def seen_by_a_robot_and_its_image(symmetric: bool, steps: int) -> tuple[Tensor, Tensor, dict[str, slice]]:
    """Step a robot and its mirror image over flat ground, from a random state, with random actions and their images.

    Returns:
        The image of what the robot observes and what its image observes, (steps, O), and each term's columns.
    """
    task = parse_train(compose("train", WORLD)).task
    core = Go1Core(task, 2, noise=False)
    if symmetric:
        symmetric_bodies(core)
    core.reset()
    random = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    polar = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    qpos, qvel = core.backend.qpos.clone(), 0.5 * draw(2, 18)
    turn = torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.05 * draw(4)
    qpos[:, :3], qpos[0, 3:7] = torch.tensor([0.0, 0.0, robot.NOMINAL_HEIGHT]), turn / turn.norm()
    qpos[0, 7:] += 0.1 * draw(12)
    qpos[1, 3:7] = qpos[0, 3:7] * torch.tensor([1.0, -1.0, 1.0, -1.0])
    qpos[1, 7:] = mirror.JOINTS(qpos[0, 7:])
    qvel[1] = torch.cat([qvel[0, :3] * polar, -qvel[0, 3:6] * polar, mirror.JOINTS(qvel[0, 6:])])
    core.backend.reset(torch.ones(2, dtype=torch.bool), qpos, qvel)
    core.steps[1] += round(0.2 / task.sim.policy_dt)  # half a turn of the clock, which makes 2.5 a second
    command = torch.tensor([[0.5, 0.3, -0.2], [0.5, -0.3, 0.2]])
    observed = []
    for _ in range(steps):
        action = draw(12).float()
        core.step(torch.stack([action, mirror.ACTION(action)]))
        core.command.value.copy_(command)
        observed.append(core.terms.observation(core.snapshot(), core.snapshot()))
    seen = torch.stack(observed)
    ends = np.cumsum([t.entry.traits["size"] for t in task.observation])
    columns = {t.key: slice(end - t.entry.traits["size"], end) for t, end in zip(task.observation, ends, strict=True)}
    return mirror_of(task.observation).observation(seen[:, 0]), seen[:, 1], columns


def test_a_symmetric_robot_and_its_image_stay_mirror_images_over_half_a_second_of_contact() -> None:
    """Two trajectories of the simulator, so the signs are those of physics.

    Inertias are made symmetric, so only rounding is left: none where this was written. 1e-4 is float32's rounding
    (2e-6 at 20 rad/s, 2e-5 of the clock's angle) with room for contacts that magnify float64's.
    """
    wanted, seen, columns = seen_by_a_robot_and_its_image(symmetric=True, steps=25)
    for name, k in columns.items():
        assert wanted[:, k].abs().max() > 0.01, name
        np.testing.assert_allclose(seen[:, k], wanted[:, k], rtol=0.0, atol=1e-4, err_msg=name)


def test_the_go1_and_its_image_stay_nearly_mirror_images() -> None:
    """Its trunk's centre of mass is 2 mm and a calf's 1 mm off the plane, beside links of 0.1 to 0.2 m: 1 to 2 %.

    So over a few steps each term differs by some per cent of its own size; 5 % are allowed.
    """
    wanted, seen, columns = seen_by_a_robot_and_its_image(symmetric=False, steps=5)
    for name, k in columns.items():
        size = wanted[:, k].square().mean().sqrt()
        assert (seen[:, k] - wanted[:, k]).square().mean().sqrt() < 0.05 * size, name
    assert (seen - wanted).abs().max() > 1e-4  # so that the test above shows what makes the difference


# ---------------------------------------------------------------------- the update


@pytest.fixture
def ppo() -> AdaptivePPO:
    config = settings("ppo.symmetry=true", "observation=clock")
    return AdaptivePPO(config.ppo, Go1VecEnv(Go1Core(config.task, 8, 0)), 0, "cpu")


def samples(policy: GaussianPolicy, count: int = 24) -> RolloutBufferSamples:
    """Samples with the log-probabilities of a policy, and a few actions that it has moved away from."""
    torch.manual_seed(0)
    observations = torch.randn(count, 50)
    with torch.no_grad():
        actions, values, log_prob = policy(observations)
    values = values.flatten()
    moved = log_prob + 0.1 * torch.randn(count)
    return RolloutBufferSamples(observations, actions, values, moved, torch.randn(count), values + torch.randn(count))


def gradient(policy: GaussianPolicy, loss: Tensor) -> Tensor:
    policy.zero_grad()
    loss.backward()
    return torch.cat([p.grad.flatten() for p in policy.parameters() if p.grad is not None])


def test_a_batch_is_joined_with_its_image_under_the_same_advantages_and_probabilities(ppo: AdaptivePPO) -> None:
    batch = samples(ppo.policy)
    assert ppo.mirror is not None
    joined = ppo.mirror.joined(batch)
    for name, original in batch._asdict().items():
        both = getattr(joined, name)
        assert torch.equal(both[:24], original), name
        if name not in ("observations", "actions"):
            assert torch.equal(both[24:], original), name
    images = joined.observations[24:]
    assert torch.equal(images[:, :3], batch.observations[:, :3] * torch.tensor([1.0, -1.0, 1.0]))
    assert torch.equal(images[:, 48:], -batch.observations[:, 48:])
    hips = [3 * leg for leg in range(4)]
    assert torch.equal(joined.actions[24:, hips], -batch.actions[:, [3, 0, 9, 6]])


@pytest.mark.parametrize("value_clip", ["null", "0.2"])
def test_the_gradient_is_that_of_the_batch_joined_with_its_image(value_clip: str) -> None:
    config = settings("ppo.symmetry=true", "observation=clock", f"ppo.value_clip={value_clip}")
    ppo = AdaptivePPO(config.ppo, Go1VecEnv(Go1Core(config.task, 8, 0)), 0, "cpu")
    batch, policy = samples(ppo.policy), ppo.policy
    assert ppo.mirror is not None
    ours = gradient(policy, ppo_loss(policy, batch, config.ppo, ppo.mirror).total)
    joined = gradient(policy, ppo_loss(policy, ppo.mirror.joined(batch), config.ppo).total)
    alone = gradient(policy, ppo_loss(policy, batch, config.ppo).total)
    torch.testing.assert_close(ours, joined)
    assert (ours - alone).norm() > 0.1 * alone.norm()


def test_the_statistics_are_of_the_collected_samples_alone(ppo: AdaptivePPO) -> None:
    """An image's ratio says how asymmetric a policy is: the adaptive rate must not take that for a step too long."""
    policy: Any = ppo.policy
    batch = samples(policy)
    alone = ppo_loss(policy, batch, ppo.config)
    ppo._old_log_std = policy.log_std.detach().clone()
    with torch.no_grad():
        ppo.rollout_buffer.current_means = policy.get_distribution(batch.observations).distribution.mean
    with torch.no_grad():  # far from symmetric, in a way that the collected samples do not show
        policy.action_net.bias[0] += 1.0
        ppo.rollout_buffer.current_means[:, 0] += 1.0
        batch = batch._replace(actions=batch.actions + torch.eye(12)[0])
    both = ppo_loss(policy, batch, ppo.config, ppo.mirror)
    torch.testing.assert_close(both.clip_fraction, alone.clip_fraction)
    torch.testing.assert_close(both.approx_kl, alone.approx_kl)
    assert float(ppo._divergence()) == pytest.approx(0.0, abs=1e-6)
    assert ppo.mirror is not None
    assert ppo_loss(policy, ppo.mirror.joined(batch), ppo.config).approx_kl > alone.approx_kl + 0.1


def test_the_step_of_a_symmetric_policy_leaves_it_symmetric(ppo: AdaptivePPO) -> None:
    """Whatever one side earned by luck: here the right front hip is paid for what it happens to do."""
    policy: Any = ppo.policy
    with torch.no_grad():  # the same action for every observation
        policy.action_net.weight.zero_()
        policy.action_net.bias.zero_()
    batch = samples(policy)
    batch = batch._replace(advantages=batch.actions[:, 0])
    steps = []
    for image in (None, ppo.mirror):
        gradient(policy, ppo_loss(policy, batch, ppo.config, image).total)
        assert policy.action_net.bias.grad is not None
        steps.append(policy.action_net.bias.grad.clone())
    torch.testing.assert_close(steps[1], mirror.ACTION(steps[1]))
    assert (steps[0] - mirror.ACTION(steps[0])).norm() > 0.5 * steps[0].norm()


def test_a_minibatch_is_joined_with_nothing_that_a_graph_cannot_hold(ppo: AdaptivePPO) -> None:
    batch = samples(ppo.policy)
    assert ppo.mirror is not None
    ppo.mirror.joined(batch)  # its numbers are made once
    with Watch() as watch:
        joined = ppo.mirror.joined(batch)
    assert watch.unfit == []
    assert joined.actions.shape == (48, 12)


def test_the_images_count_in_the_memory_that_a_training_needs() -> None:
    config = settings()
    both = replace(config, ppo=replace(config.ppo, symmetry=True))
    assert preflight.needed_bytes(both) - preflight.needed_bytes(config) == 4 * 12 * 2 * 24


# ---------------------------------------------------------------------- settings


PLUGIN = '''
from go1exp.extend import Snapshot, mirror, observation


@observation("loads", size=4{})
def loads(s: Snapshot):
    """Forces on the feet."""
    return s.foot_force
'''


@pytest.mark.parametrize(
    ("trait", "complaint"),
    [
        (
            "",
            "ppo.symmetry = True: observation.loads does not say what its mirror image is; add mirror= to @observation",
        ),
        (", mirror=mirror.POLAR", "ppo.symmetry = True: observation.loads has 4 columns and a mirror of 3"),
        (", mirror=mirror.LEGS", None),
    ],
)
def test_an_observation_without_a_mirror_of_its_width_is_refused_in_one_line(
    tmp_path: Path, trait: str, complaint: str | None
) -> None:
    file = tmp_path / "my_terms.py"
    file.write_text(PLUGIN.format(trait))
    given = [*SMALL, f"plugins=[{file}]", "+observation.loads.noise=0.1"]
    with plugins.restored():
        parse_train(compose("train", given))  # nobody asks for its mirror
        if complaint is None:
            parse_train(compose("train", [*given, "ppo.symmetry=true"]))
            return
        with pytest.raises(ConfigError) as error:
            parse_train(compose("train", [*given, "ppo.symmetry=true"]))
    (line,) = error.value.problems
    assert line.startswith(complaint)
    assert "my_terms.py" in line


def test_a_run_of_a_version_without_the_key_has_no_mirrored_samples() -> None:
    container = compose("train", SMALL)
    del container["ppo"]["symmetry"]
    assert parse_train(container).ppo.symmetry is False
