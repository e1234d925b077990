"""Recordings made as ``go1exp record`` makes them, for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

import go1exp.logs.excitations
import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
from go1exp.cli.app import parse
from go1exp.cli.record import RecordSettings, rig_groups
from go1exp.config.compose import compose
from go1exp.config.schema.registry import Term, bind_list
from go1exp.logs.record import plan, simulate
from go1exp.logs.recording import Recording
from go1exp.sim.env.plant import Plant
from go1exp.sim.task import parse_parts


def recorded(
    overrides: Sequence[str], effect: dict[str, Any] | None = None
) -> tuple[simulate.Rig, tuple[Recording, ...]]:
    """Return the robot and the recordings of ``go1exp record`` with some overrides, and effects on top if any."""
    settings, rig, terms = ordered(overrides, effect)
    episodes = plan.episodes(terms, settings)
    return rig, tuple(simulate.play(rig, episodes, settings.sensors, settings.seed, lambda done, total: None))


def ordered(
    overrides: Sequence[str], effect: dict[str, Any] | None = None
) -> tuple[RecordSettings, simulate.Rig, list[Term]]:
    """Return what ``go1exp record`` makes of some overrides: its settings, the robot and the excitations."""
    container = compose("record", ["backend.threads=1", *overrides])
    if effect is not None:
        container["effect"] = effect
    groups = rig_groups(container)
    parts, problems = parse_parts(container, groups)
    assert problems == []
    terms = bind_list("excitation", container["excitation"], "excitation")
    settings = parse(RecordSettings, {k: v for k, v in container.items() if k not in (*groups, "excitation")})
    return settings, simulate.Rig(**parts, physics_dt=settings.physics_dt), terms


def at_rest(
    robot: Any,
    effects: Mapping[str, Any],
    start: Any,
    kp: float,
    kd: float,
    dt: float,
    quat: Any = (1.0, 0.0, 0.0, 0.0),
) -> Plant:
    """Return the plant of N robots with effects, held at an attitude; their joints rest at ``start`` (N, J)."""
    backend, setup = robot.build(len(start), dt, quat, 1)
    plant = Plant(backend, setup, robot.drive(), bind_list("effect", [effects], "effect"))
    if kp or kd:
        plant.set_gains(torch.full_like(plant.q, kp), torch.full_like(plant.q, kd))
    plant.startup()
    everyone, begin = torch.ones(len(start), dtype=torch.bool), torch.as_tensor(start, dtype=plant.q.dtype)
    backend.reset(everyone, begin.clone(), torch.zeros_like(begin))
    plant.reset(everyone, begin)
    return plant
