"""A critic that sees more than the policy: its columns, its network, and that who runs a policy needs none of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp.config.compose import compose
from go1exp.config.schema import plugins
from go1exp.config.schema.registry import ConfigError, members
from go1exp.deploy.export.build import build
from go1exp.mdp.ground import SCAN_COLUMNS, SCAN_ROWS, GroundHeight, HeightScan, RiseAhead
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TrainConfig, parse_train
from go1exp.train import checkpoint, policy, run_folder, trainer
from go1exp.train.device import DevicePPO
from go1exp.train.policy import load_network
from go1exp.train.ppo import AdaptivePPO
from tests import small_run
from tests.small_run import SMALL

O, C = 48, 9 + 12 + 16 + 12
"""Columns of ``observation=paper``, and those that ``critic=privileged`` adds."""


def settings(*overrides: str) -> TrainConfig:
    return parse_train(compose("train", [*SMALL, "ppo.matmul_precision=highest", *overrides]))


def learner(config: TrainConfig, kind: type[AdaptivePPO] = AdaptivePPO) -> Any:
    return kind(config.ppo, Go1VecEnv(Go1Core(config.task, config.ppo.num_envs, 0, critic=True)), 0, "cpu")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of a policy whose critic saw more, on mirrored samples."""
    return small_run.trained(tmp_path_factory.mktemp("critic") / "run", "critic=privileged", "ppo.symmetry=true")


def test_the_critics_columns_stand_behind_the_policys_and_change_none_of_them() -> None:
    alone, both = settings().task, settings("critic=privileged").task
    cores = [Go1Core(alone, 4, critic=True), Go1Core(both, 4, critic=True), Go1Core(both, 4)]
    observed = [core.reset() for core in cores]
    assert [o.shape[1] for o in observed] == [O, O + C, O]
    for _ in range(3):
        action = torch.randn(4, 12)
        observed = [core.step(action).observation for core in cores]
        clean = [core.terms.observation(core.snapshot(), core.snapshot()) for core in cores]
        assert torch.equal(clean[1][:, :O], clean[0])
        assert torch.equal(observed[0], observed[2])
        assert torch.equal(observed[1][:, O:], clean[1][:, O:])  # without noise


def test_the_critic_sees_the_truth_and_the_policy_what_the_sensors_say() -> None:
    effect = "+effect.encoder_offset.offset=0.1"
    given = ("rand=none", "event=none", "+critic.joint_position={}", effect)
    core = Go1Core(settings(*given).task, 4, noise=False, critic=True)
    core.reset()
    observed = core.step(torch.zeros(4, 12)).observation
    joints = next(i for i, t in enumerate(core.terms.observed) if t.key == "joint_position")
    begin = sum(t.entry.traits["size"] for t in core.terms.observed[:joints])
    difference = observed[:, begin : begin + 12] - observed[:, O:]
    torch.testing.assert_close(difference.abs(), torch.full((4, 12), 0.1), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("precision", ["highest", "bf16"])
def test_actions_depend_on_the_policys_columns_alone_and_values_on_all(precision: str) -> None:
    policy = learner(settings("critic=privileged", f"ppo.matmul_precision={precision}")).policy
    assert policy.mlp_extractor.policy_net[0].in_features == O
    assert policy.mlp_extractor.value_net[0].in_features == O + C
    one = torch.randn(5, O + C)
    other = one.clone()
    other[:, O:] += 1.0
    for training in (False, True):
        policy.set_training_mode(training)
        with torch.no_grad():
            means = [policy.get_distribution(o).distribution.mean for o in (one, other, one[:, :O])]
            values = [policy.predict_values(o) for o in (one, other)]
            evaluated = [policy.evaluate_actions(o, means[0])[:2] for o in (one, other)]
        torch.testing.assert_close(means[1], means[0])
        torch.testing.assert_close(means[2], means[0])
        assert not torch.allclose(*values)
        torch.testing.assert_close(evaluated[1][1], evaluated[0][1])
        assert not torch.allclose(evaluated[1][0], evaluated[0][0])


@pytest.mark.parametrize("kind", [AdaptivePPO, DevicePPO])
def test_a_critic_of_its_own_trains_on_either_path(kind: type[AdaptivePPO]) -> None:
    ppo = learner(settings("critic=privileged"), kind)
    before = ppo.policy.mlp_extractor.value_net[0].weight.detach().clone()
    ppo.learn(32)
    change = (ppo.policy.mlp_extractor.value_net[0].weight.detach() - before).abs()
    assert torch.isfinite(change).all()
    assert (change[:, O:].amax(0) > 0.0).sum() > C // 2  # a column may be zero all the time


def test_both_paths_collect_and_learn_the_same() -> None:
    weights: list[dict[str, torch.Tensor]] = []
    for kind in (AdaptivePPO, DevicePPO):
        ppo = learner(settings("critic=privileged", "ppo.symmetry=true", "ppo.minibatches=1"), kind)
        torch.manual_seed(1)  # one minibatch of all samples: no order that could differ
        ppo.learn(16)
        weights.append(ppo.policy.state_dict())
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, rtol=1e-3, atol=1e-5, msg=name)


def test_without_one_nothing_has_changed() -> None:
    """Names, shapes and first weights of the network are those of SB3, as before there was such a critic."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    ppo = learner(settings("critic=none"))
    torch.manual_seed(0)
    ours = type(ppo.policy)(ppo.observation_space, ppo.action_space, lambda _: 0.0, net_arch={"pi": [8], "vf": [8]})
    torch.manual_seed(0)
    theirs = ActorCriticPolicy(ppo.observation_space, ppo.action_space, lambda _: 0.0, net_arch={"pi": [8], "vf": [8]})
    assert ours.state_dict().keys() == theirs.state_dict().keys()
    for name, value in theirs.state_dict().items():
        assert torch.equal(ours.state_dict()[name], value), name


def test_who_runs_the_policy_needs_no_column_of_the_critic(trained: Path) -> None:
    config = parse_train(run_folder.read_config(trained))
    network, _ = load_network(trained, config)
    core = Go1Core(config.task, 3)
    observation = core.reset()
    with torch.no_grad():
        action = network._predict(observation, deterministic=True)
    assert observation.shape == (3, O)
    assert action.shape == (3, 12)
    assert build(trained, seconds=0.1)  # reads the bundle back, and replays its trace


def test_a_run_resumes_and_another_begins_with_its_weights(trained: Path) -> None:
    container = run_folder.read_config(trained)
    ppo = trainer.build(parse_train(container))
    state, _ = checkpoint.load_latest(trained)
    checkpoint.restore(ppo, state)
    assert ppo.iteration == 2
    same = settings("critic=privileged")
    assert policy.read_weights(same, trained).policy.keys() == ppo.policy.state_dict().keys()
    with pytest.raises(ConfigError, match=r"critic is \[\] here and \['base_linear_velocity \(3\)'"):
        policy.read_weights(settings(), trained)


def test_a_run_of_a_version_without_the_group_has_no_critic_of_its_own() -> None:
    container = compose("train", SMALL)
    del container["critic"]
    assert parse_train(container).task.critic == ()


def test_wrong_terms_of_the_critic_are_refused_under_their_key() -> None:
    for override, complaint in (
        (
            "+critic.foot_forse={}",
            "critic.foot_forse: unknown observation term 'foot_forse'; did you mean 'foot_force'",
        ),
        ("+critic.foot_force.noise=-1.0", "critic.foot_force.noise = -1.0: input should be greater than or equal to 0"),
    ):
        with pytest.raises(ConfigError) as error:
            settings(override)
        assert [line[: len(complaint)] for line in error.value.problems] == [complaint]


def scan(slope: tuple[float, float], yaw: float, pitch: float = 0.0) -> torch.Tensor:
    """What a robot 0.3 m over (1, 2) sees of ground that rises by ``slope`` along x and y: (17, 11)."""
    x, y = np.arange(0.0, 4.0, 0.1), np.arange(0.0, 5.0, 0.1)
    heights = slope[0] * (x - 1.0)[None, :] + slope[1] * (y - 2.0)[:, None]
    ground = GroundHeight(torch.as_tensor(heights), 0.0, 0.0, 0.1)
    turned = Rotation.from_euler("ZY", [yaw, pitch]).as_quat(scalar_first=True)
    position = torch.tensor([[1.0, 2.0, 0.3]], dtype=torch.float64)
    seen = HeightScan(ground, torch.device("cpu"))(position, torch.as_tensor(turned)[None])
    return seen.view(SCAN_ROWS, SCAN_COLUMNS)


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.5])
def test_a_height_scan_is_of_the_ground_about_the_robot_in_its_heading(yaw: float) -> None:
    ahead, left = np.meshgrid(np.linspace(-0.8, 0.8, 17), np.linspace(-0.5, 0.5, 11), indexing="ij")
    x, y = ahead * np.cos(yaw) - left * np.sin(yaw), ahead * np.sin(yaw) + left * np.cos(yaw)
    for pitch in (0.0, 0.5):  # the grid stays level
        np.testing.assert_allclose(scan((0.2, -0.1), yaw, pitch), 0.2 * x - 0.1 * y - 0.3, atol=1e-6)


def test_a_robot_in_the_mirror_scans_the_image_of_the_ground() -> None:
    image = members("observation")["height_scan"].traits["mirror"]
    there = scan((0.2, 0.1), -0.3).flatten()
    torch.testing.assert_close(there, image(scan((0.2, -0.1), 0.3).flatten()), rtol=0.0, atol=1e-6)


def test_the_ground_is_scanned_only_for_whom_reads_it_and_is_that_of_the_terrain() -> None:
    rough = ("terrain=rough", "terrain.cols=2", "terrain.border=2.0", "rand=none", "event=none")
    task = settings(*rough, "critic=terrain").task
    core, without = Go1Core(task, 4, noise=False, critic=True), Go1Core(task, 4, noise=False)
    assert without.reset().shape == (4, O)
    assert without.snapshot().height_scan is None
    core.reset()
    s = core.snapshot()
    assert s.height_scan is not None
    middle = s.height_scan[:, 187 // 2] + s.base_pos_w[:, 2]
    torch.testing.assert_close(middle, core.ground_height(s.base_pos_w[:, :2]), rtol=0.0, atol=1e-5)
    observed = core.step(torch.zeros(4, 12)).observation[:, O + C :]
    heights = core.snapshot().height_scan
    assert heights is not None
    torch.testing.assert_close(observed, (5.0 * (heights + 0.3)).clamp(-1.0, 1.0))
    assert observed.std() > 0.0


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize("command", [(1.0, 0.0, 0.3), (-0.2, 0.5, 0.0), (0.0, 0.0, 1.0)])
def test_the_rise_is_that_of_the_ground_where_the_command_leads_each_foot(
    yaw: float, command: tuple[float, float, float]
) -> None:
    heights = np.random.default_rng(0).uniform(0.0, 0.3, (60, 60))
    ground = GroundHeight(torch.as_tensor(heights), -3.0, -3.0, 0.1)
    feet = np.array([[0.2, -0.1], [0.25, 0.13], [-0.2, -0.15], [-0.21, 0.12]])
    attitude = Rotation.from_euler("ZY", [yaw, 0.3]).as_quat(scalar_first=True)
    rise = RiseAhead(ground, torch.device("cpu"))(
        torch.as_tensor(feet)[None], torch.as_tensor(attitude)[None], torch.tensor([command], dtype=torch.float64)
    )
    course = yaw + np.arctan2(command[1], command[0])
    for foot, found in zip(feet, rise[0], strict=True):
        reach = np.linspace(0.0, 0.2, 5) * (np.hypot(*command[:2]) > 0.0)
        way = foot + reach[:, None] * [np.cos(course), np.sin(course)]
        there = [float(ground(torch.as_tensor(point))) for point in way]
        assert float(found) == pytest.approx(max(there) - there[0], abs=1e-6)


def test_the_rise_is_computed_only_for_a_reward_that_reads_it_and_is_0_on_flat_ground() -> None:
    ahead = "+reward.ahead={term: foot_clock_ahead, weight: 1.0}"
    rough = ("terrain=rough", "terrain.cols=2", "terrain.border=2.0", "rand=none", "event=none")
    assert Go1Core(settings("rand=none").task, 2).snapshot().foot_rise is None
    for choices in (("rand=none", ahead), (*rough, ahead)):
        core = Go1Core(settings(*choices).task, 4, noise=False)
        core.reset()
        core.command.value.copy_(torch.tensor([1.0, 0.0, 0.0]))
        rise = core.snapshot().foot_rise
        assert rise is not None
        assert rise.shape == (4, 4)
        assert rise.max() == 0.0  # of the platform too
        core.backend.qpos[:, 0] += 1.5
        core.step(torch.zeros(4, 12))
        rise = core.snapshot().foot_rise
        assert rise is not None
        assert (rise.max() > 0.01) == ("terrain=rough" in choices)


MEMORY = '''
from go1exp.extend import Memory, Snapshot, TermSetup, observation


@observation("last_command", size=3)
class LastCommand(Memory):
    """The command one step ago."""

    memory = ("last", "now")

    def __init__(self, setup: TermSetup):
        self.last, self.now = setup.zeros(3), setup.zeros(3)

    def advance(self, s: Snapshot):
        self.last.copy_(self.now)
        self.now.copy_(s.command)

    def __call__(self, s: Snapshot):
        return self.last

    def reset(self, mask):
        self.last.masked_fill_(mask.unsqueeze(1), 0.0)
        self.now.masked_fill_(mask.unsqueeze(1), 0.0)
'''


def test_a_term_of_the_critic_may_remember_and_its_memory_is_saved(tmp_path: Path) -> None:
    file = tmp_path / "my_terms.py"
    file.write_text(MEMORY)
    with plugins.restored():
        task = settings(f"plugins=[{file}]", "+critic.last_command={}", "ppo.symmetry=false").task
        core = Go1Core(task, 4, critic=True)
        core.reset()
        for _ in range(3):
            command = core.command.value.clone()
            observed = core.step(torch.zeros(4, 12)).observation[:, O:].clone()
        core.step(torch.zeros(4, 12))
        assert torch.equal(core.terms.observation(core.snapshot(), core.snapshot())[:, O:], command)
        assert observed.shape == (4, 3)
        assert "critic.last_command" in core.state_dict()
        assert "critic.last_command" not in Go1Core(task, 4).state_dict()
