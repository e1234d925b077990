"""A new effect is one file: the gap workflow considers it without a change of its own."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from go1exp.base.paths import data_root
from go1exp.config.schema import registry
from go1exp.config.schema.registry import members
from go1exp.gap import answer
from go1exp.gap.report import words
from go1exp.gap.robots.go1 import StandingGo1, SuspendedGo1
from go1exp.gap.score.linear import Layout
from go1exp.gap.search import tolerances
from go1exp.gap.search.screen import Motion, free_shapes, library
from go1exp.robot.config import RobotConfig

FILE = '''
"""``effect=creep``: a friction that nobody has thought of."""

import math

from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.base import Identification
from go1exp.config.schema.registry import effect


@effect("creep")
class Creep(Effect):
    """A torque against the motion that saturates: tau = -size tanh(qd / speed)."""

    title = "creep"
    params = (
        Param("size", "N m", 0.0, 1.0, 0.0, 0.02, "joint", "largest torque"),
        Param("speed", "rad/s", 0.1, 5.0, 1.0, math.inf, "joint", "speed of saturation"),
    )
    identification = Identification({identification})

    def on_joint(self, q, qd):
        """Return the torque."""
        return -self.size * (qd / self.speed).tanh()
'''

USUAL = """shapes=({"speed": 0.3}, {"speed": 2.0}), free_shapes=("speed",), simpler="coulomb", excitation="slow_ramps",
confounded=("coulomb",), separated_by="record slow_ramps at two gain sets" """


STILL = Motion(*np.zeros((4, 12)))


class Robots:
    """A held Go1 and one on its feet, with nothing of their configuration."""

    config: RobotConfig = None  # type: ignore[assignment]
    held = SuspendedGo1(config)
    standing = StandingGo1(config, held=held)


@pytest.fixture
def registered(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[None]:
    """Import an effect from a file outside the package; forget it afterwards."""
    file = tmp_path / "creep.py"
    file.write_text(FILE.replace("{identification}", request.param))
    spec = importlib.util.spec_from_file_location("creep", file)
    assert spec
    assert spec.loader
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    yield
    registry._REGISTRY["effect"].pop("creep")


@pytest.mark.parametrize("registered", [USUAL], indirect=True)
@pytest.mark.usefixtures("registered")
def test_a_new_effect_is_screened_fitted_and_worded_by_its_own_file() -> None:
    assert "creep" not in tolerances.nominal(Robots.held)
    variants = [v for v in library(Robots.held, STILL) if v.effect == "creep"]
    assert [v.shapes[("creep", "speed")].item() for v in variants] == [0.3, 2.0]
    for variant in variants:
        assert variant.free == (("creep", "size"), ("creep", "speed"))
        assert {p.key for p in variant.probes} == {("creep", "size")}
        assert Layout.from_probes(Robots.held, variant.probes).size == 12
        np.testing.assert_allclose(variant.probes[0].delta, 2.0 * 0.02)
    assert free_shapes("creep") == (("creep", "speed"),)
    assert answer.not_excited({"creep": 0.0})["creep"] == "slow_ramps"
    (text,) = words.advice({"coulomb": ("coulomb", "creep")})
    assert text == "These logs cannot tell coulomb from creep; record slow_ramps at two gain sets to separate them."


@pytest.mark.parametrize("registered", ["nominal=True"], indirect=True)
@pytest.mark.usefixtures("registered")
def test_a_new_effect_that_every_model_has_moves_within_its_tolerance() -> None:
    for robot in (Robots.held, Robots.standing):
        assert tolerances.nominal(robot)[-1] == "creep"
        (variant,) = [v for v in library(robot, STILL) if v.effect == "creep"]
        assert variant.probes == ()  # its columns are those of the nominal model
    theta = {("creep", "size"): np.full(12, 0.5)}
    back = tolerances.without(theta, "creep", Robots.held.tolerances)
    np.testing.assert_allclose(back["creep", "size"], 0.02)


@pytest.mark.parametrize("registered", ["needs_ground=True, common=True, levels=({'size': 0.5},)"], indirect=True)
@pytest.mark.usefixtures("registered")
def test_a_new_effect_that_needs_ground_is_left_out_where_the_trunk_is_held() -> None:
    assert all(v.effect != "creep" for v in library(Robots.held, STILL))
    assert answer.not_excited({})["creep"] == "chirp"
    (variant,) = [v for v in library(Robots.standing, STILL) if v.effect == "creep"]
    (probe,) = variant.probes
    assert probe.place is None
    np.testing.assert_array_equal(probe.delta, 0.5)


def test_the_workflow_knows_no_effect_by_its_name() -> None:
    """What it must know of one is in the effect's own file (``go1exp/sim/effects/base.py``)."""
    package = data_root() / "go1exp"
    sources = [*sorted((package / "gap").rglob("*.py")), package / "cli/gap.py"]
    assert len(sources) > 20
    known = [
        f"{file.relative_to(package)}:{node.lineno}: {node.value!r}"
        for file in sources
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Constant) and node.value in members("effect")
    ]
    assert known == []
