"""The borders: Gymnasium and Stable-Baselines3."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import go1exp
from go1exp.base import memory
from go1exp.base.paths import data_root
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env import register
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.env.gym_env import Go1Env
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TaskConfig
from tests.command import run, run_alone

Make = Callable[..., Go1Core]

ONE_THREAD = "backend.threads=1"
LIVELY = (ONE_THREAD, "sim.episode_s=0.4", "event.push.interval=[0.1,0.3]", "command.hold_time=[0.06,0.2]")
QUIET = (ONE_THREAD, "rand=none", "event=none", "termination=none", "command=forward")


@pytest.fixture
def registered() -> Iterator[None]:
    """`Go1-v0`, whether importing go1exp announces it or not."""
    announced = "Go1-v0" in gymnasium.registry
    if not announced:
        register()
    yield
    if not announced:
        gymnasium.registry.pop("Go1-v0")


def actions(n: int, steps: int, scale: float = 1.0, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, scale, (steps, n, 12)).astype(np.float32)


# Gymnasium


alone = pytest.mark.slow("README.md", "go1exp/__init__.py", "go1exp/sim/env/", "go1exp/config/compose.py", "conf/")


@pytest.mark.parametrize("start", [run, pytest.param(run_alone, marks=alone)], ids=["forked", "alone"])
def test_the_example_of_the_readme_works(start: Callable[..., CompletedProcess[str]], tmp_path: Path) -> None:
    code = (data_root() / "README.md").read_text().split("```python")[1].split("```")[0]
    more = "\nobservation, _ = env.reset(seed=0)\nprint(observation.shape, env.spec.id)"
    done = start(tmp_path, code=code + more)
    assert done.stdout.strip() == "(48,) Go1-v0", done.stderr


def test_gymnasiums_own_checker_is_content() -> None:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(Go1Env([ONE_THREAD]), skip_render_check=True)
    # An observation has no bounds, and actions are in units of their own scale.
    allowed = ("infinity. This is probably too", "we recommend using a symmetric and normalized space")
    assert [str(w.message) for w in said if not any(a in str(w.message) for a in allowed)] == []


def test_gymnasium_makes_it_by_name_with_overrides(registered: None) -> None:
    env = gymnasium.make("Go1-v0", overrides=[*QUIET, "action.clip=3.0", "sim.policy_dt=0.01", "sim.episode_s=0.05"])
    try:
        assert isinstance(env.unwrapped, Go1Env)
        assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (48,), np.float32)
        assert env.action_space == gymnasium.spaces.Box(-2.0, 2.0, (12,), np.float32)
        assert env.metadata["render_fps"] == 100
        observation, info = env.reset(seed=1)
        assert env.observation_space.contains(observation)
        assert info == {}
        for k in range(1, 6):
            observation, reward, terminated, truncated, info = env.step(np.zeros(12, np.float32))
            assert env.observation_space.contains(observation)
            assert type(reward) is float
            assert type(terminated) is type(truncated) is bool
            assert (terminated, truncated) == (False, k == 5)
    finally:
        env.close()


def test_the_action_box_is_chosen_and_ends_at_the_clip(make_core: Make) -> None:
    assert Go1Env(QUIET, action_box=0.5).action_space == gymnasium.spaces.Box(-0.5, 0.5, (12,), np.float32)
    clipped, batch = Go1Env([*QUIET, "action.clip=1.0"]), Go1VecEnv(make_core(*QUIET), action_box=3.0)
    assert clipped.action_space == gymnasium.spaces.Box(-1.0, 1.0, (12,), np.float32)
    assert batch.action_space == gymnasium.spaces.Box(-3.0, 3.0, (12,), np.float32)
    with pytest.raises(ConfigError, match=r"^action_box = 0.0: must be a positive number"):
        Go1Env(QUIET, action_box=0.0)
    with pytest.raises(ConfigError, match=r"^action_box = wide: must be a positive number"):
        Go1Env(QUIET, action_box="wide")  # type: ignore[arg-type]


def test_actions_drawn_uniformly_from_the_box_leave_the_robot_standing() -> None:
    env = Go1Env([*QUIET[:-2], "command=forward"])
    env.action_space.seed(0)
    env.reset(seed=0)
    assert not any(env.step(env.action_space.sample())[2] for _ in range(100))


ASYNC = """
import gymnasium
env = gymnasium.make_vec("go1exp.sim.gym:Go1-v0", num_envs=2, vectorization_mode="async", overrides=["terrain=flat"])
env.reset(seed=0)
print(env.step(0.0 * env.action_space.sample())[0].shape)
env.close()
"""


@alone
def test_gymnasiums_asynchronous_vector_works_with_its_default_fork(tmp_path: Path) -> None:
    """In a process of its own: what hangs is a fork after torch has started threads."""
    done = run_alone(tmp_path, code=ASYNC)
    assert done.stdout.strip() == "(2, 48)", done.stderr


def test_gymnasiums_vector_of_robots_is_the_batch(registered: None) -> None:
    env = gymnasium.make_vec("Go1-v0", num_envs=3, overrides=LIVELY)
    core = go1exp.make(LIVELY, 3, seed=4)
    assert env.action_space.shape == (3, 12)
    np.testing.assert_array_equal(env.reset(seed=4)[0], core.reset().numpy())
    ended = 0
    for action in actions(3, 25):
        observation, reward, terminated, truncated, info = env.step(action)
        expected = core.step(torch.as_tensor(action))
        np.testing.assert_array_equal(observation, expected.observation.numpy())
        np.testing.assert_array_equal(reward, expected.reward.numpy())
        done = terminated | truncated
        ended += done.sum()
        assert bool(info) == done.any()
        if info:
            np.testing.assert_array_equal(info["_final_obs"], done)
            np.testing.assert_array_equal(info["final_obs"][done], expected.final_observation.numpy()[done])
    assert ended >= 3


@pytest.mark.parametrize(
    "error", [NumericalFault.not_finite("action", "at step 1"), ConfigError(["a = 1: wrong", "b: too"])]
)
def test_an_error_of_a_worker_process_arrives_with_its_message(error: Exception) -> None:
    """Gymnasium's vector of processes raises CLASS(ERROR), where ERROR has been pickled."""
    sent = pickle.loads(pickle.dumps(error))
    again = type(error)(sent)
    assert str(sent) == str(again) == str(error)
    assert getattr(again, "problems", None) == getattr(error, "problems", None)


@pytest.mark.parametrize("group", ["reward", "rand", "terrain", "event"])
def test_make_refuses_a_choice_as_the_command_line_does(group: str, registered: None) -> None:
    for make in (go1exp.make, partial(gymnasium.make, "Go1-v0")):
        with pytest.raises(ConfigError, match=f"^{group}=nonee: unknown choice of {group} 'nonee'; "):
            make(overrides=[f"{group}=nonee"])
        with pytest.raises(ConfigError, match=r"reward\.gaitt"):
            make(overrides=["+reward.gaitt={weight: 1.0}"])
        with pytest.raises(ConfigError, match=r"^rewards: unknown key 'rewards'"):
            make(overrides=["+rewards.gait=1"])


def trajectory(env: Go1Env, seed: int | None, steps: int = 50) -> list[np.ndarray]:
    seen = [env.reset(seed=seed)[0]]
    for action in actions(1, steps)[:, 0]:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(np.append(observation, [reward, terminated, truncated]))
        if terminated or truncated:
            seen.append(env.reset()[0])
    return seen


def test_a_seed_decides_an_episode_and_all_that_follow() -> None:
    env = Go1Env(LIVELY)
    first, again, other = trajectory(env, 5), trajectory(env, 5), trajectory(env, 6)
    new = trajectory(Go1Env(LIVELY), 5)
    assert len(first) > 52  # more than one episode
    for a, b, c in zip(first, again, new, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    assert not np.array_equal(first[0], other[0])
    env.reset(seed=5)
    assert not np.array_equal(env.reset()[0], first[0])  # without a seed the next episode is another one


def test_arrays_of_the_single_environment_are_the_callers_own() -> None:
    env = Go1Env(LIVELY)
    observation, _ = env.reset(seed=0)
    kept, copy = [observation], [observation.copy()]
    for action in actions(1, 30)[:, 0]:
        given = action.copy()
        observation = env.step(action)[0]
        np.testing.assert_array_equal(action, given)
        kept.append(observation)
        copy.append(observation.copy())
    for a, b in zip(kept, copy, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("noise", [False, True])
def test_a_single_environment_shows_a_policy_what_that_environment_of_a_batch_shows(
    make_task: Callable[..., TaskConfig], noise: bool
) -> None:
    """New commands and pushes are in the observation that the policy acts on next."""
    task = make_task(*LIVELY, "termination=none", "sim.episode_s=2.0")
    batch, env = quiet_batch(Go1Core(task, 4, noise=noise)), Go1Env(task=task, noise=noise, env_index=2)
    batch.seed(9)
    expected = batch.reset()
    np.testing.assert_array_equal(env.reset(seed=9)[0], expected[2])
    for k, action in enumerate(actions(4, 40, 0.5)):
        expected, reward, _, _ = batch.step(action)
        observation, alone, *_ = env.step(action[2])
        assert alone == reward[2], k
        np.testing.assert_array_equal(observation, expected[2], err_msg=f"step {k}")


def test_a_single_environment_ends_with_its_last_observation() -> None:
    env = Go1Env([*QUIET, "sim.episode_s=0.1"], noise=False)
    env.reset(seed=0)
    for action in actions(1, 5, 0.5)[:, 0]:
        observation, _, _, truncated, _ = env.step(action)
    assert truncated
    np.testing.assert_array_equal(observation[36:], action)  # not that of a new episode, which would be zero
    assert observation[12:36].any()
    assert not env.reset()[0][36:].any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs = 0: must be a whole number, 1 or more"),
        ({"num_envs": 2.5}, "num_envs = 2.5: must be a whole number, 1 or more"),
        ({"num_envs": True}, "num_envs = True: must be a whole number, 1 or more"),
        ({"num_envs": 2, "seed": -1}, "seed = -1: must be a whole number, 0 or more"),
        (
            {"overrides": "reward=paper"},
            "overrides = 'reward=paper': must be a list of texts, such as ['reward=paper']",
        ),
        ({"overrides": [3]}, "overrides = [3]: must be a list of texts, such as ['reward=paper']"),
        ({"overrides": 3}, "overrides = 3: must be a list of texts, such as ['reward=paper']"),
    ],
)
def test_an_argument_of_make_that_cannot_be_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        go1exp.make(**arguments)
    assert str(refused.value) == message


@pytest.mark.parametrize("number", [10**7, 10**12, 10**400])
def test_robots_that_do_not_fit_into_memory_are_refused_at_once(
    number: int, registered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "free", lambda: 6 * 10**9)
    measured = 11_500  # B a robot with 60,000 of them
    words = rf"^num_envs = {number}: with {number} robots it takes at least \S+ GB, and 6\.0 GB are free in memory; "
    for make in (go1exp.make, partial(gymnasium.make_vec, "Go1-v0")):
        with pytest.raises(ConfigError, match=f"{words}[0-9]+ at most would fit$") as caught:
            make(overrides=QUIET, num_envs=number)
        offered = int(str(caught.value).rsplit("; ", 1)[1].split()[0])
        assert 6e9 / measured < offered < 1.2 * 6e9 / measured


def test_numbers_of_numpy_are_whole_numbers_too() -> None:
    numbers: dict[str, Any] = {"num_envs": np.int64(2), "seed": np.uint8(3)}
    assert go1exp.make(QUIET, **numbers).reset().shape == (2, 48)


def test_arguments_of_the_single_environment_that_cannot_be_are_named(registered: None) -> None:
    with pytest.raises(ConfigError, match=r"^overrides = 'reward=paper': must be a list of texts"):
        gymnasium.make("Go1-v0", overrides="reward=paper")
    with pytest.raises(ConfigError, match=r"^env_index = -1: must be a whole number, 0 or more"):
        Go1Env(QUIET, env_index=-1)


@pytest.mark.parametrize("shape", [(11,), (1, 12), ()])
def test_an_action_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    env = Go1Env(QUIET)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^action: has shape \(.*\); must be \(12,\)"):
        env.step(np.zeros(shape, np.float32))


@pytest.mark.parametrize(
    "action", [None, "still", {}, np.array([None] * 12), np.array(["0"] * 12), [[0.0], [0.0, 1.0]], 1j * np.ones(12)]
)
def test_an_action_without_numbers_is_refused_by_name(action: Any, make_core: Make) -> None:
    env = Go1Env(QUIET)
    env.reset(seed=0)
    for step in (env.step, quiet_batch(make_core(*QUIET)).step):
        with pytest.raises(ValueError, match=r"^action: must be an array of numbers, not"):
            step(action)


@pytest.mark.parametrize(
    "action", [np.arange(12.0)[::-1], np.arange(12.0, dtype=">f4"), np.arange(12, dtype=np.longdouble), list(range(12))]
)
def test_numbers_of_any_kind_are_actions(action: Any, make_core: Make) -> None:
    env = quiet_batch(make_core(*QUIET))
    env.step_async([action])
    np.testing.assert_array_equal(env._actions[0].numpy(), np.array(action, np.float32))


def test_what_else_fails_of_an_action_is_not_called_its_numbers(make_core: Make) -> None:
    with pytest.raises(NotImplementedError, match="meta"):
        quiet_batch(make_core(*QUIET)).step_async(torch.zeros(1, 12, device="meta"))


# Stable-Baselines3


def quiet_batch(core: Go1Core) -> Any:
    """Build it whatever it says; ``test_it_is_built_without_a_word`` minds that."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Go1VecEnv(core)


def test_it_is_built_without_a_word(make_core: Make) -> None:
    env = Go1VecEnv(make_core(*QUIET, num_envs=3))
    assert env.render_mode is None
    assert env.num_envs == 3
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (48,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-100.0, 100.0, (12,), np.float32)


def test_arrays_of_the_batch_are_the_callers_own(make_core: Make) -> None:
    env = quiet_batch(make_core(*LIVELY, num_envs=3))
    kept, copies = [env.reset()], []
    copies.append(np.copy(kept[0]))
    returned = env.core.episode_return
    for action in actions(3, 30):
        given = action.copy()
        observation, reward, done, infos = env.step(action)
        np.testing.assert_array_equal(action, given)
        for array in (observation, reward, done, *(i["terminal_observation"] for i in infos if i)):
            kept.append(array)
            copies.append(np.copy(array))
        before = returned.clone()
        reward += 1e6  # as SB3 does with the bootstrap value
        copies[-2 - sum(map(bool, infos))] = np.copy(reward)
        assert torch.equal(returned, before)
    assert len(kept) > 92
    for a, b in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(a, b)


def test_seeding_the_batch_makes_it_reproducible(make_core: Make) -> None:
    env, new = (quiet_batch(make_core(*LIVELY, num_envs=3, seed=s)) for s in (1, 2))
    env.reset()
    for action in actions(3, 10):
        env.step(action)
    env.seed(4)
    new.seed(4)
    first, second = env.reset(), new.reset()
    np.testing.assert_array_equal(first, second)
    for action in actions(3, 30, seed=1):
        for a, b in zip(env.step(action)[:3], new.step(action)[:3], strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.array_equal(env.reset(), first)  # the seed is used once


def test_the_batch_and_the_core_are_the_same_thing(make_core: Make) -> None:
    env, core = quiet_batch(make_core(*LIVELY, num_envs=3)), make_core(*LIVELY, num_envs=3)
    np.testing.assert_array_equal(env.reset(), core.reset().numpy())
    ends = []
    for action in actions(3, 40, 3.0):
        observation, reward, done, infos = env.step(action)
        result = core.step(torch.as_tensor(action))
        np.testing.assert_array_equal(observation, result.observation.numpy(), strict=True)
        np.testing.assert_array_equal(reward, result.reward.numpy(), strict=True)
        np.testing.assert_array_equal(done, (result.terminated | result.truncated).numpy(), strict=True)
        for i, info in enumerate(infos):
            assert bool(info) == done[i]
            if info:
                assert info.keys() == {"terminal_observation", "TimeLimit.truncated", "episode"}
                last = result.final_observation[i].numpy()
                np.testing.assert_array_equal(info["terminal_observation"], last, strict=True)
                assert info["episode"] == {"r": float(result.episode_return[i]), "l": int(result.episode_length[i])}
                assert info["TimeLimit.truncated"] is bool(result.truncated[i])
                ends.append(info["TimeLimit.truncated"])
    assert min(ends.count(True), ends.count(False)) >= 2


def test_an_attribute_that_does_not_exist_is_said_not_to(make_core: Make) -> None:
    """SB3 asks whether a batch has an attribute by trying to get it."""
    env = quiet_batch(make_core(*QUIET, num_envs=3))
    assert env.get_attr("num_envs") == [3, 3, 3]
    assert env.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert env.get_attr("num_envs", indices=1) == [3]
    assert env.has_attr("num_envs")
    assert not env.has_attr("no_such_thing")


def test_single_environments_of_a_batch_cannot_be_changed_or_called(make_core: Make) -> None:
    env = quiet_batch(make_core(*QUIET, num_envs=2))
    with pytest.raises(NotImplementedError, match="noise"):
        env.set_attr("noise", False)
    with pytest.raises(NotImplementedError, match="render"):
        env.env_method("render")
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False, False]
    env.close()


# What a step was made of


def test_the_info_of_a_step_splits_the_reward_into_its_terms() -> None:
    env = Go1Env([ONE_THREAD, "reward.gait.weight=0.0"])
    env.reset(seed=2)
    keys = {t.key for t in env.core.task.reward} - {"gait"}
    for action in actions(1, 5)[:, 0]:
        _, reward, _, _, info = env.step(action)
        assert info["reward_terms"].keys() == keys
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, rel=1e-5, abs=1e-6)
        assert "episode_end" not in info
    foot = info["reward_terms"]["foot_force"]
    env.core.terms.weights.mul_(2.0)
    assert foot < 0.0
    assert env.core.reward_terms()["foot_force"][0] == pytest.approx(2.0 * foot)


@pytest.mark.parametrize(
    ("overrides", "end"),
    [
        (["sim.episode_s=0.06"], "time limit"),
        (["termination.tilt.max_angle=0.0001", "~termination.trunk_contact"], "tilt"),
        (["+termination.leant={term: tilt, max_angle: 0.0001}", "termination.tilt.max_angle=3.0"], "leant"),
        (["terrain=rough", "terrain.rows=1", "terrain.cols=1", "rand.body_position.range=[60.0,60.0]"], "left the map"),
    ],
)
def test_the_info_of_the_last_step_names_what_ended_the_episode(overrides: list[str], end: str) -> None:
    env = Go1Env([ONE_THREAD, *overrides])
    env.reset(seed=2)
    for action in actions(1, 3, scale=3.0)[:, 0]:
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    assert info["episode_end"] == end
    assert terminated == (end in ("tilt", "leant"))


def test_a_batch_is_made_from_overrides_and_says_why_each_episode_ended() -> None:
    robots = go1exp.make([*LIVELY, "sim.episode_s=0.06"], num_envs=5, seed=3)
    assert robots.reset().shape == (5, 48)
    for k in range(1, 7):
        result = robots.step(torch.zeros(5, 12))
        ends = [robots.episode_end(result, i) for i in range(5)]
        assert ends == ["time limit" if k % 3 == 0 else None] * 5
        total = sum(robots.reward_terms().values())
        torch.testing.assert_close(total, result.reward, rtol=1e-5, atol=1e-6)
    twin = Go1Core(robots.task, 5, 3)
    again = go1exp.make([*LIVELY, "sim.episode_s=0.06"], num_envs=5, seed=3)
    assert torch.equal(twin.reset(), again.reset())
