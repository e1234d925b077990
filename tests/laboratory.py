"""Recordings made as ``go1exp record`` makes them, for tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp.cli.app import parse
from go1exp.cli.record import RecordSettings, rig_groups
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.logs.record import plan, simulate
from go1exp.logs.recording import Recording
from go1exp.sim.task import parse_parts


def recorded(
    overrides: Sequence[str], effect: dict[str, Any] | None = None
) -> tuple[simulate.Rig, tuple[Recording, ...]]:
    """Return the robot and the recordings of ``go1exp record`` with some overrides, and effects on top if any."""
    container = compose("record", ["backend.threads=1", *overrides])
    if effect is not None:
        container["effect"] = effect
    groups = rig_groups(container)
    parts, problems = parse_parts(container, groups)
    assert problems == []
    terms = [bind("excitation", name, {}, name)[0] for name in container["excitation"]]
    settings = parse(RecordSettings, {k: v for k, v in container.items() if k not in (*groups, "excitation")})
    rig = simulate.Rig(**parts, physics_dt=settings.physics_dt)
    episodes = plan.episodes([t for t in terms if t], settings)
    return rig, tuple(simulate.play(rig, episodes, settings.sensors, settings.seed, lambda done, total: None))
