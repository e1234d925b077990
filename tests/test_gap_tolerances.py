"""Tolerances are data: of the robot, given by a user, written down with what was found; a new effect is a file."""

from __future__ import annotations

import ast
import importlib.util
import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.base.paths import data_root
from go1exp.base.report.table import Cell
from go1exp.cli.app import App
from go1exp.cli.gap import APP
from go1exp.cli.hydra_main import choices_from_files
from go1exp.config.compose import compose
from go1exp.config.schema import registry
from go1exp.config.schema.registry import ConfigError, members
from go1exp.gap import files
from go1exp.gap.answer import not_excited, why_withdrawn
from go1exp.gap.report import tables, text, words, write_report
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.description import parse_model
from go1exp.gap.robots.fixed_base import robot_of
from go1exp.gap.robots.go1 import StandingGo1, SuspendedGo1, suspended
from go1exp.gap.score.linear import Layout
from go1exp.gap.search import candidates, tolerances
from go1exp.gap.search.screen import Motion, free_shapes, library
from go1exp.gap.stages.apply import prove, write
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import Recording
from go1exp.robot import JOINTS
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import DECLARED, Tolerances, declared, problems, sizes
from go1exp.sim.task import parse_parts
from tests.laboratory import recorded

ADDED = ("armature", "added")
JOINT = "FR_calf"


def robot_given(*overrides: str) -> Any:
    """Return the robot of a command line of ``go1exp gap``."""
    container = compose("gap", choices_from_files(["logs=x", *overrides], "gap"))
    parts, problems = parse_parts(container, ("robot",))
    assert problems == []
    return robot_of(parse_model(container["model"]), parts["robot"])


def answer(**changes: Any) -> GapResult:
    """Return a made-up answer that names 0.004 kg m2 of rotor inertia."""
    named = NamedEffect(
        "armature", (JOINT,), {"added": {JOINT: 0.004}}, {"added": {JOINT: (0.003, 0.005)}}, ("armature",), "certified"
    )
    usual: dict[str, Any] = {"named": (named,), "box": {"armature": {"added": {"FR_hip": 0.0006}}}}
    return GapResult("explained", "The model is missing rotor inertia.", **{**usual, **changes})


# ---------------------------------------------------------------------- what counts


@pytest.mark.parametrize(
    ("interval", "marginal", "withdrawn"),
    [
        ({JOINT: (0.003, 0.005)}, True, False),  # a tolerance of rotor inertia is 0.001 kg m2
        ({JOINT: (0.0008, 0.003)}, True, True),
        ({JOINT: (0.0008, 0.003), "FR_hip": (-0.004, -0.002)}, True, False),
        ({JOINT: (0.0008, 0.003)}, False, False),
    ],
)
def test_where_the_tolerances_suffice_an_interval_must_lie_beyond_them(
    interval: dict[str, tuple[float, float]], marginal: bool, withdrawn: bool
) -> None:
    assert DECLARED.param(ADDED).tolerance == 0.001
    (named,) = answer().named
    search: Any = SimpleNamespace(marginal=marginal, settings=GapSettings(), state=SimpleNamespace(tolerances=DECLARED))
    why = why_withdrawn(search, [replace(named, interval={"added": interval})], first=0.05)
    assert bool(why) == withdrawn


def test_what_no_robot_replaces_is_as_declared() -> None:
    for effect in members("effect"):
        for key in sizes(effect):
            assert DECLARED.param(key) == declared(key)
    assert Tolerances.from_effects(DECLARED.by_effect()).by_effect() == DECLARED.by_effect()
    changed = Tolerances.from_effects({"armature": {"added": 0.003}})
    assert changed.param(ADDED) == replace(declared(ADDED), tolerance=0.003)
    assert changed.param(("coulomb", "bound")) == declared(("coulomb", "bound"))
    assert changed.by_effect()["armature"] == {"added": 0.003}


@pytest.mark.parametrize(
    ("overrides", "key", "tolerance"),
    [
        (["model.tolerances.coulomb.bound=0.2"], ("coulomb", "bound"), 0.2),
        (["+model.tolerances.coulomb={bound: 0.2}"], ("coulomb", "bound"), 0.2),
        (["model.tolerances={coulomb: {bound: 0.2}}"], ("coulomb", "bound"), 0.2),
        (["model=go2"], ADDED, 0.003),
        (["model=go2", "model.tolerances.armature.added=0.002"], ADDED, 0.002),
        (["model=go2", "model.tolerances.coulomb.bound=0.2"], ("coulomb", "bound"), 0.2),
        (["model=go2", "model.tolerances.coulomb.bound=0.2"], ADDED, 0.003),
    ],
)
def test_a_user_gives_tolerances_on_the_command_line(
    overrides: list[str], key: tuple[str, str], tolerance: float
) -> None:
    robot = robot_given(*overrides)
    assert robot.tolerances.param(key).tolerance == tolerance
    may = tolerances.Freedom(robot.tolerances)
    assert may.reach(key, 0) == tolerance
    assert may.also(key[0]).reach(key, 0) == math.inf
    theta = {key: robot.tolerances.param(key).null + 2.0 * tolerance * np.ones(1)}
    assert candidates.size(key[0], theta, robot.tolerances) == pytest.approx(2.0)


def test_a_user_gives_tolerances_of_the_go1_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "known_worse.yaml"
    file.write_text("mjcf: null\ntolerances:\n  armature: {added: 0.004}\n")
    robot = robot_given(f"model={file}")
    assert robot.tolerances.replaced == {ADDED: 0.004}
    assert robot == replace(robot_given(), tolerances=robot.tolerances)


def test_a_robot_on_its_feet_keeps_its_tolerances() -> None:
    (log, *_) = recorded(["seconds=1.0", "excitation=[squat]"])[1]
    robot = robot_given("model.tolerances.payload.mass=0.5").suited([log])
    assert robot.base_probe
    assert robot.tolerances.param(("payload", "mass")).tolerance == 0.5


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("colomb.bound=0.2", "colomb: unknown effect 'colomb'; did you mean 'coulomb'"),
        ("coulomb.bund=0.2", "coulomb.bund: unknown parameter 'bund'; did you mean 'bound'"),
        ("stribeck.speed=0.2", "stribeck.speed: is a shape, which has no tolerance"),
        ("coulomb.bound=-1", "coulomb.bound = -1: input should be greater than 0"),
        ("coulomb=0.2", "coulomb = 0.2: input should be an object"),
    ],
)
def test_a_wrong_tolerance_is_refused_in_one_line(override: str, line: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"model.tolerances.{line}")):
        App("gap", APP.task).run(["logs=x", f"model.tolerances.{override}"])


# ---------------------------------------------------------------------- what is written down


@pytest.mark.parametrize(("given", "shown"), [({}, "4"), ({"armature": {"added": 0.003}}, "1.3")])
def test_the_report_counts_in_the_tolerances_of_the_search(
    tmp_path: Path, given: dict[str, dict[str, float]], shown: str
) -> None:
    files.save(answer(tolerances=given), tmp_path)
    result = files.load(tmp_path)
    (row,) = tables.values(result).rows
    assert Cell(shown, look="number") in row
    page = next(f for f in write_report(result, tmp_path) if f.suffix == ".html").read_text()
    label = {"4": "armature added (± 0.001 kg m2)", "1.3": "armature added (± 0.003 kg m2)"}[shown]
    assert label in page
    assert text(result)


def test_a_result_of_an_older_version_has_the_declared_tolerances(tmp_path: Path) -> None:
    file = files.save(answer(), tmp_path)
    content = json.loads(file.read_text())
    assert content.pop("tolerances") == {}
    file.write_text(json.dumps(content))
    (row,) = tables.values(files.load(tmp_path)).rows
    assert Cell("4", look="number") in row


def test_a_calibration_leaves_out_what_is_next_to_nothing_in_the_tolerances_of_the_search(tmp_path: Path) -> None:
    box = {"armature": {"added": {"FR_hip": 1e-5}}}
    assert (tmp_path / "calibration.yaml") in write(answer(box=box), tmp_path)
    wide = answer(box=box, tolerances={"armature": {"added": 0.05}})
    assert (tmp_path / "calibration.yaml") not in write(wide, tmp_path)


def test_a_proof_refuses_other_tolerances_than_those_of_the_search() -> None:
    found = answer(tolerances=DECLARED.by_effect())
    logs: list[Recording] = []
    with pytest.raises(files.GapFileError, match=r"model.tolerances.coulomb.bound = 0.2: not as in the search .*0.05"):
        prove(logs, robot_given("model.tolerances.coulomb.bound=0.2"), GapSettings(), found, {}, 0.002)


# ---------------------------------------------------------------------- what is found

FEW: dict[str, int] = {"shortlist": 2, "iterations": 2, "max_terms": 1, "bootstraps": 0, "overlays": 0}
QUICK = GapSettings(stride_s=0.4, window_s=0.2, effects=("coulomb", "viscous"), **FEW)  # type: ignore[arg-type]


def test_friction_that_is_within_the_users_tolerance_is_no_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    few = ("armature", "coulomb", "viscous")  # a replay has 10 variants then, and not 36
    monkeypatch.setattr(tolerances, "nominal", lambda robot: few)
    rig, logs = recorded(
        ["physics_dt=0.0005", "seconds=3.0", "excitation=[chirp]", "gains=[[20,0.5],[35,0.6],[35,1.2]]"],
        {"coulomb": {"bound": {"calf": 0.3}}},
    )
    worse_known = suspended(rig.robot, Tolerances.from_effects({"coulomb": {"bound": 0.5}}))
    result = explain(logs, worse_known, QUICK)
    assert result.verdict == "no gap"
    assert result.tolerances["coulomb"] == {"bound": 0.5}
    assert result.tolerances["armature"] == DECLARED.by_effect()["armature"]
    for joint in (j for j in JOINTS if j.endswith("calf")):
        assert result.box["coulomb"]["bound"][joint] == pytest.approx(0.3, abs=0.05)


def test_a_tolerance_is_searched_as_far_as_it_reaches_or_refused() -> None:
    wide = {"kp_scale": {"scale": 1.5}, "kd_scale": {"scale": 1.5}, "armature": {"added": 0.01}}
    assert problems(wide, "tolerances") == []
    for (effect, name), tolerance in Tolerances.from_effects(wide).replaced.items():
        assert declared((effect, name)).high >= declared((effect, name)).null + tolerance
    (line,) = problems({"armature": {"added": 0.2}}, "tolerances")
    assert line == "tolerances.armature.added = 0.2: is wider than what is searched, -0.01 to 0.05 kg m2; at most 0.05"


# ---------------------------------------------------------------------- a new effect is one file


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
    assert not_excited({"creep": 0.0})["creep"] == "slow_ramps"
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
    assert not_excited({})["creep"] == "chirp"
    variants = [v for v in library(Robots.standing, STILL) if v.effect == "creep"]
    (far,), (near,) = (v.probes for v in variants)  # 25 tolerances say nothing of what two would show
    assert far.place is near.place is None
    np.testing.assert_array_equal(far.delta, 0.5)
    np.testing.assert_allclose(near.delta, 2.0 * 0.02)


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
