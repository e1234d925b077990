"""What the terms of this package promise beyond what every term does (``test_members.py``), and their laws."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.config.schema.registry import Entry, members
from go1exp.extend.testing.randomness import backend as nominal
from go1exp.extend.testing.randomness import everyone, model_fields, parts, start_states, stream, with_fields
from go1exp.extend.testing.snapshots import ODD, mirrored, random_snapshot
from go1exp.mdp.types import Snapshot, TermSetup


def each(group: str, **traits: Any) -> Any:
    """Parametrise a test over the members of a group that have these traits."""
    found = {n: e for n, e in members(group).items() if all(e.traits.get(k) == v for k, v in traits.items())}
    assert found, f"no {group} terms"
    return pytest.mark.parametrize("entry", found.values(), ids=found.keys())


# Functions of a snapshot


def test_the_mirror_is_a_mirror() -> None:
    s = random_snapshot(50)
    twice = mirrored(mirrored(s))
    for f in fields(Snapshot):
        assert torch.equal(getattr(s, f.name), getattr(twice, f.name)), f.name
    image = mirrored(s)
    for quat, gravity in [(image.base_quat_w, image.projected_gravity_b)]:
        seen = Rotation.from_quat(quat.numpy(), scalar_first=True).inv().apply([0.0, 0.0, -1.0])
        np.testing.assert_allclose(gravity.numpy(), seen, atol=1e-6)


ONE_SIDED = {
    "foot_clock": "a clock that begins with FR and RL begins with FL and RR in the mirror",
    "foot_clock_ahead": "the same",
    "load_clock": "the same",
    "base_motion_literal": "a roll changes sign in the mirror, a pitch does not",
    "joint_deviation_literal": "hip angles change sign in the mirror",
    "joint_position_limit_literal": "a hip at its upper stop is one at its lower stop in the mirror",
    "joint_velocity_limit_literal": "hip speeds change sign in the mirror",
}
"""Terms that are not the same in the mirror, as printed in the paper, and why."""


def once(entry: Entry, s: Snapshot) -> torch.Tensor:
    """The term's value; a term that remembers sees its first step."""
    return entry.target(TermSetup(len(s.command), s.command.device, 0.02))(s) if entry.remembers else entry.target(s)


@each("reward")
def test_a_reward_tells_robots_apart(entry: Entry) -> None:
    if entry.name != "air_time_variance_literal":  # identically zero
        assert once(entry, random_snapshot(500)).unique().numel() > 1


@each("reward")
def test_a_reward_is_the_same_in_the_mirror_unless_it_is_known_not_to_be(entry: Entry) -> None:
    s = random_snapshot(500)
    there, here = once(entry, mirrored(s)), once(entry, s)
    same = torch.allclose(there, here, rtol=1e-5, atol=5e-6)
    assert same == (entry.name not in ONE_SIDED)


@pytest.mark.parametrize("name", ["foot_clock", "foot_clock_ahead", "load_clock"])
def test_a_reward_of_the_gait_clock_is_the_same_in_the_mirror_half_a_turn_later(name: str) -> None:
    s, entry = random_snapshot(500), members("reward")[name]
    image = replace(mirrored(s), episode_time=s.episode_time + 0.2)  # of 2.5 turns a second
    torch.testing.assert_close(once(entry, image), once(entry, s), rtol=0.0, atol=1e-4)


@each("reward")
def test_a_penalty_or_reward_is_not_negative_unless_it_is_signed(entry: Entry) -> None:
    signed = {"feet_air_time", "feet_air_time_touchdown", "feet_air_time_literal", "joint_deviation_literal"}
    signed |= {"foot_clock", "foot_clock_ahead", "load_clock"}
    if entry.name not in signed | {"air_time_variance_literal"}:
        assert once(entry, random_snapshot(500)).min() >= 0.0


@each("termination")
def test_a_termination_ends_some_episodes_and_a_standing_robot_goes_on(entry: Entry) -> None:
    s = random_snapshot(ODD)
    flag = entry.target(s)
    assert flag.any()
    assert not flag.all()
    upright = {f.name: getattr(s, f.name) for f in fields(Snapshot)}
    upright["projected_gravity_b"] = torch.tensor([0.0, 0.0, -1.0]).repeat(ODD, 1)
    upright["trunk_contact"] = torch.zeros(ODD, dtype=torch.bool)
    assert not entry.target(Snapshot(**upright)).any()


def test_tilt_ends_an_episode_past_its_angle_whichever_way_the_robot_leans() -> None:
    tilt = members("termination")["tilt"].target
    values = {f.name: getattr(random_snapshot(2), f.name) for f in fields(Snapshot)}
    for axis in ([1, 0, 0], [0, 1, 0], [0.6, -0.8, 0]):
        for limit in (0.5, 1.2, 2.0):
            turns = Rotation.from_rotvec(np.outer([limit - 0.01, limit + 0.01], axis))
            gravity = torch.as_tensor(turns.inv().apply([0.0, 0.0, -1.0])).float()
            assert tilt(Snapshot(**{**values, "projected_gravity_b": gravity}), max_angle=limit).tolist() == [
                False,
                True,
            ]


# Randomisations of the model


NOTHING: dict[str, list[dict[str, Any]]] = {
    "foot_friction": [
        {"range": (0.8, 0.8), "operation": "set"},
        {"range": (1.0, 1.0), "operation": "scale"},
        {"range": (0.0, 0.0), "operation": "add"},
    ],
    "foot_restitution": [{"range": (math.exp(-2.0), math.exp(-2.0))}],
    "ground_stiffness": [{"range": (0.02, 0.02)}],
    "center_of_mass": [{"range": (0.0, 0.0)}],
    "link_mass": [{"range": (1.0, 1.0)}],
}
"""Parameters of model terms at which the robot stays the nominal one (its feet: friction 0.8, critically damped)."""


@each("rand", kind="model")
def test_a_model_term_with_a_range_of_one_nominal_value_changes_nothing(
    entry: Entry,
) -> None:
    for parameters in NOTHING[entry.name]:
        robots = nominal(3)
        before = with_fields(robots, entry)
        entry.target(robots, stream(3), everyone(3), **parameters)
        for name, values in model_fields(robots).items():
            # A value that is set is a float32 draw, or looked up; one that is scaled or shifted must not move at all.
            rtol = {"foot_friction": 1e-7, "foot_restitution": 1e-4, "ground_stiffness": 1e-7}.get(entry.name, 0.0)
            rtol = 0.0 if parameters.get("operation") in ("scale", "add") else rtol
            np.testing.assert_allclose(values, before[name], rtol=rtol, atol=0, err_msg=f"{name} {parameters}")


@each("rand", kind="model")
def test_a_model_term_that_writes_what_mujoco_derives_from_says_so(entry: Entry) -> None:
    inputs = set(mujoco.MjModel._setconst_inputs)
    assert bool(entry.traits.get("derived")) == bool(inputs & set(entry.traits["fields"]))


def named(model: mujoco.MjModel, kind: str, names: list[str]) -> list[int]:
    return [getattr(model, kind)(name).id for name in names]


FEET = [f"{leg}_foot" for leg in robot.LEGS]
LINKS = ["trunk", *robot.JOINTS]


def test_foot_friction_is_drawn_per_foot_and_nothing_else_slides() -> None:
    robots = nominal(200)
    members("rand")["foot_friction"].target(robots, stream(200), everyone(200))
    friction = robots.field("geom_friction").numpy()
    geoms = named(robots.model, "geom", FEET)
    feet = friction[:, geoms, 0]
    assert feet.min() >= 0.4
    assert feet.max() <= 1.1
    assert feet.mean() == pytest.approx(0.75, abs=0.02)
    assert feet.std() == pytest.approx(0.7 / math.sqrt(12), abs=0.02)
    assert np.abs(np.corrcoef(feet.T) - np.eye(4)).max() < 0.25
    others = np.ones_like(robots.model.geom_friction, dtype=bool)
    others[geoms, 0] = False
    assert (friction == robots.model.geom_friction)[:, others].all()


@pytest.mark.parametrize(("operation", "expected"), [("set", 0.5), ("scale", 0.4), ("add", 1.3)])
def test_the_operation_of_foot_friction_says_what_a_draw_of_one_half_means(operation: str, expected: float) -> None:
    robots = nominal(1)
    term = members("rand")["foot_friction"].target
    term(robots, stream(1), everyone(1), range=(0.5, 0.5), operation=operation)
    values = robots.field("geom_friction")[0, named(robots.model, "geom", FEET), 0]
    assert values.tolist() == pytest.approx([expected] * 4)  # of a nominal 0.8


def test_link_mass_scales_mass_and_inertia_of_a_link_alike() -> None:
    robots = nominal(200)
    members("rand")["link_mass"].target(robots, stream(200), everyone(200))
    bodies = named(robots.model, "body", LINKS)
    assert sorted(bodies) == list(range(1, robots.model.nbody))
    ratio = robots.field("body_mass").numpy()[:, bodies] / robots.model.body_mass[bodies]
    assert ratio.min() >= 0.8
    assert ratio.max() <= 1.3
    assert ratio.mean() == pytest.approx(1.05, abs=0.01)
    assert np.abs(np.corrcoef(ratio.T) - np.eye(13)).max() < 0.3
    inertia = robots.field("body_inertia").numpy()[:, bodies] / robots.model.body_inertia[bodies]
    np.testing.assert_allclose(inertia, np.repeat(ratio[:, :, None], 3, axis=2), rtol=1e-12)


def test_center_of_mass_moves_the_trunk_s_alone() -> None:
    robots = nominal(200)
    members("rand")["center_of_mass"].target(robots, stream(200), everyone(200))
    shift = robots.field("body_ipos").numpy() - robots.model.body_ipos
    trunk = robots.model.body("trunk").id
    assert np.abs(shift[:, trunk]).max() <= 0.025 + 1e-9
    assert np.abs(shift[:, trunk]).min(axis=0).max() < 0.005  # every axis has small and large shifts of its own
    assert np.abs(np.corrcoef(shift[:, trunk].T) - np.eye(3)).max() < 0.25
    assert not np.delete(shift, trunk, axis=1).any()


def bounce(solref: np.ndarray) -> float:
    """Speed after over speed before of a free ball that meets a plane with these contact parameters."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 0.0005, [0.0, 0.0, 0.0]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
    ball = spec.worldbody.add_body(pos=[0, 0, 0.05])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.023, 0, 0], mass=3.0, priority=1, solref=solref)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[2] = -0.5
    mujoco.mj_step(model, data, 600)
    assert data.qvel[2] > 0.0
    return float(data.qvel[2]) / 0.5


@pytest.mark.parametrize("restitution", [0.05, 0.15, 0.3, 0.6])
def test_a_free_mass_bounces_with_the_restitution_it_was_given(restitution: float) -> None:
    robots = nominal(1)
    term = members("rand")["foot_restitution"].target
    term(robots, stream(1), everyone(1), range=(restitution, restitution))
    foot = robots.field("geom_solref")[0, robots.model.geom("FR_foot").id].numpy()
    assert bounce(foot) == pytest.approx(restitution, abs=0.03)


# Randomisations of the initial state


WRITES = {
    "body_velocity": {"base_lin_vel_w", "base_ang_vel_b"},
    "body_position": {"base_pos_w"},
    "body_orientation": {"base_quat_w"},
    "joint_positions": {"joint_pos"},
    "joint_velocities": {"joint_vel"},
}


@each("rand", kind="state")
def test_a_state_term_changes_its_own_part_of_the_state_in_every_row(entry: Entry) -> None:
    state = start_states(6)
    before = parts(state)
    entry.target(state, stream(6))
    for name, values in parts(state).items():
        changed = (values != before[name]).any(1)
        assert changed.all() if name in WRITES[entry.name] else not changed.any(), name


def test_state_terms_add_uniform_draws_of_table_i() -> None:
    state, n = start_states(2000), 2000
    for name in ("body_velocity", "body_position", "joint_velocities"):
        members("rand")[name].target(state, stream(n))
    for values, half, columns in [
        (state.base_lin_vel_w, 0.25, 3),
        (state.base_ang_vel_b, 0.25, 3),
        (state.base_pos_w[:, :2], 0.5, 2),
        (state.joint_vel, 2.5, 12),
    ]:
        assert values.shape == (n, columns)
        assert values.abs().max() <= half
        assert values.abs().max() > 0.98 * half
        assert (values.mean(0).abs() < 0.06 * half).all()
        assert (np.abs(np.corrcoef(values.numpy().T) - np.eye(columns)) < 0.1).all()
    assert (state.base_pos_w[:, 2] == 0.33).all()
    velocities = torch.cat((state.base_lin_vel_w, state.base_ang_vel_b), 1).numpy()
    assert (np.abs(np.corrcoef(velocities.T) - np.eye(6)) < 0.1).all()  # turning is drawn by itself


def test_joint_positions_scale_or_shift_the_stance_and_stop_at_the_hard_limits() -> None:
    term, n = members("rand")["joint_positions"].target, 500
    nominal = torch.as_tensor(robot.NOMINAL_STANCE)
    scaled, shifted, wild = start_states(n), start_states(n), start_states(n)
    term(scaled, stream(n))
    factor = scaled.joint_pos / nominal
    inside = (scaled.joint_pos > -2.818) & (scaled.joint_pos < -0.888) | (nominal > -1.0)
    assert factor[inside].min() >= 0.7 - 1e-6
    assert factor[inside].max() <= 1.3 + 1e-6
    assert factor[inside].min() < 0.71
    assert factor[inside].max() > 1.29
    term(shifted, stream(n), operation="add")
    assert 0.29 < (shifted.joint_pos - nominal).abs().max() <= 0.3 + 1e-6
    term(wild, stream(n), range=(-9.0, 9.0), operation="add")
    low, high = torch.as_tensor(robot.JOINT_POS_LIMITS).unbind(1)
    assert ((wild.joint_pos >= low) & (wild.joint_pos <= high)).all()
    assert (wild.joint_pos == low).any(0).all()
    assert (wild.joint_pos == high).any(0).all()


def test_body_orientation_turns_the_trunk_by_the_rotation_vector_that_is_drawn() -> None:
    n = 50
    for low, high in [(-0.02, 0.02), (-1.0, 1.0)]:
        state = start_states(n)
        tilted = Rotation.random(n, random_state=0)
        state.base_quat_w.copy_(torch.as_tensor(tilted.as_quat(scalar_first=True)))
        members("rand")["body_orientation"].target(state, stream(n), range=(low, high))
        drawn = stream(n).uniform(3, low=low, high=high).double().numpy()
        expected = Rotation.from_rotvec(drawn) * tilted
        got = Rotation.from_quat(state.base_quat_w.numpy(), scalar_first=True)
        assert (expected.inv() * got).magnitude().max() < 1e-6
        np.testing.assert_allclose(state.base_quat_w.norm(dim=1), 1.0, atol=1e-6)


# Commands

DT = 0.02


def test_uniform_velocities_fill_their_ranges_and_a_tenth_stand_still() -> None:
    n = 5000
    command = members("command")["uniform_velocity"].target(stream(n))
    command.advance(DT, everyone(n))
    standing = (command.value == 0.0).all(1)
    assert standing.float().mean() == pytest.approx(0.1, abs=0.015)
    moving = command.value[~standing]
    assert (moving != 0.0).all()
    bounds = torch.tensor([[-2.0, 3.0], [-1.5, 1.5], [-1.5, 1.5]])  # paper, section II-B.1
    assert (moving >= bounds[:, 0]).all()
    assert (moving <= bounds[:, 1]).all()
    np.testing.assert_allclose(moving.mean(0), bounds.mean(1), atol=0.06)
    np.testing.assert_allclose(moving.std(0), (bounds[:, 1] - bounds[:, 0]) / math.sqrt(12), rtol=0.03)
    assert (np.abs(np.corrcoef(moving.numpy().T) - np.eye(3)) < 0.05).all()
    assert command.time_left.min() >= 0.3
    assert command.time_left.max() <= 10.0


def test_slow_commands_and_commands_along_one_axis_have_their_shares() -> None:
    n = 20_000
    command = members("command")["uniform_velocity"].target(
        stream(n), standing_fraction=0.0, slow_fraction=0.25, zero_fraction=0.1
    )
    command.advance(DT, everyone(n))
    fifth = torch.tensor([[-0.4, 0.6], [-0.3, 0.3], [-0.3, 0.3]])
    slow = ((command.value >= fifth[:, 0]) & (command.value <= fifth[:, 1])).all(1)
    assert slow.float().mean() == pytest.approx(0.25 + 0.75 * (0.1 + 0.9 * 0.2) ** 3, abs=0.015)
    np.testing.assert_allclose((command.value == 0.0).float().mean(0), [0.1, 0.1, 0.1], atol=0.01)


def test_uniform_velocities_are_held_for_a_time_within_the_range_and_change_for_one_robot_at_a_time() -> None:
    n, steps, hold = 40, 300, (0.3, 1.0)
    command = members("command")["uniform_velocity"].target(stream(n), hold_time=hold, standing_fraction=0.0)
    command.advance(DT, everyone(n))
    seen, changes = command.value.clone(), [[0] for _ in range(n)]
    for k in range(1, steps):
        command.advance(DT, ~everyone(n))
        for i in (command.value != seen).any(1).nonzero().flatten().tolist():
            assert (command.value[i] != seen[i]).all()
            changes[i].append(k)
        seen = command.value.clone()
    times = np.concatenate([np.diff(c) for c in changes]) * DT
    assert len(times) > 5 * n
    assert times.min() >= hold[0] - 1e-6
    assert times.max() <= hold[1] + DT + 1e-6  # rounded up to a step
    assert times.mean() == pytest.approx(0.65 + DT / 2, abs=0.03)


def test_a_restart_draws_a_new_velocity_and_a_new_time_for_the_restarted_only() -> None:
    command = members("command")["uniform_velocity"].target(stream(8), hold_time=(5.0, 10.0), standing_fraction=0.0)
    command.advance(DT, everyone(8))
    value, left, mask = command.value.clone(), command.time_left.clone(), torch.arange(8) % 2 == 0
    command.advance(DT, mask)
    assert ((command.value != value).all(1) == mask).all()
    np.testing.assert_allclose(command.time_left[~mask], left[~mask] - DT, atol=1e-6)
    assert (command.time_left[mask] >= 5.0).all()
    assert (command.time_left[mask] != left[mask] - DT).all()


def test_a_hold_time_of_a_whole_number_of_steps_is_that_number_of_steps() -> None:
    for steps in (1, 5, 15, 50):
        command = members("command")["uniform_velocity"].target(
            stream(3), hold_time=(steps * DT, steps * DT), standing_fraction=0.0
        )
        command.advance(DT, everyone(3))
        for _ in range(4):
            before = command.value.clone()
            for _ in range(steps - 1):
                command.advance(DT, ~everyone(3))
                assert torch.equal(command.value, before)
            command.advance(DT, ~everyone(3))
            assert (command.value != before).all()


def test_a_fixed_velocity_stays_and_takes_a_row_for_each_robot() -> None:
    command = members("command")["fixed_velocity"].target(stream(3), lin_vel_x=1.0, lin_vel_y=-0.5, ang_vel_z=0.25)
    assert command.value.tolist() == [[1.0, -0.5, 0.25]] * 3
    command.value[1] = torch.tensor([0.0, 0.0, 1.0])
    command.advance(DT, everyone(3))
    assert command.value.tolist() == [[1.0, -0.5, 0.25], [0.0, 0.0, 1.0], [1.0, -0.5, 0.25]]


# Events


def test_a_push_sets_the_horizontal_velocity_every_ten_to_fifteen_seconds() -> None:
    n, dt = 30, 0.1
    push, state = members("event")["push"].target(stream(n)), start_states(n)
    push.advance(state, dt, everyone(n))
    times: list[list[float]] = [[0.0] for _ in range(n)]
    for k in range(1, 600):
        state.base_lin_vel_w[:] = 5.0
        before = parts(state)
        push.advance(state, dt, ~everyone(n))
        pushed = (state.base_lin_vel_w[:, :2] != 5.0).all(1)
        assert torch.equal(pushed, (state.base_lin_vel_w != 5.0).any(1))
        assert (state.base_lin_vel_w[pushed, :2].abs() <= 1.0).all()  # set, whatever it was before
        for name, values in parts(state).items():
            if name != "base_lin_vel_w":
                assert torch.equal(values, before[name])
        assert (state.base_lin_vel_w[:, 2] == 5.0).all()
        for i in pushed.nonzero().flatten().tolist():
            times[i].append(k * dt)
    waits = np.concatenate([np.diff(t) for t in times])
    assert len(waits) > 3 * n
    assert waits.min() >= 10.0 - 1e-4
    assert waits.max() <= 15.0 + dt + 1e-4
    assert waits.mean() == pytest.approx(12.5 + dt / 2, abs=0.3)


def test_a_wait_for_a_push_goes_on_in_the_next_episode_and_no_push_meets_its_first_step() -> None:
    push, state = members("event")["push"].target(stream(3), interval=(1.0, 1.0)), start_states(3)
    push.advance(state, 0.1, everyone(3))
    for k in range(1, 20):
        push.advance(state, 0.1, torch.tensor([False, k == 5, k == 10]))
        pushed = (state.base_lin_vel_w[:, :2] != 0.0).all(1).tolist()
        assert pushed == [k >= 10, k >= 10, False]
    push.advance(state, 0.1, ~everyone(3))
    assert (state.base_lin_vel_w[:, :2] != 0.0).all()
