"""What ``go1exp gap`` writes: a result comes back whole, and its effects reach training as they were named."""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp.cli.hydra_main import choices_from_files
from go1exp.config.compose import compose
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.gap import files
from go1exp.gap.result import AngleErrors, Candidate, Floors, GapResult, GapSettings, Localisation, NamedEffect, Overlay
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.stages.apply import CALIBRATION, COMPENSATING, EFFECT, composed, prove, terms_of, theta_of, write
from go1exp.gap.stages.explain import explain
from go1exp.logs.audit import audit
from go1exp.logs.record import simulate
from go1exp.logs.recording import Recording
from go1exp.robot import JOINTS
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_parts, parse_task
from tests.laboratory import recorded

NAN = math.nan
CALVES = tuple(j for j in JOINTS if j.endswith("calf"))
Status = Any


def named(effect: str, status: Status = "certified", half: float = 0.1, **params: dict[str, float]) -> NamedEffect:
    """An effect with intervals of ``half`` to both sides."""
    interval = {name: {j: (v - half, v + half) for j, v in places.items()} for name, places in params.items()}
    joints = tuple(dict.fromkeys(j for places in params.values() for j in places if j != "robot"))
    return NamedEffect(effect, joints, params, interval, (effect,), status)


FRICTION = named("coulomb", bound={j: 0.2 + 0.01 * k for k, j in enumerate(CALVES)})
STIFF = ContactConfig(time_constant=0.005, cone="pyramidal", impratio=1.0)
TILT = replace(named("base_tilt", half=0.004, roll={"robot": 0.0210049}, pitch={"robot": -0.01}), joints=())
GAIN = replace(named("kd_scale", scale={"FR_hip": 1.4}), alias_set=("kd_scale", "viscous"))


def result(*names: NamedEffect, **more: Any) -> GapResult:
    return GapResult("explained", "Something is missing.", named=names, **more)


def whole() -> GapResult:
    """A result with everything in it, and with every number that may be missing missing somewhere."""
    cells = np.array([[0.5, NAN], [3.0, 0.1]])
    where = Localisation(("a", "b"), ("slow", "fast"), np.array([[3, 0], [4, 5]]), cells, cells / 4, cells > 1)
    curves = {"q_a": np.array([0.1, NAN, 0.3])}
    return result(
        FRICTION,
        replace(TILT, interval={"roll": {"robot": (NAN, 0.03)}}),
        candidates=(
            Candidate("coulomb", CALVES, {"bound": [0.2, NAN]}, 0.3, 1.2, 2.5e-4, 8.6, ("coulomb",), "accepted", "so"),
            Candidate("cogging", (), {"count": 38.0}, NAN, NAN, NAN, NAN, ("cogging",), "not excited", "", stage=2),
        ),
        floors=Floors({"q": 1e-4, "qd": NAN}, {"q": 1e-5}, {"q": 2e-4}),
        errors=AngleErrors(12, (0.012, 0.003), 0.75, NAN, {"a": (0.01, NAN)}, {"chirp_0": (0.012, 0.003)}),
        excess={"null": 56.3, "box": 40.2, "final": 0.3, "confirm": NAN},
        before=where,
        after=replace(where, flagged=~where.flagged),
        not_excited={"payload": "squat"},
        advice=("Record steps.",),
        bootstrap_share={"coulomb": 0.9, "base_tilt": NAN},
        waterfall=(("nominal model", 56.3), ("within tolerances", NAN)),
        contact=STIFF,
        overlays=(Overlay("chirp_0", np.array([0.0, 0.002, 0.004]), curves, curves, curves, {"q_a": NAN}),),
        box={"viscous": {"damping": {"FR_hip": 0.01, "FL_hip": NAN}}},
        provenance={"seed": 7, "physics_dt": 0.001, "logs": {"chirp_0": "ab" * 32}, "versions": {"numpy": "2"}},
        warnings=("Careful.",),
        seconds=NAN,
    )


def equal(a: Any, b: Any) -> bool:
    """The same types all the way down, and the same values, NaN included."""
    if type(a) is not type(b):
        return False
    if is_dataclass(a):
        return all(equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, dict):
        return list(a) == list(b) and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype == float)
    return bool(a == b or (a != a and b != b))


# ---------------------------------------------------------------------- the file of a result


@pytest.mark.parametrize(
    "original",
    [whole(), result(), GapResult("bad log", "No.", warnings=("stuck",)), result(floors=Floors({}, {}, None))],
)
def test_a_result_comes_back_whole(original: GapResult, tmp_path: Path) -> None:
    file = files.save(original, tmp_path / "a/b")
    assert file == tmp_path / "a/b/verdict.json"
    found = files.load(tmp_path / "a/b")
    for f in fields(GapResult):
        assert equal(getattr(found, f.name), getattr(original, f.name)), f.name
    assert found.exit_code == original.exit_code
    assert "NaN" not in file.read_text()
    assert found.as_dict() == original.as_dict() == json.loads(file.read_text())


def test_a_result_that_is_missing_or_damaged_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(files.GapFileError, match=r"verdict\.json: no such file; run go1exp gap explain first"):
        files.load(tmp_path)
    file = files.save(whole(), tmp_path)
    text = file.read_text()
    plain = json.loads(text)
    damaged: list[bytes] = [b"", b"\xff\xfe", b"[]", b"3", b"{}", b"null", text[:-200].encode()]
    damaged += [json.dumps({k: v for k, v in plain.items() if k != gone}).encode() for gone in ("named", "verdict")]
    changes = {"verdict": "fine", "named": [{"effect": "coulomb"}], "floors": "low", "excess": {"null": "much"}}
    changes |= {"before": {"joints": ["a"]}, "waterfall": [["one"]], "candidates": {"a": 1}}
    changes |= {"bootstrap_share": {"a": {}, "b": "x"}}
    damaged += [json.dumps({**plain, key: value}).encode() for key, value in changes.items()]
    for content in damaged:
        file.write_bytes(content)
        with pytest.raises(files.GapFileError, match=r"verdict\.json: not a result of go1exp gap"):
            files.load(tmp_path)


def test_the_public_face_of_gap_has_every_name_that_it_promises() -> None:
    from go1exp import gap

    assert gap.explain is explain
    assert all(getattr(gap, name) is not None for name in gap.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'explian'"):
        gap.explian  # noqa: B018


def test_training_is_offered_only_where_there_is_something_to_train_with(capsys: pytest.CaptureFixture[str]) -> None:
    from go1exp.cli.gap import _print_next

    robot = suspended(parse_parts(compose("gap", ["logs=x"]), ("robot",))[0]["robot"])
    _print_next({}, robot, Path("gap/effect.yaml"))
    empty = capsys.readouterr().out
    assert "train" not in empty.replace("training", "")
    assert "nothing is certified" in empty
    _print_next({"coulomb": {"bound": 0.2}}, robot, Path("gap/effect.yaml"))
    assert capsys.readouterr().out == "now: go1exp train effect=gap/effect.yaml\n"
    for contact, choice in (
        (MUJOCO_CONTACT, ""),
        (STIFF, " contact=stiff"),
        (
            replace(STIFF, time_constant=0.008),
            " contact.time_constant=0.008 contact.cone=pyramidal contact.impratio=1.0",
        ),
    ):
        _print_next({"coulomb": {"bound": 0.2}}, robot, Path("effect.yaml"), contact)
        assert capsys.readouterr().out == f"now: go1exp train effect=effect.yaml{choice}\n"


# ---------------------------------------------------------------------- what training reads


def task(file: Path, *overrides: str) -> Any:
    """What ``go1exp train effect=FILE`` makes of a file."""
    return parse_task(compose("train", choices_from_files([f"effect={file}", *overrides], "train")))


def test_training_reads_what_was_named(tmp_path: Path) -> None:
    lean = named("viscous", "compensating", damping={"FR_hip": 0.3})
    found = result(FRICTION, TILT, GAIN, lean, box={"armature": {"added": dict.fromkeys(JOINTS, 5e-4)}})
    written = write(found, tmp_path / "new/out")
    assert [p.name for p in written] == [EFFECT, CALIBRATION, COMPENSATING]
    assert sorted((tmp_path / "new/out").iterdir()) == sorted(written)
    terms = {t.key: t for t in task(written[0]).effect}
    assert list(terms) == ["coulomb", "base_tilt", "kd_scale"]
    assert terms["coulomb"].parameters["bound"] == pytest.approx(FRICTION.params["bound"])
    assert terms["base_tilt"].parameters == pytest.approx({"roll": 0.021005, "pitch": -0.01})
    assert terms["kd_scale"].parameters["scale"] == {"FR_hip": 1.4}
    assert terms["coulomb"].slots["spread"] == {"bound": 0.1}
    assert terms["base_tilt"].slots["spread"] == {"roll": 0.004, "pitch": 0.004}
    assert terms["kd_scale"].slots["spread"] == {"scale": 0.2}  # it may be viscous: twice as wide
    assert "cannot tell it from viscous" in written[0].read_text()
    assert "viscous" not in OmegaConf.load(written[0])
    with pytest.warns(UserWarning, match="not for training"):
        (only,) = task(written[2]).effect
    assert (only.key, only.parameters["damping"]) == ("viscous", {"FR_hip": 0.3})
    (nominal,) = task(written[1]).effect
    assert (nominal.key, nominal.parameters["added"]) == ("armature", dict.fromkeys(JOINTS, 5e-4))
    assert nominal.slots["spread"] == {}
    both = parse_task(compose("train", choices_from_files([f"effect=[{written[0]},{written[1]}]"], "train")))
    assert {t.key for t in both.effect} == {*terms, "armature"}


def test_a_calibration_of_other_joints_joins_the_effect_in_training_as_in_the_proof(tmp_path: Path) -> None:
    left = {"FR_hip": 0.01, "FL_hip": 0.02}
    written = write(result(FRICTION, box={"coulomb": {"bound": left}}), tmp_path)
    contents: dict[str, Any] = {path.name: OmegaConf.to_container(OmegaConf.load(path)) for path in written}
    files = f"effect=[{tmp_path / CALIBRATION},{tmp_path / EFFECT}]"
    (trained,) = parse_task(compose("train", choices_from_files([files], "train"))).effect
    (proved,) = terms_of(composed(contents[CALIBRATION], contents[EFFECT]))
    assert trained.parameters == proved.parameters
    assert trained.parameters["bound"] == pytest.approx(left | FRICTION.params["bound"])
    assert trained.slots["spread"] == proved.slots["spread"] == {"bound": 0.1}


def test_files_of_an_earlier_answer_do_not_stay(tmp_path: Path) -> None:
    lean = named("viscous", "compensating", damping={"FR_hip": 0.3})
    write(result(lean, box={"coulomb": {"bound": {"FR_hip": 0.02}}}), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {EFFECT, CALIBRATION, COMPENSATING}
    nearly = {"coulomb": {"bound": dict.fromkeys(JOINTS, 1e-6)}}  # a thousandth of the tolerance is no news
    assert [p.name for p in write(result(FRICTION, box=nearly), tmp_path)] == [EFFECT]
    assert [p.name for p in tmp_path.iterdir()] == [EFFECT]


def test_provenance_is_in_the_file(tmp_path: Path) -> None:
    head = write(whole(), tmp_path)[0].read_text()
    for said in ("# Something is missing.", "seed 7, step 0.001 s", '"numpy": "2"', f"chirp_0: sha256 {'ab' * 32}"):
        assert said in head


@pytest.mark.parametrize("names", [(), (named("viscous", "compensating", damping={"FR_hip": 0.3}),)])
def test_an_answer_without_certified_effects_changes_nothing(names: tuple[NamedEffect, ...], tmp_path: Path) -> None:
    file = write(result(*names), tmp_path)[0]
    assert OmegaConf.load(file) == {}
    plain, given = parse_task(compose("train", ["effect=none"])), task(file)
    assert given.effect == ()
    assert given == plain
    small = ["backend.threads=1", "terrain=flat"]
    cores = [
        Go1Core(parse_task(compose("train", [*choices_from_files([choice], "train"), *small])), 2)
        for choice in ("effect=none", f"effect={file}")
    ]
    for core in cores:
        core.reset()
    for _ in range(3):
        a, b = (core.step(torch.full((2, 12), 0.5)) for core in cores)
        for f in fields(a):
            assert torch.equal(torch.as_tensor(getattr(a, f.name)), torch.as_tensor(getattr(b, f.name))), f.name


def test_values_at_the_ends_of_their_ranges_stay_inside_when_rounded(tmp_path: Path) -> None:
    found = named("cogging", half=0.0, amplitude={"FR_hip": 0.3}, count={"FR_hip": 38.0}, phase={"FR_hip": math.pi})
    (term,) = task(write(result(found), tmp_path)[0]).effect
    assert term.parameters["phase"] == {"FR_hip": math.pi}


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (result(named("wind", speed={"robot": 3.0})), "wind"),
        (result(named("wind")), "wind"),
        (result(named("coulomb", level={"FR_hip": 3.0})), r"coulomb\.level"),
        (result(box={"coulomb": {"level": {"FR_hip": 3.0}}}), r"coulomb\.level"),
    ],
)
def test_what_the_library_does_not_have_is_refused(found: GapResult, said: str, tmp_path: Path) -> None:
    with pytest.raises(files.GapFileError, match=f"^{said}: not in the library"):
        write(found, tmp_path)


def test_values_per_joint_are_those_of_the_file() -> None:
    terms = terms_of({
        "coulomb": {"bound": {"FR_hip": 0.3, "calf": 0.1}},
        "kd_scale": {"scale": {"RL_thigh": 1.5}},
        "viscous": {"damping": [0.1, 0.2, 0.3]},
        "base_tilt": {"roll": 0.02},
    })  # fmt: skip
    theta = theta_of(terms, JOINTS)
    bound = [0.3 if j == "FR_hip" else 0.1 if j.endswith("calf") else 0.0 for j in JOINTS]
    np.testing.assert_array_equal(theta["coulomb", "bound"], bound)
    np.testing.assert_array_equal(theta["kd_scale", "scale"], [1.5 if j == "RL_thigh" else 1.0 for j in JOINTS])
    np.testing.assert_array_equal(theta["viscous", "damping"], [0.1, 0.2, 0.3] * 4)
    np.testing.assert_array_equal(theta["base_tilt", "roll"], [0.02])
    np.testing.assert_array_equal(theta["base_tilt", "pitch"], [0.0])
    with pytest.raises(ValueError, match="unknown effect term 'coulmb'"):
        terms_of({"coulmb": {}})
    with pytest.raises(ValueError, match="must be between"):
        terms_of({"coulomb": {"bound": 50.0}})


# ---------------------------------------------------------------------- the proof

HIDDEN = dict(zip(JOINTS, np.linspace(0.3, 0.6, 12).round(3).tolist(), strict=True))


@cache
def robot() -> tuple[simulate.Rig, tuple[Recording, ...]]:
    """Record a hung robot with friction that the model lacks: four chirps of a second."""
    small = ["physics_dt=0.001", "seconds=1.0", "excitation=[chirp]", "seeds=[0,1,2,3]"]
    return recorded(small, {"coulomb": {"bound": HIDDEN}})


def proof(tmp_path: Path, found: GapResult, physics_dt: float = 0.001) -> Any:
    rig, recordings = robot()
    contents: Any = {p.name: OmegaConf.to_container(OmegaConf.load(p)) for p in write(found, tmp_path)}
    settings = GapSettings(window_s=0.2, stride_s=0.3, physics_dt=0.001)
    return prove(recordings, rig.robot, settings, found, contents, physics_dt)


def test_the_right_effect_is_proved_and_a_wrong_one_is_not(tmp_path: Path) -> None:
    right = result(named("coulomb", half=0.01, bound=HIDDEN), excess={"box": 500.0, "final": 0.0})
    good = proof(tmp_path, right)
    assert good.holds
    assert good.before > 100.0
    assert good.after == good.effect_only < 0.3
    assert good.closed == pytest.approx(1.0 - max(good.after, 0.0) / good.before)
    assert good.closed > 0.99
    assert good.physics_dt == pytest.approx(0.001, rel=1e-4)  # the logger's clock is not exact
    wrong = replace(right, named=(named("coulomb", bound={j: 2.0 * v for j, v in HIDDEN.items()}),))
    bad = proof(tmp_path, wrong)
    assert not bad.holds
    assert bad.before == good.before
    assert bad.after > 10.0
    worse = replace(right, named=(named("coulomb", bound={j: 9.0 * v for j, v in HIDDEN.items()}),))
    harmful = proof(tmp_path, replace(worse, excess={"final": 1e6, "written": 1e6}))
    assert harmful.after > harmful.before
    assert not harmful.holds  # as good as was reported, and yet worse than nothing


def test_what_is_proved_is_compared_on_the_windows_on_which_it_was_reported(tmp_path: Path) -> None:
    """Another split has other windows, whose error may be twice as large: what holds would be refused (exit 15)."""
    small = named("coulomb", half=0.01, bound={j: 0.5 * v for j, v in HIDDEN.items()})
    alone = [proof(tmp_path, result(small, provenance={"windows": 8, "evaluated": [k]})) for k in (0, 7)]
    assert alone[0].after != alone[1].after
    for k, one in zip((0, 7), alone, strict=True):
        written = {"final": 0.0, "written": one.after}
        again = proof(tmp_path, result(small, excess=written, provenance={"windows": 8, "evaluated": [k]}))
        assert again.holds
        assert again.reported == again.after == one.after
    with pytest.raises(files.GapFileError, match="8 windows, 13 in the search that found this"):
        proof(tmp_path, result(small, provenance={"windows": 13, "evaluated": [0]}))


def test_a_calibration_counts_with_the_effect_and_not_alone(tmp_path: Path) -> None:
    found = result(excess={"box": 0.0, "final": 0.0}, box={"coulomb": {"bound": HIDDEN}})
    seen = proof(tmp_path, found)
    assert seen.holds
    assert seen.effect_only == seen.before > 100.0
    assert seen.after < 0.3


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_what_is_not_for_training_is_not_asked_of_the_proof(tmp_path: Path) -> None:
    lean = named("viscous", "compensating", damping=dict.fromkeys(JOINTS, 0.3))
    before = proof(tmp_path, result(excess={"box": 1e6, "final": 0.0})).before
    alone = proof(tmp_path, result(lean, excess={"box": before, "final": 0.0}))
    assert alone.holds
    assert alone.reported == before == alone.after
    steps = (("nominal model", before), ("coulomb", 0.2), ("viscous", 0.1))
    both = result(named("coulomb", bound=HIDDEN), lean, excess={"final": 0.1}, waterfall=steps)
    assert proof(tmp_path, both).reported == 0.2
    assert not proof(tmp_path, result(excess={"box": 0.5 * before, "final": 0.5 * before})).holds


# ---------------------------------------------------------------------- logs that cannot be compared


def test_logs_of_another_robot_or_without_what_is_needed_are_refused() -> None:
    rig, (recording, *_) = robot()
    machine, meta = suspended(rig.robot), recording.meta
    assert machine.flaws(recording, audit(recording)) == []
    swapped = replace(recording, meta=replace(meta, joints=(*meta.joints[1:], meta.joints[0])))
    bare = {k: v for k, v in recording.channels.items() if not k.startswith("qd_")}
    stuck = {**recording.channels, "q_FR_hip": np.full(len(recording.t), 0.1)}
    for changed, said in (
        (swapped, f"{meta.episode}: has joints {meta.joints[1]}"),
        (replace(recording, meta=replace(meta, kp=None, kd=None)), "says no gains (kp, kd)"),
        (replace(recording, channels=bare), f"{meta.episode}: no qd"),
        (replace(recording, channels=stuck), f"{meta.episode}: q_FR_hip: "),
    ):
        flaws = machine.flaws(changed, audit(changed))
        assert any(said in line for line in flaws), (said, flaws)
        answer = explain([recording, changed], rig.robot)
        assert (answer.verdict, answer.exit_code) == ("bad log", 14)
        assert all(flaw in answer.sentence or flaw in answer.warnings for flaw in flaws)
        assert flaws[0] in answer.sentence
        assert answer.floors is None


def test_logs_that_are_too_short_are_refused() -> None:
    rig, (recording, *_) = robot()
    answer = explain([recording], rig.robot)
    assert answer.verdict == "bad log"
    assert "too short: 2 windows of 0.3 s, 8 are needed" in answer.sentence
