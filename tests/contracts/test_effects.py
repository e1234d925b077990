"""What every effect promises, whichever it is: a new one is tested here by being registered.

The robots hang in the air or stand on the ground, below the policy (``sim/env/plant.py``), and follow large targets.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import mujoco
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.base.tensors.rotation import rotate_inverse
from go1exp.config.compose import compose
from go1exp.config.schema.joint_values import JointValues, numbers, spread
from go1exp.config.schema.physics import MUJOCO_CONTACT
from go1exp.config.schema.registry import Entry, Term, bind, members
from go1exp.extend.testing.actuators import _core, _plain, _probe, _run, kind
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import LAST, Effect, Measured, Param
from go1exp.sim.effects.rules import on_mount
from go1exp.sim.effects.stack import HOOKS
from go1exp.sim.effects.tolerances import Tolerances
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors, build_model
from go1exp.sim.task import MANY_TERMS, TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain
from tests import small_run

DT = 0.002
EFFECTS, EXCITATIONS = members("effect"), members("excitation")
each = pytest.mark.parametrize("entry", EFFECTS.values(), ids=EFFECTS.keys())

PROBES: dict[tuple[str, str], float] = {
    ("torque_speed_limit", "peak"): 0.3,
    ("torque_speed_limit", "droop"): 2.0,
    ("strength_drift", "rate"): 0.2,
}
"""Sensible values, not null, where five tolerances would not show: an effect with a threshold, one that needs time."""

BRAKES = ("asymmetric_friction", "coulomb", "load_friction", "quadratic_drag", "stribeck", "viscous")
"""Effects that may only take energy from the joints."""

FLOORS = {"q": 5e-4, "qd": 0.05, "torque": 0.1, "gravity": 2e-3, "gyro": 0.02, "acc": 0.2, "pos": 1e-3, "vel": 0.01}
"""What a good sensor tells from noise: rad, rad/s, N m, -, rad/s, m/s2; of motion capture: m, m/s."""


# ---------------------------------------------------------------------- robots to try effects on


def is_null(kind: type[Effect], values: Mapping[str, JointValues]) -> bool:
    """Return whether an effect with these settings is absent everywhere."""
    sizes = [p for p in kind.params if p.tolerance != math.inf]
    return all(v == p.null for p in sizes for v in numbers(values.get(p.name, p.null)))


@cache
def task() -> TaskConfig:
    return parse_task(compose("train", small_run.plain("backend.threads=1")))


@cache
def compiled(held: bool, mounted: bool = False) -> tuple[mujoco.MjModel, Sensors]:
    ground, attitude = build_terrain(task().terrain), (1.0, 0.0, 0.0, 0.0) if held else None
    return build_model(task().robot, ground, DT, imu=True, held=attitude, mounted=mounted)


def term(name: str, values: Mapping[str, Any]) -> Term:
    """Bind an effect as a configuration does; raise what is wrong with it."""
    bound, problems = bind("effect", name, values, f"effect.{name}", MANY_TERMS["effect"])
    assert bound, problems
    return bound


class Rig:
    """N robots on a stand, or on the ground, with effects.

    A stand gives way where an effect says so; ``mounted``: or where one may be told to later.
    """

    def __init__(
        self, n: int, effects: Sequence[Term], *, held: bool, first_env: int = 0, mounted: bool = False
    ) -> None:
        model, sensors = compiled(held, mounted or on_mount(effects))
        self.backend = MujocoCpu(model, sensors, n, 1)
        self.random = EnvRandom(3, n, first_env)
        setup = actuator_setup(task().robot, DT, self.backend, self.random)
        self.held, self.plant, self.clock = held, Plant(self.backend, setup, task().actuator, effects), 0
        self.plant.startup()
        self.stance = torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float64).repeat(n, 1)
        self.reset(torch.ones(n, dtype=torch.bool))

    def reset(self, mask: Tensor) -> None:
        qpos, qvel = torch.zeros_like(self.backend.qpos), torch.zeros_like(self.backend.qvel)
        qpos[:, -robot.NUM_JOINTS :] = self.stance
        if not self.held:
            qpos[:, 2], qpos[:, 3] = 0.31, 1.0
        self.backend.reset(mask, qpos, qvel)
        self.plant.reset(mask, self.stance)

    def step(self) -> dict[str, Tensor]:
        """Advance one step and return the truth and what the sensors say."""
        t, k = self.clock * DT, torch.arange(robot.NUM_JOINTS, dtype=torch.float64)
        swing = 0.25 * torch.sin(2.0 * math.pi * (1.5 + 0.1 * k) * t + k)
        jump = 0.6 * torch.sign(torch.sin(2.0 * math.pi * 4.0 * t + 0.8 * k)) if self.held else 0.0
        self.plant.step(self.stance + swing + jump)
        self.clock += 1
        b, blocks = self.backend, self.backend.sensors
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(len(b.qpos), 3)
        gravity = rotate_inverse(b.sensordata[:, blocks.imu_quat], down)
        gyro, acc = b.sensordata[:, blocks.imu_gyro], b.sensordata[:, blocks.imu_acc]
        seen = self.plant.effects.measure(Measured(self.plant.q, self.plant.speed(), gravity, gyro, acc))
        assert seen.gravity is not None
        assert seen.gyro is not None
        assert seen.acc is not None
        read = {"q": seen.joint_pos, "qd": seen.joint_vel, "torque": self.plant.torque}
        read |= {"gravity": seen.gravity, "gyro": seen.gyro, "acc": seen.acc}
        read |= {"true_q": self.plant.q, "true_qd": self.plant.qd}
        if not self.held:
            read |= {"pos": b.qpos[:, :3], "vel": b.qvel[:, :3]}
        return {name: value.clone() for name, value in read.items()}

    def run(self, steps: int) -> dict[str, Tensor]:
        """Advance and return every reading (steps, N, ...)."""
        readings = [self.step() for _ in range(steps)]
        return {name: torch.stack([r[name] for r in readings]) for name in readings[0]}

    def write(self, name: str, row: int, values: Mapping[str, float]) -> None:
        """Change one robot's values of an effect, as an identification does."""
        for key, value in values.items():
            getattr(self.plant.effects.effects[name], key)[row] = value

    def state_dict(self) -> dict[str, Any]:
        parts: dict[str, Any] = {"backend": self.backend, "plant": self.plant, "random": self.random}
        return {"clock": self.clock, **{key: part.state_dict() for key, part in parts.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.clock = state["clock"]
        self.backend.load_state_dict(state["backend"])
        self.plant.load_state_dict(state["plant"])
        self.random.load_state_dict(state["random"])


def same(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> list[str]:
    """Return the readings that are not equal bit for bit."""
    return [name for name in a if not torch.equal(a[name], b[name])]


def sizes(entry: Entry) -> list[Param]:
    """Return the parameters that make an effect present."""
    return [p for p in kind(entry).params if p.tolerance != math.inf]


def probe(entry: Entry, p: Param) -> float:
    """Return a sensible value that is not null: five tolerances, as far as the bounds go."""
    return PROBES.get((entry.name, p.name), _probe(p.null, p.low, p.high, 5.0 * p.tolerance))


def probes(entry: Entry) -> dict[str, float]:
    """Return such a value for every size."""
    return {p.name: probe(entry, p) for p in sizes(entry)}


def overrides(entry: Entry, hook: str) -> bool:
    return getattr(kind(entry), hook) is not getattr(Effect, hook)


def places(entry: Entry) -> tuple[bool, ...]:
    """Return where an effect can be tried: on the stand and on the ground; a held trunk feels no force."""
    return (False,) if overrides(entry, "on_base") else (True, False)


@cache
def plain(held: bool, steps: int) -> dict[str, Tensor]:
    return Rig(1, [], held=held).run(steps)


# ---------------------------------------------------------------------- description


@each
def test_an_effect_describes_its_parameters(entry: Entry) -> None:
    """Beyond what ``check_effect`` asks of every effect (tests/contracts/test_members.py)."""
    assert all(math.isfinite(x) for p in kind(entry).params for x in (p.low, p.null, p.high))
    assert len({p.name for p in kind(entry).params}) == len(kind(entry).params)
    assert set(entry.parameters) == {p.name for p in kind(entry).params}
    assert "".join(part.capitalize() for part in entry.name.split("_")) == kind(entry).__name__
    title = kind(entry).title
    assert title == title.strip(" .")
    assert 2 <= len(title.split()) <= 8


@each
def test_an_effect_says_where_it_acts(entry: Entry) -> None:
    acting = [hook for hook in (*HOOKS, "on_sensor", "edit_model") if overrides(entry, hook)]
    assert acting
    assert bool(entry.traits.get("gains")) == ("on_gains" in acting)
    assert bool(kind(entry).fields) == ("edit_model" in acting)


@each
def test_there_is_a_ready_choice_with_the_effect_in_it(entry: Entry) -> None:
    file = data_root() / f"conf/effect/{entry.name}.yaml"
    choice = OmegaConf.to_container(OmegaConf.load(file))
    assert isinstance(choice, dict)
    assert list(choice) == [entry.name]
    ready = term(entry.name, choice[entry.name])
    widths = ready.slots["spread"]
    assert not is_null(kind(entry), ready.parameters) or any(widths.get(p.name) for p in sizes(entry))
    lines = file.read_text().splitlines()
    assert lines[0].startswith("# ")
    for p in kind(entry).params:
        (line,) = (line for line in lines if line.startswith(f"  {p.name}:"))
        assert f"# {p.unit}" in line


def test_choices_of_effects_compose_alone_and_together() -> None:
    for names in (["none"], ["coulomb"], ["viscous", "lag"], list(EFFECTS)):
        choice = f"effect={names[0]}" if len(names) == 1 else f"effect=[{','.join(names)}]"
        found = parse_task(compose("train", [choice])).effect
        assert sorted(t.key for t in found) == sorted(n for n in names if n != "none")


# ---------------------------------------------------------------------- identification


def names_of(entry: Entry, shapes: bool) -> set[str]:
    """Return the names of the shape parameters, or of those that have a tolerance."""
    return {p.name for p in kind(entry).params if (p.tolerance == math.inf) == shapes}


@each
def test_a_simpler_effect_exists_and_has_fewer_numbers(entry: Entry) -> None:
    how = kind(entry).identification
    if how.simpler:
        simpler = EFFECTS[how.simpler]
        assert simpler is not entry
        assert not kind(simpler).identification.simpler
        numbers_of = [len(sizes(e)) + len(kind(e).identification.free_shapes) for e in (simpler, entry)]
        assert numbers_of[0] <= numbers_of[1]
        assert len(kind(simpler).params) <= len(kind(entry).params)


@each
def test_the_excitation_that_shows_an_effect_exists_and_stands_if_the_effect_needs_ground(entry: Entry) -> None:
    how = kind(entry).identification
    assert how.excitation in EXCITATIONS
    on_feet = EXCITATIONS[how.excitation].target.__module__ == "go1exp.logs.excitations.ground"
    assert on_feet == how.needs_ground


@each
def test_shapes_and_levels_are_parameters_within_their_bounds(entry: Entry) -> None:
    standing = Tolerances(contact=MUJOCO_CONTACT)  # on its feet: some null values are those of its contact
    how, by_name = (
        kind(entry).identification,
        {p.name: standing.param((entry.name, p.name)) for p in kind(entry).params},
    )
    assert {*how.free_shapes} <= names_of(entry, shapes=True)
    for law in how.laws:
        assert {*law} <= names_of(entry, shapes=True) - {*how.free_shapes}
        assert all(by_name[name].low <= value <= by_name[name].high for name, value in law.items())
    for shapes in how.shapes:
        assert {*shapes} <= {*how.free_shapes}, "a shape that is tried and then held fast"
        for name, value in shapes.items():
            p = by_name[name]
            assert (p.per == "joint" and p.unit == "rad") if not math.isfinite(value) else p.low <= value <= p.high
    for level in how.levels:
        assert {*level} <= names_of(entry, shapes=False)
        for name, change in level.items():
            assert change != 0.0
            assert by_name[name].low <= by_name[name].null + change <= by_name[name].high
    if how.periodic:
        assert {how.periodic.amplitude} == names_of(entry, shapes=False)
        assert {how.periodic.phase, how.periodic.count} <= names_of(entry, shapes=True)
        count = by_name[how.periodic.count]
        assert all(count.low <= value <= count.high for value in how.periodic.counts)
        assert not how.levels
        assert not how.shapes


@each
def test_a_confounded_effect_exists_and_both_say_the_same_of_how_to_tell_them_apart(entry: Entry) -> None:
    how = kind(entry).identification
    assert bool(how.confounded) == bool(how.separated_by)
    assert how.separated_by == "" or how.separated_by.startswith("record ")
    assert any(name in how.separated_by for name in EXCITATIONS) or "=[[" in how.separated_by or not how.confounded
    for name in how.confounded:
        other = kind(EFFECTS[name]).identification
        assert name != entry.name
        if entry.name in other.confounded:
            assert other.separated_by == how.separated_by


@each
def test_a_place_is_joints_of_which_all_have_one_value_or_the_robot(entry: Entry) -> None:
    how = kind(entry).identification
    if how.common or how.weighs_on_legs or how.uniform:
        assert {p.per for p in sizes(entry)} == {"joint"}
    assert how.nominal or how.rank == LAST


@each
def test_an_effect_needs_ground_if_and_only_if_a_held_robot_does_not_feel_it(entry: Entry) -> None:
    if True not in places(entry):
        assert kind(entry).identification.needs_ground
        return
    without, read = plain(True, 100), Rig(1, [term(entry.name, probes(entry))], held=True).run(100)
    ratio = max(float((read[channel] - without[channel]).abs().max()) / FLOORS[channel] for channel in ("q", "qd"))
    assert (ratio > 0.01) != kind(entry).identification.needs_ground, ratio


def test_ranks_of_nominal_effects_differ() -> None:
    ranks = [kind(e).identification.rank for e in EFFECTS.values() if kind(e).identification.nominal]
    assert len(ranks) == len({*ranks})


# ---------------------------------------------------------------------- absence


def test_all_effects_absent_together_change_no_bit() -> None:
    """One by one: ``check_effect``."""
    core = _core(tuple(term(name, {}) for name in EFFECTS), 2)
    assert [type(e) for e in core.plant.effects.effects.values()] == [e.target for e in EFFECTS.values()]
    core.reset()
    assert all(torch.equal(a, b) for a, b in zip(_plain(10), _run(core, 10), strict=True))


@pytest.mark.parametrize("name", [n for n, e in EFFECTS.items() if overrides(e, "on_gears") or overrides(e, "reset")])
def test_an_environment_that_is_reseeded_begins_as_if_it_were_new(name: str) -> None:
    """Masses are drawn anew at every reset, which has MuJoCo derive its constants again from the model as it is."""
    assert task().rand
    effects = (term(name, probes(EFFECTS[name])),)
    core = Go1Core(dataclasses.replace(task(), effect=effects), 2, seed=5)

    def begin() -> list[Tensor]:
        core.reseed(5)
        core.reset()
        actions = (4.0 * torch.sin(0.9 * k + torch.arange(24.0).reshape(2, 12)) for k in range(8))
        return [core.step(action).observation.clone() for action in actions]

    first = begin()
    assert all(torch.equal(a, b) for a, b in zip(first, begin(), strict=True))


# ---------------------------------------------------------------------- presence


@each
def test_every_size_moves_something_that_a_robot_measures(entry: Entry) -> None:
    """An identification can find no parameter that does not."""
    moved: dict[str, dict[str, float]] = {p.name: {} for p in sizes(entry)}
    for held in places(entry):
        rig = Rig(1 + len(moved), [term(entry.name, {})], held=held, mounted=kind(entry).mounts)
        for row, p in enumerate(sizes(entry), start=1):
            rig.write(entry.name, row, {p.name: probe(entry, p)})
        rig.plant.refresh()
        read = rig.run(150)
        for row, p in enumerate(sizes(entry), start=1):
            for channel, floor in FLOORS.items():
                if channel in read:
                    ratio = float((read[channel][:, row] - read[channel][:, 0]).abs().max()) / floor
                    moved[p.name][channel] = max(moved[p.name].get(channel, 0.0), ratio)
    for name, channels in moved.items():
        assert max(channels.values()) > 2.0, (name, channels)


@each
def test_robots_of_a_batch_have_their_own_values_and_move_as_alone(entry: Entry) -> None:
    """Rows: absent, probe, half a probe, all written while it runs; alone: configured."""
    values = [{p.name: p.null + share * (probe(entry, p) - p.null) for p in sizes(entry)} for share in (0.0, 1.0, 0.5)]
    for held in places(entry)[:1]:
        mounted = kind(entry).mounts
        batch = Rig(3, [term(entry.name, {})], held=held, mounted=mounted)
        for row, own in enumerate(values):
            batch.write(entry.name, row, own)
        batch.plant.refresh()
        together = batch.run(80)
        for row, own in enumerate(values):
            alone = Rig(1, [term(entry.name, own)], held=held, first_env=row, mounted=mounted).run(80)
            assert same({k: v[:, row : row + 1] for k, v in together.items()}, alone) == [], (row, held)


@each
def test_a_reset_forgets_the_robots_that_are_reset_and_no_other(entry: Entry) -> None:
    held = places(entry)[0]
    configured = [term(entry.name, probes(entry))]
    through, reset, anew = (Rig(2, configured, held=held) for _ in range(3))
    numbers = anew.random.state_dict()
    second = torch.tensor([False, True])
    fresh = anew.run(40)
    for rig in (through, reset, anew):
        if rig is not anew:
            rig.run(40)
    reset.reset(second)
    ahead, after = through.run(40), reset.run(40)
    assert same({k: v[:, :1] for k, v in ahead.items()}, {k: v[:, :1] for k, v in after.items()}) == []
    anew.reset(second)  # and from the same random numbers and targets as at the beginning
    anew.random.load_state_dict(numbers)
    anew.clock = 0
    again = anew.run(40)
    assert same({k: v[:, 1:] for k, v in fresh.items()}, {k: v[:, 1:] for k, v in again.items()}) == []


def joint_noise(n: int, scale: float, seed: int) -> Tensor:
    return scale * torch.randn(n, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def calls(effect: Effect, n: int, k: int) -> Iterator[tuple[str, tuple[Any, ...], tuple[Tensor, ...]]]:
    """Yield every hook that the effect has, with arguments for it and the tensors among them."""
    q, qd, torque = joint_noise(n, 1.0, k), joint_noise(n, 10.0, k + 1), joint_noise(n, 10.0, k + 2)
    three = [joint_noise(n, 1.0, k + j)[:, :3] for j in (3, 4, 5)]
    given: dict[str, tuple[Tensor, ...]] = {
        "on_target": (q,),
        "on_feedforward": (torque,),
        "on_encoder": (q, qd),
        "on_error": (q, three[0].repeat(1, 4)),
        "on_gains": (torque.abs(), qd.abs()),
        "on_actuator": (torque, q, qd),
        "on_report": (torque,),
        "on_transmission": (torque, q, qd),
        "on_joint": (q, qd),
        "on_friction": (torque.abs(), torque, qd),
        "on_load": (torque.abs(), torque, 3.0 * q),
        "on_base": (torch.cat([three[0], three[0]], dim=1),),
    }
    for hook, tensors in given.items():
        if getattr(type(effect), hook) is not getattr(Effect, hook):
            yield hook, tensors, tensors
    if type(effect).on_sensor is not Effect.on_sensor:
        single = tuple(x.float() for x in three)
        yield "on_sensor", (Measured(q, qd, *single),), (q, qd, *single)


def tensors_of(result: Any) -> tuple[Tensor, ...]:
    if isinstance(result, Measured):
        return tuple(
            x for x in (result.joint_pos, result.joint_vel, result.gravity, result.gyro, result.acc) if x is not None
        )
    return result if isinstance(result, tuple) else (result,)


@each
def test_hooks_leave_their_arguments_as_they_are(entry: Entry, drives: Callable[..., ActuatorSetup]) -> None:
    effect = term(entry.name, probes(entry))(drives(4))
    for k in range(5):
        for hook, arguments, tensors in calls(effect, 4, 10 * k):
            before = [x.clone() for x in tensors]
            result = tensors_of(getattr(effect, hook)(*arguments))
            assert all(torch.equal(a, b) for a, b in zip(tensors, before, strict=True)), hook
            for x in result:
                assert x.shape[0] == 4
                assert torch.isfinite(x).all()
                assert x.dtype in (torch.float64, torch.float32)


@each
def test_a_sensor_that_the_robot_lacks_stays_unmeasured(entry: Entry, drives: Callable[..., ActuatorSetup]) -> None:
    effect = term(entry.name, probes(entry))(drives(4))
    seen = effect.on_sensor(Measured(joint_noise(4, 1.0, 0), joint_noise(4, 1.0, 1)))
    assert (seen.gravity, seen.gyro, seen.acc) == (None, None, None)
    assert seen.joint_pos.shape == seen.joint_vel.shape == (4, 12)


@each
def test_reading_the_encoder_twice_gives_the_same(entry: Entry, drives: Callable[..., ActuatorSetup]) -> None:
    effect = term(entry.name, probes(entry))(drives(4))
    q, qd = joint_noise(4, 1.0, 0), joint_noise(4, 5.0, 1)
    before = effect.state_dict()
    first, second = effect.on_encoder(q, qd), effect.on_encoder(q, qd)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert all(torch.equal(before[name], value) for name, value in effect.state_dict().items())


@each
def test_spreads_are_drawn_for_each_robot_within_the_bounds(entry: Entry) -> None:
    for p in kind(entry).params:
        width = 0.7 * (p.high - p.low)  # wide enough to meet a bound
        given = {"calf": p.null} if p.per == "joint" else p.null
        configured = [term(entry.name, {p.name: given, "spread": {p.name: width}})]
        rig, alone = (Rig(n, configured, held=places(entry)[0], first_env=f) for n, f in ((12, 0), (1, 7)))
        live = getattr(rig.plant.effects.effects[entry.name], p.name)
        assert ((live >= p.low) & (live <= p.high)).all()
        assert torch.equal(live[7:8], getattr(alone.plant.effects.effects[entry.name], p.name))
        drawn = live[:, 2::3] if p.per == "joint" else live
        assert (drawn.max() - drawn.min()) > 0.5 * width
        assert (drawn.std(0) > 0.0).all()
        if p.per == "joint":
            assert (drawn.std(1) > 0.0).any()
            assert (live.reshape(12, 4, 3)[..., :2] == p.null).all()


@each
def test_values_can_differ_between_joints(entry: Entry, drives: Callable[..., ActuatorSetup]) -> None:
    for p in kind(entry).params:
        if p.per == "joint":
            mixed = {"FR": p.low, "calf": p.high, "RL_hip": 0.5 * (p.low + p.high)}
            effect = term(entry.name, {p.name: mixed})(drives(2))
            expected = torch.as_tensor(spread(mixed, robot.JOINTS)).nan_to_num(nan=p.null)
            assert torch.equal(getattr(effect, p.name), expected.repeat(2, 1))


def test_all_effects_together_leave_a_robot_that_moves() -> None:
    rig = Rig(2, [term(name, probes(entry)) for name, entry in EFFECTS.items()], held=False)
    read = rig.run(150)
    assert all(torch.isfinite(value).all() for value in read.values())
    assert float(read["true_q"].std(0).min()) > 1e-3


# ---------------------------------------------------------------------- energy


@pytest.mark.parametrize("name", BRAKES)
def test_a_brake_only_brakes(name: str, drives: Callable[..., ActuatorSetup]) -> None:
    """Power of the torque on the joint, with dry friction at its bound, is nowhere positive."""
    entry, setup = EFFECTS[name], drives(500)
    effect = term(name, {})(setup)
    if overrides(entry, "edit_model"):
        assert effect.fields == ("dof_frictionloss",)  # a bound; MuJoCo solves for the rest
        return
    generator = torch.Generator().manual_seed(0)
    for p in effect.params:
        unit = torch.rand(500, 12, dtype=torch.float64, generator=generator)
        getattr(effect, p.name).copy_(p.low + (p.high - p.low) * unit)
    q, qd, torque = joint_noise(500, 1.0, 0), joint_noise(500, 10.0, 1), joint_noise(500, 20.0, 2)
    power, none = torch.zeros_like(q), torch.zeros_like(q)
    if overrides(entry, "on_joint"):
        power += effect.on_joint(q, qd) * qd
    if overrides(entry, "on_friction"):
        bound = effect.on_friction(none, torque, qd)
        assert (bound >= 0.0).all()
        power -= bound * qd.abs()
    if overrides(entry, "on_load"):
        bound = effect.on_load(none, torque, joint_noise(500, 5.0, 3))
        assert (bound >= 0.0).all()
        power -= bound * qd.abs()
    assert (power <= 1e-12).all()
    assert (power < -1e-3).any()


@pytest.mark.parametrize("name", BRAKES)
@pytest.mark.parametrize("share", [0.05, 1.0])
def test_a_brake_takes_energy_from_a_swinging_robot(name: str, share: float) -> None:
    """Drives off, weightless, legs swung; at the largest value too the step must not feed energy in."""
    entry = EFFECTS[name]
    top = {p.name: p.null + share * (p.high - p.null) for p in sizes(entry)}
    if name == "asymmetric_friction":
        top["backward"] = 0.0  # the constant torque in full
    rig = Rig(1, [term(name, top)], held=True)
    rig.plant.set_gains(torch.zeros(1, 12), torch.zeros(1, 12))
    model = rig.backend.env_model(0)
    rig.backend.field("opt.gravity").zero_()
    qpos = rig.backend.qpos.clone()
    speed = 0.3 if name == "stribeck" else 8.0  # rad/s
    rig.backend.reset(torch.tensor([True]), qpos, speed * torch.cos(torch.arange(12.0)).double().unsqueeze(0))
    rig.plant.reset(torch.tensor([True]), rig.stance)
    energy = []
    for _ in range(40):
        rig.plant.step(rig.stance)
        data = rig.backend.env_data(0)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyVel(model, data)
        energy.append(float(data.energy[1]))
    assert all(b <= a * (1.0 + 2e-3) + 1e-6 for a, b in pairwise(energy)), energy
    if name != "load_friction":  # without a drive's torque and a weight there is none
        assert energy[-1] < 0.97 * energy[0]


def test_gears_under_the_load_of_a_weight_only_take_energy() -> None:
    """Drives off, legs swing in gravity: kinetic and potential energy fall together, at the largest values too."""
    for coefficient, external in ((0.1, 1.0), (0.5, 2.0)):
        rig = Rig(1, [term("load_friction", {"coefficient": coefficient, "external": external})], held=True)
        rig.plant.set_gains(torch.zeros(1, 12), torch.zeros(1, 12))
        rig.backend.reset(torch.tensor([True]), rig.backend.qpos.clone(), 3.0 * torch.ones(1, 12).double())
        rig.plant.reset(torch.tensor([True]), rig.stance)
        energy = []
        for _ in range(60):
            rig.plant.step(rig.stance)
            model, data = rig.backend.env_model(0), rig.backend.env_data(0)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            energy.append(float(data.energy.sum()))
        assert all(b <= a + 1e-3 * (energy[0] - min(energy)) + 1e-6 for a, b in pairwise(energy)), energy
        assert energy[-1] < energy[0] - 0.1
