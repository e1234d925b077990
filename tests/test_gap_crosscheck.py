"""The benchmark's robot and the library's effects, written apart, mean the same by the names of parameters.

The only place where both are seen; the benchmark itself imports nothing of the library.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import go1exp.logs.excitations
import go1exp.logs.record.motions  # noqa: F401  (registers every excitation)
from benchmarks.gap import cases
from benchmarks.gap.motions import MOTIONS, RATE
from benchmarks.gap.simulate import Episode, simulate
from benchmarks.gap.truth import Truth, apply
from go1exp.cli.app import parse
from go1exp.cli.record import RIG, RecordSettings
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.logs.excitations import Motion
from go1exp.logs.record import plan
from go1exp.logs.record.simulate import Rig, play
from go1exp.sim.task import parse_parts

QUIET = [f"sensors.{name}={{noise: 0.0, step: 0.0}}" for name in ("q", "qd", "tau_est", "gyro", "acc", "attitude")]
SIGNED = ("base_tilt", "encoder_offset", "link_com", "cogging", "parallel_stiffness")
SHAPED = (
    "asymmetric_friction",
    "torque_speed_limit",
    "command_delay",
    "load_friction",
    "armature",
    "stribeck",
    "point_load",
)


def library(names: tuple[str, ...], values: dict[str, cases.Values], episode: Episode) -> np.ndarray:
    words = ["backend.threads=1", "physics_dt=0.0005", "sensors.jitter=0.0", "sensors.dropped=0.0", *QUIET]
    container = compose("record", words)
    parts, problems = parse_parts(container, RIG)
    assert problems == []
    settings = parse(RecordSettings, {k: v for k, v in container.items() if k not in (*RIG, "excitation")})
    rig = Rig(**parts, physics_dt=settings.physics_dt)
    terms = []
    for name in names:
        plain = {k: v if isinstance(v, float) else tuple(float(x) for x in v) for k, v in values[name].items()}
        term, found = bind("effect", name, plain, name)
        assert found == []
        assert term is not None
        terms.append(term)
    motion = Motion(episode.target, episode.on, episode.target[0].copy(), "suspended")
    one = plan.Episode("e", "steps", motion, episode.kp, episode.kd, episode.hang, None, 0)
    (recording,) = play(
        dataclasses.replace(rig, effect=tuple(terms)), [one], settings.sensors, 0, lambda done, total: None
    )
    return recording.joint("q")


@pytest.mark.slow("benchmarks/", "go1exp/sim/effects/", "go1exp/logs/excitations/", "go1exp/logs/record/")
def test_both_sides_move_alike_under_the_same_effects() -> None:
    """Each group at 5 tolerances, all of it at once: what the effects change differs by some per cent between both."""
    rng, joints = np.random.default_rng(3), np.arange(12)
    target, on = MOTIONS["steps"](np.arange(400) / RATE, rng)
    episode = Episode("e", "steps", target, on, 35.0, 0.6, (0.0, 0.3))

    def mine(truth: Truth) -> np.ndarray:
        return simulate(truth, [episode], 2.5e-4, rng, np.zeros(12, dtype=bool)).q[:, 0]

    plain, theirs = mine(Truth()), library((), {}, episode)
    for group in (SIGNED, SHAPED):
        values = {name: cases.draw_values(name, 5.0, joints, rng) for name in group}
        truth = Truth()
        for name in group:
            apply(truth, name, values[name], joints)
        here, there = mine(truth) - plain, library(group, values, episode) - theirs
        change, differ = (np.sqrt(np.mean(x**2, axis=0)) for x in (here, here - there))
        assert (change > 2e-3).all()
        assert (differ < 0.1 * change).all(), dict(zip(joints, (differ / change).round(3), strict=True))
