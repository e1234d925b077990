"""The contact of the feet in the model of ``go1exp gap``: that which recordings name, or which is chosen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp import robot
from go1exp.base.report.table import Cell
from go1exp.cli.gap import APP
from go1exp.config.compose import compose
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.config.schema.registry import ConfigError, bind
from go1exp.gap import files
from go1exp.gap.comparison import prepare
from go1exp.gap.data.prepare import contact_of, contact_warnings, tolerances_of, too_coarse
from go1exp.gap.data.windows import splits
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import null, variants
from go1exp.gap.report import tables
from go1exp.gap.result import GapResult, GapSettings, NamedEffect
from go1exp.gap.robots.description import parse_model
from go1exp.gap.robots.fixed_base import robot_of
from go1exp.gap.robots.go1 import StandingGo1, SuspendedGo1
from go1exp.gap.score.initial_state import converged
from go1exp.gap.search import single_cause, tolerances
from go1exp.gap.search.screen import Motion, library
from go1exp.gap.search.state import Search, begun
from go1exp.gap.search.stepwise import alone
from go1exp.gap.stages import apply
from go1exp.gap.stages.explain import explain
from go1exp.logs.record.simulate import policy_task
from go1exp.logs.recording import Recording, write
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.rules import actuator_problems
from go1exp.sim.effects.tolerances import DECLARED, Tolerances
from go1exp.sim.task import parse_parts, parse_task
from tests import laboratory

STIFF = ContactConfig(time_constant=0.005, cone="pyramidal", impratio=1.0)
ELLIPTIC = ContactConfig(time_constant=0.005, cone="elliptic", impratio=10.0)
KEY = ("ground_compliance", "time_constant")
QUICK = GapSettings(window_s=0.1, stride_s=0.25, physics_dt=0.001, bootstraps=20, overlays=0)


@cache
def recorded(*overrides: str) -> tuple[RobotConfig, tuple[Recording, ...]]:
    """Record a Go1 on the ground for 2 s a motion."""
    rig, recordings = laboratory.recorded(["support=ground", "gains=[[35,0.6]]", "seconds=2.0", *overrides])
    return rig.robot, recordings


def naming(contact: ContactConfig | None, base: str = "floating", name: str = "walk") -> Recording:
    """A recording, of no interest but for its metadata."""
    meta = recorded("excitation=[squat,drop]")[1][0].meta
    quat = None if base == "floating" else (1.0, 0.0, 0.0, 0.0)
    return Recording(replace(meta, contact=contact, base=base, base_quat=quat, episode=name), {})  # type: ignore[arg-type]


def feet(model: Any) -> np.ndarray:
    """Return the time constants of the feet (4,), s."""
    return np.array([model.geom(f"{leg}_foot").solref[0] for leg in robot.LEGS])


# ---------------------------------------------------------------------- what recordings name


def test_record_names_its_contact_and_one_that_is_not_chosen_is_mujocos_own() -> None:
    _, soft = recorded("excitation=[squat,drop]")
    _, chosen = recorded("excitation=[squat,drop]", "contact=soft")
    _, hard = recorded("excitation=[squat,drop]", "contact=stiff")
    assert {r.meta.contact for r in soft} == {MUJOCO_CONTACT}
    assert {r.meta.contact for r in hard} == {STIFF}
    for a, b, c in zip(soft, chosen, hard, strict=True):
        assert all(a.channels[name].tobytes() == values.tobytes() for name, values in b.channels.items())
        assert np.abs(a.joint("q") - c.joint("q")).max() > 1e-3


def test_a_policy_is_recorded_on_the_contact_of_its_training_unless_another_is_chosen() -> None:
    rig, _ = laboratory.recorded(["excitation=[chirp]", "seconds=0.5"])
    trained = parse_task(compose("train", ["contact=stiff"]))
    assert rig.contact is None
    assert policy_task(rig, trained, 1.0).contact == STIFF
    assert policy_task(replace(rig, contact=ELLIPTIC), trained, 1.0).contact == ELLIPTIC


def test_the_model_has_the_contact_that_recordings_name_or_that_is_chosen() -> None:
    config, soft = recorded("excitation=[squat,drop]")
    _, hard = recorded("excitation=[squat,drop]", "contact=stiff")
    for recordings, chosen, wanted in (
        (soft, None, MUJOCO_CONTACT),
        (hard, None, STIFF),
        (hard, MUJOCO_CONTACT, MUJOCO_CONTACT),
        ((*soft, *hard), ELLIPTIC, ELLIPTIC),
    ):
        standing = SuspendedGo1(config, contact=chosen).suited(recordings)
        assert isinstance(standing, StandingGo1)
        assert standing.tolerances.param(KEY).null == wanted.time_constant
        model = standing.build(1, 0.001, (1.0, 0.0, 0.0, 0.0), 1)[0].model
        assert (feet(model) == wanted.time_constant).all()
        assert model.opt.cone == getattr(mujoco.mjtCone, f"mjCONE_{wanted.cone.upper()}")
        assert model.opt.impratio == wanted.impratio


def test_recordings_that_name_different_contacts_are_refused_by_their_names() -> None:
    config, _ = recorded("excitation=[squat,drop]")
    mixed = [naming(STIFF, name="walk_a"), naming(STIFF, name="walk_b"), naming(MUJOCO_CONTACT, name="squat_0")]
    with pytest.raises(ConfigError) as refusal:
        explain(mixed, config, QUICK)
    text = str(refusal.value)
    assert "walk_a, walk_b: 5 ms, pyramidal, impratio 1; squat_0: 20 ms, pyramidal, impratio 1" in text
    assert "contact=stiff" in text
    assert contact_of(mixed, ELLIPTIC) == ELLIPTIC


def test_the_command_refuses_them_and_takes_a_choice(tmp_path: Path) -> None:
    _, soft = recorded("excitation=[squat,drop]")
    _, hard = recorded("excitation=[squat,drop]", "contact=stiff")
    for k, recording in enumerate((*soft, *hard)):
        first_second = {name: values[:500] for name, values in recording.channels.items()}
        write(tmp_path / f"{k}.parquet", Recording(replace(recording.meta, episode=f"e{k}"), first_second))
    words = ["stage=localise", f"logs={tmp_path}", f"out={tmp_path / 'gap'}", "search.window_s=0.1", "search.threads=1"]
    with pytest.raises(ConfigError, match=r"\(e0, e1: 20 ms, pyramidal, impratio 1; e2, e3: 5 ms"):
        APP.run(words)
    assert not (tmp_path / "gap").exists()
    assert APP.run([*words, "contact=stiff"]) == 0


def test_a_robot_that_hangs_feels_no_contact_whatever_its_recordings_name() -> None:
    config, _ = recorded("excitation=[squat,drop]")
    hung = [naming(STIFF, "fixed"), naming(MUJOCO_CONTACT, "fixed")]
    assert SuspendedGo1(config).suited(hung) == SuspendedGo1(config)
    assert contact_of([*hung, naming(STIFF)], None) == STIFF
    swinging = SuspendedGo1(config).suited([naming(STIFF), naming(MUJOCO_CONTACT)], "swing")
    assert swinging.tolerances.contact is None


def test_what_recordings_do_not_name_is_said() -> None:
    assert contact_warnings([naming(STIFF), naming(None, "fixed")], STIFF) == []
    (silent,) = contact_warnings([naming(None)], MUJOCO_CONTACT)
    assert silent.startswith("No recording names a contact of the feet; the model has 20 ms, pyramidal, impratio 1.")
    (half,) = contact_warnings([naming(STIFF), naming(None, name="old")], STIFF)
    assert half.startswith("1 recording of 2 without a contact of the feet (old)")
    (other,) = contact_warnings([naming(STIFF)], MUJOCO_CONTACT)
    assert "that was chosen, 20 ms" in other


def test_a_step_that_is_too_coarse_for_a_contact_is_said() -> None:
    assert too_coarse(None, 0.002) == too_coarse(MUJOCO_CONTACT, 0.002) == too_coarse(STIFF, 0.001) == []
    (text,) = too_coarse(STIFF, 0.002)
    assert "no contact below 8 ms; 0.00125 s would do" in text


def test_a_contact_of_a_robot_without_feet_is_refused() -> None:
    config, _ = recorded("excitation=[squat,drop]")
    with pytest.raises(ConfigError, match="contact: is of the feet of a Go1"):
        robot_of(parse_model(compose("gap", ["logs=x", "model=go2"])["model"]), config, contact=STIFF)


# ---------------------------------------------------------------------- the effect about another contact


def test_null_is_the_robots_own_time_constant() -> None:
    assert DECLARED.param(KEY).null == 0.0
    soft, hard = (Tolerances(contact=c).param(KEY) for c in (MUJOCO_CONTACT, STIFF))
    assert (soft.null, soft.low, soft.high, soft.tolerance) == (0.02, 0.004, 0.1, 0.003)  # as it always was
    assert (hard.null, hard.low, hard.high, hard.tolerance) == (0.005, 0.004, 0.1, 0.003)
    assert null("ground_compliance", Tolerances(contact=STIFF)) == {KEY: np.array([0.005])}
    assert single_cause.ladder(hard) == pytest.approx([0.005, 0.011, 0.017, 0.029, 0.053])


def test_a_hard_robot_is_probed_within_the_bounds_and_a_soft_one_as_before() -> None:
    config, soft = recorded("excitation=[squat,drop]")
    idle = Motion(*(np.zeros(12) for _ in range(4)))

    def levels(contact: ContactConfig) -> list[float]:
        machine = SuspendedGo1(config, contact=contact).suited(soft)
        ways = [v for v in library(machine, idle) if v.effect == "ground_compliance"]
        return [float(v.probes[0].delta[0]) for v in ways]

    assert levels(MUJOCO_CONTACT) == [0.01, -0.008]
    assert levels(STIFF) == pytest.approx([0.01, -0.001])
    assert levels(replace(STIFF, time_constant=0.004)) == [0.01]


def replayer_of(recordings: tuple[Recording, ...], config: RobotConfig, contact: ContactConfig | None) -> Replayer:
    machine, ready = prepare(recordings, SuspendedGo1(config, contact=contact), QUICK)
    windows = machine.windows(ready)
    return machine.replayer(windows, np.tile([1.0, 0, 0, 0], (len(windows), 1)), 512, 1)


def test_a_value_is_what_it_says_under_every_contact_and_null_is_continuous() -> None:
    config, recordings = recorded("excitation=[squat,drop]", "contact=stiff")

    def replayed(contact: ContactConfig, value: float | None) -> np.ndarray:
        replayer = models[contact]
        theta = {} if value is None else {KEY: np.array([value])}
        return replayer.run(variants(replayer.machine, theta, np.arange(len(replayer.windows)), []), 0.001)

    models = {contact: replayer_of(recordings, config, contact) for contact in (STIFF, MUJOCO_CONTACT)}

    hard, soft = replayed(STIFF, None), replayed(MUJOCO_CONTACT, None)
    assert replayed(STIFF, 0.005).tobytes() == replayed(STIFF, 0.0).tobytes() == hard.tobytes()
    assert replayed(STIFF, 0.02).tobytes() == soft.tobytes()  # the same cone: 20 ms is 20 ms
    assert replayed(MUJOCO_CONTACT, 0.02).tobytes() == soft.tobytes()
    assert np.abs(hard - soft)[:, :, :2].max() > 1e-3
    assert np.abs(replayed(STIFF, 0.005 + 1e-9) - hard)[:, :, 0].max() < 1e-4


def bound(**values: Any) -> tuple[Any, list[str]]:
    return parse_parts({"effect": {"ground_compliance": values}}, ("effect",))


def test_time_constants_that_no_step_carries_are_refused_and_0_is_none() -> None:
    assert bound(time_constant=0.035)[1] == bound(time_constant=0.0)[1] == bound(time_constant=0.02)[1] == []
    (problem,) = bound(time_constant=0.001)[1]
    assert "effect.ground_compliance.time_constant = 0.001" in problem
    assert "at least 0.004, or 0 for that of the model" in problem


def test_a_spread_needs_a_value_to_be_about() -> None:
    pd = bind("actuator", "pd", {"kp": 20.0, "kd": 0.5}, "actuator")[0]
    assert pd is not None
    (problem,) = actuator_problems(pd, bound(spread={"time_constant": 0.003})[0]["effect"], robot.JOINTS)
    assert problem.startswith("effect.ground_compliance.spread.time_constant: needs effect.ground_compliance")
    assert not actuator_problems(
        pd, bound(time_constant=0.02, spread={"time_constant": 0.003})[0]["effect"], robot.JOINTS
    )


# ---------------------------------------------------------------------- searches


def search_in(recordings: tuple[Recording, ...], config: RobotConfig, contact: ContactConfig | None) -> Search:
    """Return a search that has not begun."""
    score, _ = converged(replayer_of(recordings, config, contact), 0.001, 0.00015)
    rng = np.random.default_rng(0)
    parts = splits([r.meta for r in recordings], score.windows.episode, 0.2, rng)
    return begun(score, parts, QUICK, 0.001, rng)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_hard_floor_is_the_models_own_where_recordings_name_it_and_else_off() -> None:
    config, recordings = recorded("excitation=[squat,drop]", "contact=stiff", "seeds=[0,1]")
    own, other = (search_in(recordings, config, contact) for contact in (None, MUJOCO_CONTACT))
    assert own.state.tolerances.param(KEY).null == 0.005
    right, wrong = (np.log(s.state.held_out({})).mean() for s in (own, other))
    assert right < 0.3
    assert wrong > right + 1.0


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_no_effect_stands_for_a_hard_floor_that_is_the_models_own() -> None:
    config, recordings = recorded("excitation=[squat,drop]", "contact=stiff", "seeds=[0,1]")
    own, cause = alone(search_in(recordings, config, None))
    assert cause is None
    assert own.candidates == ()


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_payload_on_a_hard_floor_is_named_by_the_models_own_contact_alone() -> None:
    config, recordings = recorded("excitation=[squat,drop]", "contact=stiff", "seeds=[0,1]", "+effect.payload.mass=1.0")
    _, cause = alone(search_in(recordings, config, None))
    assert cause is not None
    assert cause.name == "payload"
    assert cause.theta["payload", "mass"].item() == pytest.approx(1.0, abs=0.1)
    assert alone(search_in(recordings, config, MUJOCO_CONTACT))[1] is None


# ---------------------------------------------------------------------- answers


def answer(contact: ContactConfig | None) -> GapResult:
    """A made-up answer that names a time constant of 5.5 ms, with a box."""
    named = NamedEffect(
        "ground_compliance",
        (),
        {"time_constant": {"robot": 0.017}},
        {"time_constant": {"robot": (0.016, 0.018)}},
        ("ground_compliance",),
        "certified",
    )
    return GapResult(
        "explained", "Something.", named=(named,), contact=contact, box={"payload": {"mass": {"robot": 0.1}}}
    )


def test_an_answer_keeps_its_contact_and_an_older_one_had_mujocos_own(tmp_path: Path) -> None:
    files.save(answer(STIFF), tmp_path)
    again = files.load(tmp_path)
    assert again.contact == STIFF
    assert tolerances_of(again).param(KEY).null == 0.005
    older = {k: v for k, v in again.as_dict().items() if k != "contact"}
    assert files.from_dict(older).contact is None
    assert tolerances_of(files.from_dict(older)).param(KEY).null == 0.02


def test_the_report_counts_from_the_contact_of_the_answer() -> None:
    (hard,), (soft,) = (tables.values(answer(contact)).rows for contact in (STIFF, MUJOCO_CONTACT))
    assert Cell("4", look="number") in hard  # tolerances of 3 ms from 5 ms
    assert Cell("1", look="number") in soft  # and from 20 ms
    (run,) = (table for table in tables.provenance(answer(STIFF)) if table.title == "Run")
    assert ["contact of the feet", "5 ms, pyramidal, impratio 1"] in run.rows


def test_a_box_value_at_null_is_not_written_and_the_file_says_the_contact(tmp_path: Path) -> None:
    box = {"ground_compliance": {"time_constant": {"robot": 0.005}}, "payload": {"mass": {"robot": 0.1}}}
    apply.write(replace(answer(STIFF), named=(), box=box), tmp_path)
    text = (tmp_path / files.CALIBRATION).read_text()
    assert "ground_compliance" not in text
    assert "payload" in text
    apply.write(answer(STIFF), tmp_path)
    effect = (tmp_path / files.EFFECT).read_text()
    assert "  time_constant: 0.017  # s" in effect
    assert "# contact of the feet: 5 ms, pyramidal, impratio 1; train with the same `contact`" in effect


def test_an_answer_is_proved_with_its_own_contact() -> None:
    config, _ = recorded("excitation=[squat,drop]")
    assert apply.read_as(SuspendedGo1(config), answer(STIFF)) == SuspendedGo1(config, contact=STIFF)
    assert apply.read_as(SuspendedGo1(config), answer(None)) == SuspendedGo1(config)
    with pytest.raises(files.GapFileError, match=r"contact: 20 ms.*; 5 ms.* in the search"):
        apply.read_as(SuspendedGo1(config, contact=MUJOCO_CONTACT), answer(STIFF))


def test_steps_of_probes_stay_within_the_bounds_of_a_hard_robot() -> None:
    config, soft = recorded("excitation=[squat,drop]")
    machine = SuspendedGo1(config, contact=STIFF).suited(soft)
    (probe,) = tolerances.probes(machine, [KEY], {})
    assert probe.delta == pytest.approx([0.1 * 0.003])
