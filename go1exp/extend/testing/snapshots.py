"""What a term of the MDP promises that sees a Snapshot: rewards, observations and terminations."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from go1exp import robot
from go1exp.config.schema.registry import Entry
from go1exp.extend.testing.description import ALONE, CONTINUES, MASKED, checked, equal, expect
from go1exp.mdp.ground import SCAN_COLUMNS, SCAN_ROWS
from go1exp.mdp.mirror import Mirror
from go1exp.mdp.types import Snapshot, TermSetup

ODD = 37
"""Size of a batch that no vector register divides."""

DT = 0.02


def random_snapshot(n: int, seed: int = 0) -> Snapshot:
    """Return N robots in the middle of something: every quantity of a plausible size, phases consistent."""
    rng = np.random.default_rng(seed)
    low, high = robot.JOINT_POS_LIMITS.T
    quat = Rotation.random(n, random_state=seed)
    touching = rng.random((n, 4)) < 0.5
    phase = rng.uniform(0.002, 0.4, (n, 4))
    values = {
        "base_pos_w": rng.normal(0.0, 3.0, (n, 3)),
        "base_quat_w": quat.as_quat(scalar_first=True),
        "base_lin_vel_b": rng.normal(0.0, 0.7, (n, 3)),
        "base_ang_vel_b": rng.normal(0.0, 1.0, (n, 3)),
        "projected_gravity_b": quat.inv().apply([0.0, 0.0, -1.0]),
        "joint_pos": rng.uniform(1.02 * low, 1.02 * high, (n, 12)),
        "joint_vel": rng.normal(0.0, 15.0, (n, 12)),
        "joint_acc": rng.normal(0.0, 300.0, (n, 12)),
        "joint_torque": rng.normal(0.0, 10.0, (n, 12)),
        "joint_target": rng.uniform(low, high, (n, 12)),
        "action": rng.normal(0.0, 1.0, (n, 12)),
        "previous_action": rng.normal(0.0, 1.0, (n, 12)),
        "command": rng.normal(0.0, 1.0, (n, 3)) * (rng.random((n, 1)) < 0.7),
        "foot_height": rng.uniform(0.02, 0.2, (n, 4)),
        "foot_vel_w": rng.normal(0.0, 1.0, (n, 4, 3)),
        "foot_force": touching * rng.uniform(0.0, 100.0, (n, 4)),
        "foot_contact": touching,
        "foot_air_time": ~touching * phase,
        "foot_contact_time": touching * phase,
        "foot_last_air_time": rng.uniform(0.0, 0.7, (n, 4)),
        "foot_last_contact_time": rng.uniform(0.0, 0.7, (n, 4)),
        "foot_touchdown": touching & (phase < 0.02),
        "foot_peak_force": touching * rng.uniform(100.0, 300.0, (n, 4)),
        "foot_touchdown_speed": rng.uniform(0.0, 2.0, (n, 4)),
        "thigh_contact": rng.random((n, 4)) < 0.3,
        "calf_contact": rng.random((n, 4)) < 0.3,
        "trunk_contact": rng.random(n) < 0.3,
        "episode_time": rng.uniform(0.0, 20.0, n),
        "height_scan": rng.uniform(-0.6, 0.0, (n, SCAN_ROWS * SCAN_COLUMNS)),
        "foot_rise": rng.uniform(-0.1, 0.2, (n, 4)).clip(min=0.0),
    }
    assert values.keys() == {f.name for f in fields(Snapshot)}
    tensors = {k: torch.as_tensor(v) for k, v in values.items()}
    return Snapshot(**{k: v if v.dtype == torch.bool else v.float() for k, v in tensors.items()})


def rows(s: Snapshot, which: slice) -> Snapshot:
    """Return some robots of a Snapshot."""
    return Snapshot(**{f.name: getattr(s, f.name)[which].clone() for f in fields(Snapshot)})


def mirrored(s: Snapshot) -> Snapshot:
    """Return the same moment seen in a mirror that stands in the world's x-z plane.

    Written out quantity by quantity and not by ``mdp/mirror.py``, which is held to it.
    """
    legs, joints = list(robot.MIRROR_LEGS), list(robot.MIRROR_JOINTS)
    polar, axial = torch.tensor([1.0, -1.0, 1.0]), torch.tensor([-1.0, 1.0, -1.0])
    flips = {
        "base_pos_w": polar,
        "base_quat_w": torch.tensor([1.0, -1.0, 1.0, -1.0]),
        "base_lin_vel_b": polar,
        "base_ang_vel_b": axial,
        "projected_gravity_b": polar,
        "command": torch.tensor([1.0, -1.0, -1.0]),
    }
    new = {}
    for f in fields(Snapshot):
        value: Tensor = getattr(s, f.name)
        if f.name in flips:
            new[f.name] = value * flips[f.name]
        elif f.name in ("trunk_contact", "episode_time"):
            new[f.name] = value.clone()
        elif f.name == "height_scan":
            new[f.name] = value.unflatten(1, (SCAN_ROWS, SCAN_COLUMNS)).flip(2).flatten(1)
        elif value.shape[1] == robot.NUM_JOINTS:
            new[f.name] = value[:, joints] * torch.tensor(robot.MIRROR_JOINT_SIGNS)
        else:
            new[f.name] = value[:, legs] * polar if f.name == "foot_vel_w" else value[:, legs]
    return Snapshot(**new)


class _Made:
    def __init__(self, entry: Entry, values: dict[str, Any], n: int) -> None:
        self.n, self.values, self.target = n, values, entry.target
        self.object = entry.target(TermSetup(n, torch.device("cpu"), DT), **values) if entry.remembers else None
        self.advances = entry.group == "observation" and self.object is not None
        if self.object is not None:
            self.object.reset(torch.ones(n, dtype=torch.bool))

    def __call__(self, s: Snapshot) -> Tensor:
        if self.object is None:
            return self.target(s, **self.values)
        if self.advances:
            self.object.advance(s)
        return self.object(s).clone()

    def numbers(self) -> dict[str, Tensor]:
        """Return what it remembers."""
        assert self.object is not None
        return {k: v.clone() for k, v in self.object.state_dict().items()}


def check_reward(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """One finite float32 number per robot; a number among the parameters may be a tensor () that changes in place."""
    values = checked(entry, parameters)
    _check(entry, values, exact, (), torch.float32)
    for name, value in values.items():
        if isinstance(value, float) and name not in entry.traits.get("fixed", ()):
            _check_changing(entry, values, name)


def _check_changing(entry: Entry, values: dict[str, Any], name: str) -> None:
    """Check that a parameter written in place acts as if it had been configured (``conf/schedule``)."""
    trials = (values[name] + d for d in (0.1, -0.1, 0.01, 1.0))
    other = next((v for v in trials if not entry.check({**values, name: v}, "")[1]), None)
    if other is None:
        return
    live = torch.tensor(values[name])
    changing = _Made(entry, {**values, name: live}, ODD)
    live.fill_(other)
    configured = _Made(entry, {**values, name: other}, ODD)
    promise = f'{name} must act when it is a tensor that changes; if it cannot, say @reward(name, fixed=("{name}",))'
    for seed in range(4):
        s = random_snapshot(ODD, seed)
        expect(entry, torch.allclose(changing(s), configured(s), rtol=1e-4, atol=1e-5), promise)


def check_observation(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """As many finite float32 numbers per robot as ``size`` says."""
    expect(entry, isinstance(entry.traits.get("size"), int), "it must say how wide it is: @observation(name, size=3)")
    values = checked(entry, parameters)
    _check(entry, values, exact, (entry.traits["size"],), torch.float32)
    if "mirror" in entry.traits:
        _check_mirror(entry, values)


def _check_mirror(entry: Entry, values: dict[str, Any]) -> None:
    """Check that what a mirrored robot observes is the mirror image of what the robot observes.

    A gait clock, a term with a parameter ``rate`` (Hz), is half a turn later for the mirrored robot. The tolerance is
    that of its angle: float32 holds 50 turns to 4e-6 of one, which is 2.4e-5 rad.
    """
    mirror, size = entry.traits["mirror"], entry.traits["size"]
    expect(
        entry, isinstance(mirror, Mirror) and len(mirror.signs) == size, f"mirror must be a Mirror of {size} columns"
    )
    later = 0.5 / values["rate"] if "rate" in values else 0.0
    robots, images = _Made(entry, values, ODD), _Made(entry, values, ODD)
    for seed in range(4):
        s = random_snapshot(ODD, seed)
        image = replace(mirrored(s), episode_time=s.episode_time + later)
        same = torch.allclose(images(image), mirror(robots(s)), rtol=1e-5, atol=1e-4)
        expect(entry, same, "what a mirrored robot observes must be the image that mirror makes")


def check_termination(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """One flag per robot."""
    _check(entry, checked(entry, parameters), exact, (), torch.bool)


def _check(entry: Entry, values: dict[str, Any], exact: bool, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    moments = [random_snapshot(ODD, seed) for seed in range(4)]
    batch = _Made(entry, values, ODD)
    singles = {i: _Made(entry, values, 1) for i in (0, 17, ODD - 1)}
    part = _Made(entry, values, 8)
    for k, s in enumerate(moments):
        together = batch(s)
        expect(entry, together.shape == (ODD, *shape), f"it must be (N{''.join(f', {x}' for x in shape)})")
        expect(entry, together.dtype == dtype, f"it must be {dtype}, and is {together.dtype}")
        expect(entry, torch.isfinite(together).all(), "it must be finite")
        before = random_snapshot(ODD, k)
        same = [torch.equal(getattr(s, f.name), getattr(before, f.name)) for f in fields(Snapshot)]
        expect(entry, all(same), "it must leave the Snapshot as it is")
        for i, single in singles.items():
            expect(entry, equal(single(rows(s, slice(i, i + 1))), together[i : i + 1], exact), ALONE)
        expect(entry, equal(part(rows(s, slice(0, 8))), together[:8], exact), ALONE)
    if entry.remembers:
        _check_memory(entry, values, moments)


def _check_memory(entry: Entry, values: dict[str, Any], moments: list[Snapshot]) -> None:
    one, other, fresh = (_Made(entry, values, ODD) for _ in range(3))
    memory = one.object
    assert memory is not None
    expect(entry, one.numbers(), "a class must name its tensors in `memory`; a term without any is a function")
    held = {name: getattr(memory, name) for name in memory.memory}
    for s in moments:
        one(s)
        other(s)
    if one.advances:
        expect(entry, torch.equal(memory(moments[0]), memory(moments[0])), "to read it twice must change nothing")
    mask = torch.arange(ODD) % 3 == 0
    memory.reset(mask)
    for name, values_now in one.numbers().items():
        if len(values_now) != ODD:
            continue
        expect(entry, torch.equal(values_now[~mask], other.numbers()[name][~mask]), MASKED)
        expect(entry, torch.equal(values_now[mask], fresh.numbers()[name][mask]), "reset must forget the masked rows")
    fresh.object.load_state_dict(one.object.state_dict())  # type: ignore[union-attr]
    for s in reversed(moments):
        expect(entry, torch.equal(one(s), fresh(s)), CONTINUES)
    kept = all(getattr(memory, name) is tensor for name, tensor in held.items())
    expect(entry, kept, "it must change its tensors in place: a captured GPU graph would not see an assignment")
