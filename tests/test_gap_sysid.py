"""The baseline that fits everything at once: its model is the benchmark's robot, and it finds what is plain."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import gap_sysid
from benchmarks.gap import cases, generate, known, logger, score
from benchmarks.gap.simulate import simulate
from benchmarks.gap.truth import Truth, apply
from go1exp import robot
from go1exp.logs.recording import Recording

pytestmark = pytest.mark.skipif(
    not hasattr(gap_sysid.sysid, "optimize"), reason='mujoco.sysid lacks its own dependencies: "mujoco[sysid]"'
)

EVERY = np.arange(robot.NUM_JOINTS)
NOISE = np.repeat([4e-4, 0.04], robot.NUM_JOINTS)


def recordings(truth: Truth, seconds: float, motions: tuple[str, ...] = ("steps", "gait")) -> list[Recording]:
    """Return what a logger without errors writes about a robot that is simulated in steps of 0.1 ms."""
    rng = np.random.default_rng(3)
    episodes = cases.experiment(motions, len(motions) + 1, seconds, rng)[:-1]
    samples = simulate(truth, episodes, 1e-4, rng, np.zeros(robot.NUM_JOINTS, dtype=bool))
    perfect = logger.Logger()
    return [
        Recording(logger.meta(e), logger.log(perfect, samples, k, e.target, e.on, rng)) for k, e in enumerate(episodes)
    ]


@pytest.mark.parametrize("effect", gap_sysid.FITTED)
def test_the_model_at_the_hidden_values_replays_the_hidden_robot(effect: str) -> None:
    name = gap_sysid.FITTED[effect][0]
    null, unit = known.null(effect, name), known.TOLERANCES[effect][name]
    truth = Truth()
    value = null + 5.0 * unit if effect == "base_tilt" else np.full(robot.NUM_JOINTS, null + 5.0 * unit)
    apply(truth, effect, {"roll": 0.0, name: value} if effect == "base_tilt" else {name: value}, EVERY)
    fit = gap_sysid.Fit(recordings(truth, 0.4), NOISE)
    params = gap_sysid.parameters()
    for each in gap_sysid.FITTED:
        at_null = np.zeros(params[each].size)
        params[each].value = at_null + (5.0 if each == effect else 0.0)
    right = fit.rms(params.as_vector())
    assert right < 0.7  # the truth steps by 0.1 ms, and friction is LuGre's
    assert fit.rms(np.zeros(params.size)) > 3.0 * right


def test_one_replay_for_four_legs_gives_the_jacobian() -> None:
    fit = gap_sysid.Fit(recordings(Truth(), 0.4, ("gait",)), NOISE)
    x = np.zeros(gap_sysid.parameters().size)
    r = np.concatenate(fit.residual(x, gap_sysid.parameters())[0])
    one_by_one = np.concatenate(fit.residual(x[:, None] + gap_sysid.STEP * np.eye(x.size), gap_sysid.parameters())[0])
    expected = (one_by_one - r[:, None]) / gap_sysid.STEP
    found = fit.jacobian(x[:, None], r[:, None])
    assert np.linalg.norm(expected, axis=0).min() > 0.0
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.slow("benchmarks/")
def test_a_large_armature_is_found_and_the_verdict_can_be_scored(tmp_path: Path) -> None:
    case = cases.make("null", 0, 5, count=3, seconds=1.5)  # a clean robot, to which one effect is added
    joint = robot.JOINTS.index("FL_thigh")
    values: cases.Values = {"added": np.array([0.005])}
    apply(case.truth, "armature", values, np.array([joint]))
    case.answer |= {"kind": "single", "effects": [cases.effect_answer("armature", 5.0, np.array([joint]), values)]}
    generate.write_case(case, tmp_path / "cases")
    line = gap_sysid.solve(tmp_path / "cases" / case.name, tmp_path / "out")
    assert "armature" in line
    verdict = json.loads((tmp_path / "out" / case.name / "verdict.json").read_text())
    assert verdict["verdict"] == "explained"
    assert verdict["closed"] > 0.8
    assert verdict["named"][0]["effect"] == "armature"
    assert verdict["named"][0]["joints"] == ["FL_thigh"]
    assert verdict["named"][0]["params"]["added"]["FL_thigh"] == pytest.approx(0.005, rel=0.1)
    assert {c["effect"] for c in verdict["candidates"]} == set(gap_sysid.FITTED) <= set(known.LIBRARY)
    found = score.evaluate({case.name: case.answer}, score.read_results(tmp_path / "out"))
    assert found.figures["first_exact"][0] == 1.0, found.failures


def test_what_is_no_recording_is_a_bad_log(tmp_path: Path) -> None:
    (tmp_path / "case_x").mkdir()
    (tmp_path / "case_x" / "episode_00.parquet").write_bytes(b"nothing")
    assert "bad log" in gap_sysid.solve(tmp_path / "case_x", tmp_path / "out")
    assert json.loads((tmp_path / "out/case_x/verdict.json").read_text())["verdict"] == "bad log"
