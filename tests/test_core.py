from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from go1exp import robot
from go1exp.config.schema.registry import Entry, Term
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.task import TaskConfig

Make = Callable[..., Go1Core]

LIVELY = (
    *("rand=table1", "sim.episode_s=1.0", "sim.physics_dt=0.004"),
    *("event.push.interval=[0.1,0.3]", "command.hold_time=[0.06,0.4]"),
)
"""Everything random is on, and happens often."""

TILES = ("terrain=rough", "terrain.rows=4", "terrain.cols=3", "terrain.border=2.0")
ROUGH = (*TILES, "curriculum=terrain_level", "curriculum.terrain_level.start_level_max=3")
RAISED = np.array([0.0, 0.0, 0.33])
"""From the ground at the middle of a tile to where the trunk starts, m."""

QUIET = ("rand=none", "event=none", "termination=none", "command=forward")
"""Nothing random, and no end but the time limit."""

GROUNDS = pytest.mark.parametrize("ground", [(), ROUGH], ids=["flat", "rough"])


def actions(n: int, steps: int, scale: float = 1.5, seed: int = 0) -> Tensor:
    """Random actions (steps, n, 12), wild enough that some robots fall."""
    return torch.as_tensor(np.random.default_rng(seed).normal(0.0, scale, (steps, n, 12))).float()


def run(core: Go1Core, inputs: Tensor) -> Iterator[dict[str, Tensor]]:
    for action in inputs:
        yield {name: value.clone() for name, value in vars(core.step(action)).items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return all(torch.equal(a[k], b[k]) for k in a)


def data_of(core: Go1Core, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """One environment's model, and its state with everything computed."""
    assert isinstance(core.backend, MujocoCpu)
    model, data = core.backend.env_model(env), core.backend.env_data(env)
    mujoco.mj_forward(model, data)
    return model, data


# Determinism


@GROUNDS
def test_an_environment_does_in_a_batch_what_it_does_alone_bit_for_bit(
    make_core: Make, ground: tuple[str, ...]
) -> None:
    n, steps = 3, 60
    inputs = actions(n, steps, 3.0)
    lively = (*LIVELY, *ground, "sim.episode_s=0.5")
    batch = make_core(*lively, num_envs=n, seed=3)
    first = batch.reset()
    together = list(run(batch, inputs))
    assert sum(int(r["terminated"].sum()) for r in together) >= 2
    assert sum(int(r["truncated"].sum()) for r in together) >= 2
    for i in range(n):
        alone = make_core(*lively, num_envs=1, seed=3, first_env=i)
        assert torch.equal(alone.reset(), first[i : i + 1])
        for k, single in enumerate(run(alone, inputs[:, i : i + 1])):
            for name, value in single.items():
                assert torch.equal(value, together[k][name][i : i + 1]), (i, k, name)


def test_a_restart_of_nobody_can_be_left_out(make_core: Make) -> None:
    random = ("actuator=delay", "effect=coulomb", "+effect.coulomb.spread={bound: 0.1}")
    inputs = actions(3, 60, 3.0)
    usual, thorough = (make_core(*LIVELY, *ROUGH, *random, num_envs=3, seed=3) for _ in range(2))
    thorough._restarts = thorough._restart  # type: ignore[assignment]  # of nobody too
    assert torch.equal(usual.reset(), thorough.reset())
    ends = [bool((r["terminated"] | r["truncated"]).any()) for r in run(usual, inputs)]
    assert 2 <= sum(ends) < len(ends) / 2
    list(run(thorough, inputs))
    assert_close(usual.state_dict(), thorough.state_dict(), rtol=0.0, atol=0.0)
    assert torch.equal(usual.reset(), thorough.reset())


@GROUNDS
def test_a_seed_gives_one_trajectory_whatever_the_number_of_threads_and_another_seed_another(
    make_core: Make, ground: tuple[str, ...]
) -> None:
    inputs = actions(4, 40)
    first, second, other = (
        make_core(*LIVELY, *ground, f"backend.threads={t}", num_envs=4, seed=s) for s, t in ((1, 1), (1, 2), (2, 1))
    )
    start, again, elsewhere = first.reset(), second.reset(), other.reset()
    assert torch.equal(start, again)
    assert not torch.equal(start, elsewhere)
    assert len(start.unique(dim=0)) == 4  # environments of a batch differ too
    for a, b, c in zip(run(first, inputs), run(second, inputs), run(other, inputs), strict=True):
        assert same(a, b)
        assert (a["observation"] != c["observation"]).any(1).all()


@GROUNDS
def test_a_saved_environment_continues_bit_for_bit(make_core: Make, start_core: Make, ground: tuple[str, ...]) -> None:
    n, inputs = 4, actions(4, 90)
    options = (*LIVELY, *(ground or ("command=paper", "actuator=delay")))
    core = start_core(*options, num_envs=n, seed=5)
    list(run(core, inputs[:37]))
    if ground:
        core.level.copy_(torch.tensor([3, 1, 2, 0]))
    state = core.state_dict()
    now = {k: getattr(core, k).clone() for k in ("action", "previous_action", "target", "level", "reward_sums")}
    expected = list(run(core, inputs[37:]))
    assert any(r["terminated"].any() or r["truncated"].any() for r in expected)
    after = core.reset()
    file = io.BytesIO()
    torch.save(state, file)  # which has not moved with the environment

    new = make_core(*options, num_envs=n, seed=99)
    used = start_core(*options, num_envs=n, seed=98)
    list(run(used, actions(n, 10, seed=1)))
    for resumed in (new, used):
        file.seek(0)
        resumed.load_state_dict(torch.load(file, weights_only=True))
        for name, value in now.items():
            assert torch.equal(getattr(resumed, name), value), name
        for want, got in zip(expected, run(resumed, inputs[37:]), strict=True):
            assert same(want, got)
        assert torch.equal(resumed.reset(), after)  # not taken for a first reset either


@pytest.mark.parametrize("when", ["startup", "reset"])
def test_a_reseeded_environment_is_a_new_one(make_core: Make, when: str) -> None:
    options = (*LIVELY, *ROUGH, f"rand.link_mass.when={when}")
    used, new = make_core(*options, seed=1, spread_starts=True), make_core(*options, seed=7, spread_starts=True)
    used.reset()
    list(run(used, actions(4, 20)))
    used.reseed(7)
    assert torch.equal(used.reset(), new.reset())
    inputs = actions(4, 40, seed=2)
    assert all(same(a, b) for a, b in zip(run(used, inputs), run(new, inputs), strict=True))


def test_another_randomisation_does_not_shift_the_others(make_core: Make) -> None:
    """Without one of its terms, everything else about the randomised robots is the same."""
    full, part = make_core("rand=table1"), make_core("rand=table1", "~rand.body_position", "~rand.link_mass")
    full.reset()
    part.reset()
    assert torch.equal(full.backend.qvel, part.backend.qvel)
    assert torch.equal(full.backend.qpos[:, 2:], part.backend.qpos[:, 2:])
    assert torch.equal(full.backend.field("geom_friction"), part.backend.field("geom_friction"))
    assert torch.equal(full.command.value, part.command.value)
    assert not torch.equal(full.backend.qpos[:, :2], part.backend.qpos[:, :2])


# Episodes


def test_an_episode_is_truncated_at_its_time_limit(start_core: Make) -> None:
    core = start_core(*QUIET, "sim.episode_s=0.2", noise=False)
    total = torch.zeros(4)
    for episode in range(3):
        total.zero_()
        for k, result in enumerate(run(core, actions(4, 10, 0.3, seed=episode)), start=1):
            total += result["reward"]
            assert not result["terminated"].any()
            assert result["truncated"].tolist() == [k == 10] * 4
            assert result["episode_length"].tolist() == [k] * 4
            np.testing.assert_allclose(result["episode_return"], total, rtol=1e-6)
            if k < 10:
                assert torch.equal(result["observation"], result["final_observation"])
    last = actions(4, 10, 0.3, seed=2)[-1]
    assert torch.equal(result["final_observation"][:, 36:], last)
    assert not result["observation"][:, 36:].any()
    assert not result["observation"][:, :6].any()  # at rest
    assert not result["observation"][:, 12:36].any()  # in the nominal stance
    assert result["final_observation"][:, 12:36].abs().min() > 0.0


def test_a_robot_on_its_back_is_terminated_and_starts_again_while_the_others_go_on_as_if_nothing_was(
    make_core: Make,
) -> None:
    n, fallen, others = 4, 2, [0, 1, 3]
    core, twin = make_core(*LIVELY, num_envs=n), make_core(*LIVELY, num_envs=n)
    core.reset()
    twin.reset()
    inputs = actions(n, 60, 0.3)
    for a, b in zip(run(core, inputs[:15]), run(twin, inputs[:15]), strict=True):
        assert same(a, b)
    core.backend.qpos[fallen, 2] = 0.5
    core.backend.qpos[fallen, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    ended = False
    for k, (a, b) in enumerate(zip(run(core, inputs[15:]), run(twin, inputs[15:]), strict=True)):
        for name in a:
            assert torch.equal(a[name][others], b[name][others]), (k, name)
        if k == 0:
            ended = bool(a["terminated"][fallen])
            assert not a["truncated"][fallen]
            assert a["final_observation"][fallen, 8] > 0.8  # gravity comes from above
            assert a["observation"][fallen, 8] < -0.9
            assert not a["observation"][fallen, 36:].any()
            assert core.steps[fallen] == 0
            np.testing.assert_allclose(core.snapshot().joint_target[fallen], robot.NOMINAL_STANCE, atol=1e-6)
            height = float(core.backend.qpos[fallen, 2])  # higher where a foot would be in the ground otherwise
            assert robot.NOMINAL_HEIGHT - 1e-9 <= height < robot.NOMINAL_HEIGHT + 0.1
    assert ended


def test_a_trunk_on_the_ground_is_a_fall_even_when_it_is_level(start_core: Make) -> None:
    core = start_core("rand=none", "event=none", num_envs=2)
    core.backend.qpos[1, 2] = 0.056
    core.backend.qpos[1, 7:] = torch.tensor([0.0, 3.1, -0.9] * 4)
    assert core.step(torch.zeros(2, 12)).terminated.tolist() == [False, True]


def test_a_fall_at_the_time_limit_is_a_termination_only(start_core: Make) -> None:
    core = start_core("rand=none", "event=none", "sim.episode_s=0.02", num_envs=2)
    core.backend.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    result = core.step(torch.zeros(2, 12))
    assert result.terminated.tolist() == [False, True]
    assert result.truncated.tolist() == [True, False]


def test_first_episodes_may_begin_at_random_times_and_later_ones_at_zero(start_core: Make) -> None:
    spread = start_core(*QUIET, "sim.episode_s=1.0", num_envs=500, spread_starts=True)
    counts = np.bincount(spread.steps.numpy(), minlength=50)
    assert len(counts) == 50
    assert counts.max() < 30  # ten each, if evenly spread
    spread.reset()
    assert not spread.steps.any()
    together = start_core(*QUIET, num_envs=5)
    assert not together.steps.any()


def test_a_saved_first_episode_keeps_the_time_at_which_it_began(start_core: Make) -> None:
    """It has lasted one step after the next one, however late it began."""
    spread, resumed = start_core(*QUIET, num_envs=5, spread_starts=True), start_core(*QUIET, num_envs=5)
    resumed.load_state_dict(spread.state_dict())
    assert resumed.steps.any()
    assert resumed.step(torch.zeros(5, 12)).episode_length.tolist() == [1] * 5


# Noise and observation

HALF_WIDTHS = [0.02] * 3 + [0.01] * 3 + [0.05] * 3 + [0.0] * 3 + [0.05] * 12 + [0.1] * 12 + [0.0] * 12
"""Table II of the paper."""


def test_noise_is_uniform_within_the_half_widths_of_table_ii_and_off_in_evaluation(make_core: Make) -> None:
    n, half = 20, torch.tensor(HALF_WIDTHS)
    noisy, clean = make_core(*LIVELY, num_envs=n), make_core(*LIVELY, num_envs=n, noise=False)
    draws = [noisy.reset() - clean.reset()]
    for a, b in zip(run(noisy, actions(n, 30)), run(clean, actions(n, 30)), strict=True):
        assert torch.equal(a["reward"], b["reward"])
        draws += [a["observation"] - b["observation"], a["final_observation"] - b["final_observation"]]
    noise = torch.cat(draws)
    rounding = 4e-6  # of joint speeds of some tens of rad/s
    assert (noise.abs() <= half + rounding).all()
    assert (noise[:, half == 0.0] == 0.0).all()
    share = noise[:, half > 0] / half[half > 0]
    assert (share.max(0).values > 0.97).all()
    assert (share.min(0).values < -0.97).all()
    assert (share.mean(0).abs() < 0.1).all()
    assert (np.abs(np.corrcoef(share.numpy().T) - np.eye(33)) < 0.15).all()
    along = share[:-n] - share[n:]
    assert (along != 0.0).all()  # drawn anew each time


def expected_observation(core: Go1Core, env: int, last_action: Tensor) -> np.ndarray:
    """Table II, row by row, from MuJoCo's state."""
    qpos, qvel = core.backend.qpos[env].numpy(), core.backend.qvel[env].numpy()
    to_body = Rotation.from_quat(qpos[3:7], scalar_first=True).inv()
    return np.concatenate(
        [
            to_body.apply(qvel[:3]),
            qvel[3:6],
            to_body.apply([0.0, 0.0, -1.0]),
            core.command.value[env],
            qpos[7:] - robot.NOMINAL_STANCE,
            qvel[6:],
            last_action[env],
        ]
    )


def test_the_observation_is_table_ii_in_its_order(make_core: Make) -> None:
    n = 6
    core = make_core("rand=table1", num_envs=n, noise=False)
    observation = core.reset()
    assert core.observation_size == 48
    for action in torch.cat([torch.zeros(1, n, 12), actions(n, 8, 0.5)]):
        if action.any():
            observation = core.step(action).observation
        assert observation.shape == (n, 48)
        assert observation.dtype == torch.float32
        for i in range(n):
            np.testing.assert_allclose(observation[i], expected_observation(core, i, action), atol=5e-6)


def test_observations_follow_the_list_in_the_configuration(make_core: Make) -> None:
    core = make_core(
        "~observation.base_linear_velocity", "+observation.command_again={term: velocity_command}", noise=False
    )
    observation = core.reset()
    assert observation.shape == (4, 48)
    assert torch.equal(observation[:, 6:9], core.command.value)
    assert torch.equal(observation[:, 45:], core.command.value)


def test_actions_are_cut_and_scaled_to_joint_targets_about_the_nominal_stance(start_core: Make) -> None:
    core = start_core(*QUIET, "action.clip=2.0", "action.scale=0.25", num_envs=1, noise=False)
    action = torch.zeros(1, 12)
    action[0, :4] = torch.tensor([1.0, -1.0, 5.0, -torch.inf])
    result = core.step(action)
    target = robot.NOMINAL_STANCE + np.array([0.25, -0.25, 0.5, -0.5] + [0.0] * 8)
    np.testing.assert_allclose(core.snapshot().joint_target[0], target, atol=1e-6)
    assert result.observation[0, 36:40].tolist() == [1.0, -1.0, 2.0, -2.0]
    for wrong in (torch.zeros(12), torch.zeros(2, 12), torch.zeros(1, 1)):
        with pytest.raises(ValueError, match=r"action has shape .*; needed is \(1, 12\)"):
            core.step(wrong)
    for other in (np.zeros((1, 12)), None):
        with pytest.raises(ValueError, match=r"action is a (ndarray|NoneType); needed is a torch.Tensor \(1, 12\)"):
            core.step(other)  # type: ignore[arg-type]
    core.step(torch.zeros(1, 12))
    s = core.snapshot()
    assert s.previous_action[0, :4].tolist() == [1.0, -1.0, 2.0, -2.0]
    assert not s.action.any()


def test_no_target_changes_by_more_than_the_largest_step(start_core: Make) -> None:
    core = start_core(*QUIET, "action.scale=0.25", "action.max_step=0.1", num_envs=1, noise=False)
    for wanted, reached in ((1.0, 0.1), (1.0, 0.2), (0.7, 0.175), (-3.0, 0.075)):
        result = core.step(torch.full((1, 12), wanted))
        np.testing.assert_allclose(core.snapshot().joint_target[0], robot.NOMINAL_STANCE + reached, atol=1e-6)
        np.testing.assert_allclose(result.observation[0, 36:48], reached / 0.25, atol=1e-6)


def only(name: str, function: Callable[..., Tensor], weight: float = 1.0) -> Term:
    """A reward term that is not in the registry."""
    return Term(name, Entry("reward", name, function), {}, {"weight": weight})


def test_a_new_command_is_seen_before_it_is_paid_for(make_task: Callable[..., TaskConfig]) -> None:
    """The reward of a step judges by the command that the policy saw when it acted."""
    task = make_task(
        "backend.threads=1",
        "command.hold_time=[0.06,0.06]",
        "command.standing_fraction=0.0",
        "reward.linear_velocity_error.ramp=0.0",
    )
    tracking = next(t for t in task.reward if t.key == "linear_velocity_error")
    core = Go1Core(dataclasses.replace(task, reward=(tracking,)), 3, noise=False)
    seen, changes = core.reset(), 0
    for result in run(core, actions(3, 30, 0.2)):
        final = result["final_observation"]
        assert torch.equal(final[:, 9:12], seen[:, 9:12])
        error = (seen[:, 9:11] - final[:, :2]).norm(dim=1)
        np.testing.assert_allclose(result["reward"], 0.02 * tracking.slots["weight"] * torch.exp(-error), rtol=1e-5)
        assert torch.equal(result["observation"][:, 9:12], core.command.value)
        changes += int((result["observation"][:, 9:12] != seen[:, 9:12]).any(1).sum())
        seen = result["observation"]
    assert changes >= 3 * 30 // 3


def test_a_push_is_seen_before_it_is_answered(start_core: Make) -> None:
    push = ("event.push.interval=[0.1,0.1]", "event.push.velocity=[0.7,0.7]")
    core = start_core("rand=none", "termination=none", *push, num_envs=2, noise=False)
    for k, result in enumerate(run(core, torch.zeros(12, 2, 12)), start=1):
        world = Rotation.from_quat(core.backend.qpos[:, 3:7].numpy(), scalar_first=True).apply(
            result["observation"][:, :3]
        )
        if k % 5 == 0:
            np.testing.assert_allclose(world[:, :2], 0.7, atol=1e-6)
            assert (result["final_observation"][:, :2] - 0.7).abs().min() > 0.01
        else:
            assert torch.equal(result["observation"], result["final_observation"])


# Physics


@pytest.mark.parametrize(("physics_dt", "substeps"), [(0.002, 10), (0.004, 5), (0.02, 1)])
def test_a_policy_step_is_that_many_physics_steps_under_the_actuators_law(
    start_core: Make, physics_dt: float, substeps: int
) -> None:
    """Against MuJoCo's own step in a loop, with the torque of a PD law written out here."""
    core = start_core(*QUIET, f"sim.physics_dt={physics_dt}", num_envs=2, noise=False)
    model, data = core.backend.model, mujoco.MjData(core.backend.model)
    data.qpos[:], data.qvel[:] = core.backend.qpos[0], core.backend.qvel[0]
    mujoco.mj_forward(model, data)
    limit = np.tile([23.7, 23.7, 35.55], 4)
    phase, touching, landings = np.zeros(4, int), np.zeros(4, bool), 0
    speed, last_target = data.qvel[6:].copy(), robot.NOMINAL_STANCE
    for action in actions(2, 25, 3.0):
        core.step(action)
        target = robot.NOMINAL_STANCE + 0.2 * action[0].double().numpy()
        landed = np.zeros(4, bool)
        for _ in range(substeps):
            # Half a step ago and one and a half: the speed now. A new target has been in force for half of this step.
            now_speed = 1.5 * data.qvel[6:] - 0.5 * speed
            speed = data.qvel[6:].copy()
            error = 0.5 * (target + last_target) - data.qpos[7:]
            last_target = target
            data.ctrl[:] = np.clip(20.0 * error - 0.5 * now_speed, -limit, limit)
            mujoco.mj_step(model, data)
            force, now = foot_forces(model, data)
            landed |= now & ~touching & (phase > 0)
            phase = np.where(now == touching, phase + 1, 1)
            touching = now
        s = core.snapshot()
        # Targets are float32 in the core, and contacts amplify the difference with time.
        np.testing.assert_allclose(core.backend.qpos[0], data.qpos, atol=1e-5)
        np.testing.assert_allclose(s.joint_torque[0], data.ctrl, atol=1e-3)
        np.testing.assert_allclose(s.joint_acc[0], (data.qvel[6:] - speed) / physics_dt, atol=0.3, rtol=1e-3)
        np.testing.assert_allclose(s.foot_force[0], force, atol=0.05, rtol=1e-3)
        np.testing.assert_array_equal(s.foot_contact[0], touching)
        np.testing.assert_array_equal(s.foot_touchdown[0], landed)
        np.testing.assert_allclose(s.foot_contact_time[0], touching * phase * physics_dt, atol=1e-5)
        np.testing.assert_allclose(s.foot_air_time[0], ~touching * phase * physics_dt, atol=1e-5)
        landings += landed.sum()
    assert landings >= 6
    assert data.time == pytest.approx(0.5)


def foot_forces(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Force on each foot in the last step, N, and whether there was any, from MuJoCo's contact list."""
    force, one = np.zeros((4, 3)), np.zeros(6)
    for k, contact in enumerate(data.contact):
        for leg, name in enumerate(robot.LEGS):
            if model.geom(f"{name}_foot").id in contact.geom:
                mujoco.mj_contactForce(model, data, k, one)
                force[leg] += one[:3] @ contact.frame.reshape(3, 3)
    total = np.linalg.norm(force, axis=1)
    return total, total > 0


def test_the_snapshot_describes_the_state(start_core: Make) -> None:
    core = start_core("rand=table1", num_envs=5, noise=False)
    for k, action in enumerate(actions(5, 6, 0.5), start=1):
        core.step(action)
        s = core.snapshot()
        for f in dataclasses.fields(s):
            value = getattr(s, f.name)
            if f.name in ("height_scan", "foot_rise"):  # which nobody reads here
                assert value is None
                continue
            assert value.shape[0] == 5, f.name
            assert value.dtype in (torch.float32, torch.bool), f.name
        np.testing.assert_allclose(s.base_pos_w, core.backend.qpos[:, :3], atol=1e-6)
        np.testing.assert_allclose(s.episode_time, 0.02 * k, rtol=1e-6)


def test_an_episode_starts_in_the_nominal_stance_or_where_table_i_says(make_core: Make) -> None:
    nominal, varied = make_core("rand=none", num_envs=3), make_core("rand=table1", num_envs=300)
    nominal.reset()
    varied.reset()
    start = np.concatenate([[0.0, 0.0, 0.33, 1.0, 0.0, 0.0, 0.0], robot.NOMINAL_STANCE])
    np.testing.assert_allclose(nominal.backend.qpos, np.tile(start, (3, 1)), atol=1e-7)
    assert not nominal.backend.qvel.any()
    qpos, qvel = varied.backend.qpos.numpy(), varied.backend.qvel.numpy()
    assert np.abs(qpos[:, :2]).max() <= 0.5
    assert np.abs(qpos[:, :2]).max() > 0.45
    angle = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).magnitude()
    assert 0.02 < angle.max() <= 0.02 * math.sqrt(3)
    assert 0.2 < np.abs(qvel[:, :6]).max() <= 0.25
    assert 2.4 < np.abs(qvel[:, 6:]).max() <= 2.5
    factor = qpos[:, 7:] / robot.NOMINAL_STANCE
    assert factor.max() <= 1.3 + 1e-6
    assert factor.min() >= 0.7 - 1e-6
    assert_independent(qpos[:, :2], qvel)


def test_joint_angles_that_are_drawn_stop_at_the_hard_limits(start_core: Make) -> None:
    far = ("rand.joint_positions.operation=add", "rand.joint_positions.range=[-5.0,5.0]")
    q = start_core("rand=table1", *far, num_envs=50).backend.qpos[:, 7:].numpy()
    np.testing.assert_allclose([q.min(0), q.max(0)], robot.JOINT_POS_LIMITS.T, atol=1e-6)


def assert_independent(*draws: np.ndarray) -> None:
    """Columns (N, ...) of numbers that were drawn each by itself: no correlation is beyond four standard errors."""
    columns = np.concatenate([each.reshape(len(each), -1) for each in draws], axis=1)
    correlation = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlation).max() < 4.0 / math.sqrt(len(columns))


def test_a_robot_is_as_table_i_says_each_number_by_itself(start_core: Make) -> None:
    backend = start_core("rand=table1", num_envs=300).backend
    names = ("geom_friction", "body_ipos", "body_mass", "body_inertia")
    friction, com, mass, inertia = (backend.field(name).numpy() for name in names)
    trunk, feet = backend.ids("body", ("trunk",)), backend.ids("geom", robot.FEET)
    moved = (com - backend.model.body_ipos)[:, trunk]
    factor = mass[:, 1:] / backend.model.body_mass[1:]  # all but the world
    for drawn, low, high in ((friction[:, feet, 0], 0.4, 1.1), (moved, -0.025, 0.025), (factor, 0.8, 1.3)):
        near = 0.01 * (high - low)
        assert low - 1e-9 <= drawn.min() < low + near
        assert high - near < drawn.max() <= high + 1e-9
    assert_independent(friction[:, feet, 0], moved, factor)
    np.testing.assert_allclose(inertia[:, 1:], factor[..., None] * backend.model.body_inertia[1:])
    np.testing.assert_array_equal(friction[:, feet, 1:], backend.model.geom_friction[None, feet, 1:].repeat(300, 0))


@pytest.mark.parametrize("when", ["startup", "reset"])
def test_a_model_is_drawn_once_or_at_each_reset_of_its_own_robot(start_core: Make, when: str) -> None:
    core = start_core("rand=table1", f"rand.link_mass.when={when}", "event=none", num_envs=3)

    def look() -> tuple[Tensor, Tensor, Tensor]:
        fields = [core.backend.field(f).flatten(1).clone() for f in ("body_mass", "geom_friction", "body_ipos")]
        return fields[0], fields[1], fields[2]

    before = look()
    core.backend.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    assert core.step(torch.zeros(3, 12)).terminated.tolist() == [False, True, False]
    mass, friction, com = ((a != b).any(1).tolist() for a, b in zip(before, look(), strict=True))
    assert friction == com == [False, True, False]
    assert mass == [False, when == "reset", False]
    for i in range(3):
        model, _ = data_of(core, i)
        assert model.body_subtreemass[1] == pytest.approx(core.backend.field("body_mass")[i].sum().item())
        assert model.body_subtreemass[1] != pytest.approx(12.743, abs=1e-3)


# Reward


def test_the_reward_is_weight_times_term_times_period_summed_over_terms(make_task: Callable[..., TaskConfig]) -> None:
    def unwanted(s: object) -> Tensor:
        raise AssertionError("a term of weight zero is not evaluated")

    terms = (
        only("two", lambda s: torch.tensor([2.0, 4.0]), 3.0),
        only("five", lambda s: torch.full((2,), 5.0), -1.0),
        only("off", unwanted, 0.0),
    )
    task = dataclasses.replace(make_task("backend.threads=1", *QUIET), reward=terms)
    core = Go1Core(task, 2)
    core.reset()
    result = core.step(torch.zeros(2, 12))
    np.testing.assert_allclose(result.reward, [0.02 * (6.0 - 5.0), 0.02 * (12.0 - 5.0)], rtol=1e-6)
    core.step(torch.zeros(2, 12))
    # Per second, over robots and steps: 3 x (2 + 4) / 2 and -5.
    rates = {k: v for k, v in core.drain_metrics(steps=2).items() if k.startswith("reward/")}
    assert rates == pytest.approx({"reward/two": 9.0, "reward/five": -5.0}, rel=1e-6)
    core.step(torch.zeros(2, 12))
    assert core.drain_metrics(steps=1)["reward/five"] == pytest.approx(-5.0)


def test_the_reward_is_the_sum_of_the_configured_terms_on_the_snapshot_of_the_step(start_core: Make) -> None:
    core = start_core(*QUIET, "reward=paper_literal", num_envs=4, noise=False)
    weights = {t.key: t.slots["weight"] for t in core.task.reward}
    assert len(weights) == 19
    for action in actions(4, 20, 0.5):
        result = core.step(action)
        s = core.snapshot()  # nothing has happened since: no push, no reset, one command
        total = sum(weights[t.key] * t(s).double() for t in core.task.reward)
        np.testing.assert_allclose(result.reward, 0.02 * np.asarray(total), rtol=1e-5, atol=1e-6)


# The actuator's place


class Recorder:
    """An actuator that holds still and remembers what it is asked."""

    def __init__(self, setup: ActuatorSetup) -> None:
        self.setup, self.calls = setup, 0
        self.resets: list[list[bool]] = []

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        assert target.dtype == q.dtype == qd.dtype == self.setup.dtype
        self.calls += 1
        return torch.zeros_like(q)

    def reset(self, mask: Tensor) -> None:
        self.resets.append(mask.tolist())

    def state_dict(self) -> dict[str, Tensor]:
        return {"calls": torch.tensor(self.calls)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.calls = int(state["calls"])


def test_an_actuator_is_asked_at_the_physics_rate_told_of_resets_and_saved(
    make_task: Callable[..., TaskConfig],
) -> None:
    options = ("backend.threads=1", "rand=none", "event=none", "robot=go1_isaaclab", "sim.physics_dt=0.004")
    recorder = Term("recorder", Entry("actuator", "recorder", Recorder), {})
    task = dataclasses.replace(make_task(*options), actuator=recorder)
    core, resumed = Go1Core(task, 3), Go1Core(task, 3)
    actuator, other = core.plant.actuator, resumed.plant.actuator
    assert isinstance(actuator, Recorder)
    assert isinstance(other, Recorder)
    assert (actuator.setup.num_envs, actuator.setup.physics_dt) == (3, 0.004)
    assert actuator.setup.effort_limit.tolist() == [23.7] * 12
    assert actuator.setup.velocity_limit.tolist() == [30.0] * 12
    core.reset()
    core.step(torch.zeros(3, 12))
    assert actuator.calls == 5
    core.backend.qpos[2, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    core.step(torch.zeros(3, 12))
    assert actuator.resets == [[True] * 3, [False, False, True]]  # and not of nobody
    resumed.load_state_dict(core.state_dict())
    assert other.calls == 10


# Rough ground


def test_foot_height_over_rough_ground_is_the_height_over_the_field(start_core: Make) -> None:
    n = 30
    core = start_core(*ROUGH, "terrain.cols=5", num_envs=n, noise=False)
    x_min, x_max, y_min, y_max = core.terrain.extent
    rng = np.random.default_rng(0)
    qpos, qvel = core.backend.qpos.clone(), torch.zeros_like(core.backend.qvel)
    qpos[:, 0] = torch.as_tensor(rng.uniform(x_min + 2, x_max - 2, n))
    qpos[:, 1] = torch.as_tensor(rng.uniform(y_min + 2, y_max - 2, n))
    qpos[:, 2] = torch.as_tensor(core.terrain.height_at(qpos[:, :2].numpy()) + rng.uniform(0.3, 0.6, n))
    core.backend.reset(torch.ones(n, dtype=torch.bool), qpos, qvel)
    s = core.snapshot()
    heights = []
    for i in range(n):
        _, data = data_of(core, i)
        feet = np.array([data.site(f"{leg}_foot").xpos for leg in robot.LEGS])
        heights.append(core.terrain.height_at(feet[:, :2]))
        np.testing.assert_allclose(s.foot_height[i], feet[:, 2] - heights[-1], atol=1e-4)
    assert np.ptp(heights) > 0.1


def test_a_robot_that_leaves_the_map_is_truncated_and_brought_back(start_core: Make) -> None:
    core = start_core(*QUIET, *TILES, num_envs=6, noise=False)
    spawn = core.backend.qpos[:, :3].clone()
    x_min, x_max, y_min, y_max = core.terrain.extent
    inside, outside = 1.05, 0.95  # m from the edge
    places = [(x_max - outside, 0.0), (x_min + outside, 0.0), (0.0, y_max - outside), (0.0, y_min + outside)]
    places += [(x_max - inside, y_max - inside), (x_min + inside, y_min + inside)]
    core.backend.qpos[:, :2] = torch.tensor(places, dtype=torch.float64)
    core.backend.qpos[:, 2] = 1.0
    result = core.step(torch.zeros(6, 12))
    assert result.truncated.tolist() == [True] * 4 + [False] * 2
    assert not result.terminated.any()
    assert torch.equal(core.backend.qpos[:4, :3], spawn[:4])
    np.testing.assert_allclose(core.backend.qpos[4:, :2], places[4:], atol=0.01)
    flat = start_core(*QUIET, num_envs=2)  # which has no edge
    flat.backend.qpos[:, 0] = 1e4
    assert not flat.step(torch.zeros(2, 12)).truncated.any()


def test_robots_start_in_the_middle_of_their_tile_column_by_column(start_core: Make) -> None:
    core = start_core(*QUIET, *ROUGH, num_envs=7, first_env=2)
    for i in range(7):
        origin = core.terrain.tile_origins[int(core.level[i]), (i + 2) % 3]
        np.testing.assert_allclose(core.backend.qpos[i, :3], origin + RAISED, atol=1e-6)


@pytest.mark.parametrize(("curriculum", "levels"), [("terrain_level", range(6)), ("none", range(10))])
def test_robots_start_on_random_levels_up_to_the_curriculums(start_core: Make, curriculum: str, levels: range) -> None:
    core = start_core("terrain=rough", "terrain.cols=2", f"curriculum={curriculum}", num_envs=300)
    assert set(core.level.tolist()) == set(levels)
    core.reset()
    before = core.level.clone()
    core.reset()
    assert torch.equal(core.level, before)


COMMANDS = {
    "fast": ((0.8, 0.8), (0.0, 0.0), (0.0, 0.0), 10.0),
    "slow": ((0.1, 0.1), (0.0, 0.0), (0.0, 0.0), 10.0),
    "circle": ((1.0, 1.0), (0.0, 0.0), (1.5, 1.5), 10.0),
    "turn": ((0.0, 0.0), (0.0, 0.0), (1.0, 1.0), 10.0),
    "changing": ((-1.0, 1.0), (-0.5, 0.5), (-1.5, 1.5), 0.3),
    "standing": ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 10.0),
}


SHARES = {1.0: 1, 0.5: 0, 0.0: -1, -1.0: -1, 2.0: -1}
"""Share of the commanded twist with which a trunk moves -> change of its level."""


@pytest.mark.parametrize("walk", COMMANDS)
def test_levels_rise_where_the_commanded_path_is_tracked(walk: str, start_core: Make) -> None:
    """Trunks that are moved by shares of the commanded twist, exactly, for two windows of the path."""
    x, y, yaw, hold = COMMANDS[walk]
    command = [
        f"command.{k}=[{low},{high}]"
        for k, (low, high) in zip(("lin_vel_x", "lin_vel_y", "ang_vel_z"), (x, y, yaw), strict=True)
    ]
    hold_time = f"command.hold_time=[{hold},{hold}]"
    core = start_core(
        *("rand=none", "event=none", "termination=none", *ROUGH, "command=paper", *command, hold_time),
        *("command.standing_fraction=0.0", "sim.episode_s=2.0", "sim.physics_dt=0.004"),
        num_envs=len(SHARES),
        noise=False,
    )
    core.level.fill_(1)
    core.reset()
    pose = core.backend.qpos[:, :7].clone()
    share, heading = torch.tensor(list(SHARES)).double(), torch.zeros(len(SHARES), dtype=torch.float64)
    dt = core.task.sim.physics_dt

    def drive() -> None:
        twist = share[:, None] * core.command.value.double()
        forward, left = twist[:, 0], twist[:, 1]
        heading.add_(dt * twist[:, 2])
        pose[:, 0] += dt * (forward * heading.cos() - left * heading.sin())
        pose[:, 1] += dt * (forward * heading.sin() + left * heading.cos())
        pose[:, 3], pose[:, 6] = (heading / 2).cos(), (heading / 2).sin()
        core.backend.qpos[:, :7] = pose

    core.driver = drive
    steps = core.task.sim.episode_steps
    for k in range(steps):
        assert core.level.tolist() == [1] * len(SHARES), k
        ended = core.step(torch.zeros(len(SHARES), 12)).truncated
    assert ended.all()
    assert core.level.tolist() == [1 if walk == "standing" else 1 + change for change in SHARES.values()]


def test_a_fall_counts_as_the_rest_of_the_path_untracked(start_core: Make) -> None:
    core = start_core(
        "rand=none", "event=none", *ROUGH, "command=forward", "sim.episode_s=4.0", num_envs=3, noise=False
    )
    core.level.fill_(2)
    core.path.total[:] = torch.tensor([[3.0, 3.0], [3.0, 3.0], [0.0, 0.0]])
    core.steps[:] = torch.tensor([20, 180, 20])  # of 200
    core._first_step[2] = 20
    core.backend.qpos[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # upside down
    assert core.step(torch.zeros(3, 12)).terminated.all()
    assert core.level.tolist() == [1, 3, 1]


def test_robots_past_the_top_level_spread_over_all_levels(start_core: Make) -> None:
    core = start_core(*QUIET, *ROUGH, "sim.episode_s=0.02", num_envs=200, noise=False)
    core.level.fill_(3)
    core.path.total[:] = 1.0
    core.backend.qpos[:, 2] = 2.0
    core.step(torch.zeros(200, 12))
    assert np.bincount(core.level.numpy(), minlength=4).min() > 25


# Faults


@pytest.mark.parametrize(
    ("field", "column"), [("qpos", 0), ("qpos", 2), ("qpos", 4), ("qpos", 9), ("qvel", 1), ("qvel", 4), ("qvel", 7)]
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_state_that_is_not_finite_is_a_fault_of_that_environment(
    start_core: Make, elsewhere: None, field: str, column: int, value: float
) -> None:
    core = start_core("rand=none", num_envs=3)
    core.check(core.step(torch.zeros(3, 12)))
    getattr(core.backend, field)[1, column] = value
    with pytest.raises(NumericalFault, match=r"is not finite in environment 1 at step 2$"):
        core.check(core.step(torch.zeros(3, 12)))
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("termination", ["none", "fall"])
def test_a_state_that_is_not_finite_is_not_blamed_on_the_torque_that_follows_from_it(
    start_core: Make, elsewhere: None, termination: str
) -> None:
    """MuJoCo takes a torque that is not finite for zero; a state that is not finite counts as a fall."""
    core = start_core("rand=none", f"termination={termination}", num_envs=3)
    core.backend.step(torch.full((3, 12), torch.nan))
    assert torch.isfinite(core.backend.qpos).all()
    core.backend.qpos[1, 9] = torch.nan
    with pytest.raises(NumericalFault) as caught:
        core.check(core.step(torch.zeros(3, 12)))
    assert not np.isfinite(caught.value.dump["qpos"]).all()
    assert caught.value.quantity in ("qpos", "qvel")


@pytest.mark.parametrize("what", ["qpos", "qvel", "action"])
def test_a_reset_heals_an_environment_after_a_fault(make_core: Make, elsewhere: None, what: str) -> None:
    core, action = make_core("rand=none", "termination=none", num_envs=3), torch.zeros(3, 12)
    core.reset()
    if what == "action":
        action[1, 5] = torch.nan
        with pytest.raises(NumericalFault):
            core.step(action)
    else:
        getattr(core.backend, what)[1, 8] = torch.nan
        core.step(action)
    assert torch.isfinite(core.reset()).all()
    result = core.step(torch.zeros(3, 12))
    core.check(result)
    assert torch.isfinite(result.episode_return).all()


def test_an_action_that_is_not_finite_is_a_fault_that_names_the_action(start_core: Make, elsewhere: None) -> None:
    core = start_core("rand=none", num_envs=3)
    action = torch.zeros(3, 12)
    action[2, 5] = torch.nan
    with pytest.raises(NumericalFault, match=r"^action is not finite in environment 2 at step 1$") as caught:
        core.check(core.step(action))
    assert caught.value.quantity == "action"
    assert np.isnan(caught.value.dump["action"]).tolist() == [k == 5 for k in range(12)]
    assert list(Path().iterdir()) == []


def test_an_observation_that_is_not_finite_is_a_fault_even_when_its_episode_ends(
    make_task: Callable[..., TaskConfig],
) -> None:
    def broken(s: Any) -> Tensor:
        return torch.full((2, 1), torch.nan)

    task = make_task("backend.threads=1", *QUIET, "sim.episode_s=0.02")
    sick = Term("sick", Entry("observation", "sick", broken, {"size": 1}), {}, {"noise": 0.0})
    core = Go1Core(dataclasses.replace(task, observation=(*task.observation, sick)), 2)
    core.reset()
    with pytest.raises(NumericalFault) as caught:
        core.check(core.step(torch.zeros(2, 12)))
    assert caught.value.quantity == "observation"


def test_commands_are_slower_on_harder_tiles_and_not_on_flat_ones(make_core: Make) -> None:
    """The same draws as without, times the share that the tile's difficulty leaves."""
    ground = (
        *("terrain=rough", "terrain.cols=2", "terrain.rows=5", "curriculum=none", "terrain.boxes_proportion=0.5"),
        *("terrain.flat_proportion=0.5", "terrain.bumps_proportion=0", "terrain.ramps_proportion=0"),
    )
    usual, slowed = (
        make_core(*ground, *share, "command=widening", "command.start=0.5", num_envs=40)
        for share in ((), ("+command.hard_share=0.4",))
    )
    for core in (usual, slowed):
        core.reset()
    assert usual.terrain.tile_types == ("boxes", "flat")
    assert set(usual.level.tolist()) == set(range(5))
    difficulty = torch.where(usual.tile_column == 0, usual.level / 4, 0.0)
    assert_close(slowed.command.value, usual.command.value * (1.0 - 0.6 * difficulty).unsqueeze(1))
    slowed.level.zero_()  # a tile that got easier
    for core in (usual, slowed):
        core.command.advance(0.02, torch.ones(40, dtype=torch.bool))
    assert_close(slowed.command.value, usual.command.value)
