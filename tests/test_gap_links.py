"""``go1exp gap`` on one leg on a stand: masses that are elsewhere, and what hangs on a link."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp.gap.comparison import compare
from go1exp.gap.result import GapResult, GapSettings
from go1exp.gap.robots.description import ModelConfig, parse_model
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.search.fit import scores
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import Recording, joint_channel
from go1exp.sim.effects.base import Measured
from tests import made
from tests.laboratory import at_rest

LEG = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody><body name="stand" pos="0 0 1">
    <inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="hip_link"><joint name="hip" axis="1 0 0" armature="0.004"/>
      <inertial mass="0.68" pos="0 0.01 0" diaginertia="5e-4 7e-4 5e-4"/>
      <body name="thigh_link" pos="0 0.08 0"><joint name="thigh" axis="0 1 0" armature="0.004"/>
        <inertial mass="1.0" pos="0 -0.03 -0.03" diaginertia="5e-3 5e-3 1e-3"/>
        <body name="calf_link" pos="0 0 -0.213"><joint name="calf" axis="0 1 0" armature="0.009"/>
          <inertial mass="0.2" pos="0 0 -0.12" diaginertia="1e-3 1e-3 5e-5"/>
        </body>
      </body>
    </body>
  </body></worldbody>
</mujoco>
"""
JOINTS = ("hip", "thigh", "calf")
STEP, EVERY = 0.0005, 4
DRIVES = {"strength": {"scale": 0.01}, "kp_scale": {"scale": 0.02}, "kd_scale": {"scale": 0.03}}
"""Drives that were measured: one factor on all torques and all masses changes no motion."""

REST = np.array([0.0, 0.8, -1.5])
HANGS = ((1.0, 0.0, 0.0, 0.0), tuple(Rotation.from_euler("YX", [0.4, 0.3]).as_quat(scalar_first=True)))
RIVALS = ("base_tilt", "encoder_offset", "link_com", "link_inertia", "link_mass", "parallel_stiffness", "point_load")

SETTINGS = GapSettings(stride_s=0.3, effects=RIVALS, max_terms=1, bootstraps=20, overlays=0)


def leg(folder: Path) -> FixedBase:
    """A leg of a Go1's size, whose ``thigh`` is what the joint of that name moves, and so on."""
    (folder / "leg.xml").write_text(LEG)
    words = {"mjcf": str(folder / "leg.xml"), "robots": ["leg"], "base": "stand", "joints": list(JOINTS)}
    config = parse_model({**words, "torque_limit": 30.0, "speed_limit": 30.0, "tolerances": DRIVES})
    assert isinstance(config, ModelConfig)
    return FixedBase.from_config(config)


def recorded(robot: FixedBase, effects: Mapping[str, Mapping[str, Any]], seconds: float = 2.5) -> list[Recording]:
    """Let it follow sums of sines in two attitudes of the stand, with 0.2 mrad and 0.02 rad/s of noise."""
    found, t = [], np.arange(round(seconds / STEP)) * STEP
    for n in range(4):
        rng, quat = np.random.default_rng(n), HANGS[n % 2]
        frequency, phase = rng.uniform(0.3, 3.0, (3, 4)), rng.uniform(0.0, 2 * np.pi, (3, 4))
        swing = 0.18 * np.sin(2 * np.pi * frequency[..., None] * t + phase[..., None]).sum(1).T
        target = REST + swing * np.minimum(t / 0.3, 1.0)[:, None]
        plant = at_rest(robot, effects, target[:1], 25.0, 0.6, STEP, quat)
        readings = []
        for k, row in enumerate(target):
            if k % EVERY == 0:
                seen = plant.effects.measure(Measured(plant.q, plant.speed()))
                readings.append(torch.stack([seen.joint_pos[0], seen.joint_vel[0]]).numpy().copy())
            plant.step(torch.as_tensor(row[None]))
        q, qd = np.moveaxis(np.array(readings), 1, 0)
        channels = {"q": q + 2e-4 * rng.standard_normal(q.shape), "qd": qd + 0.02 * rng.standard_normal(q.shape)}
        channels["q_target"] = target[::EVERY]
        about: dict[str, Any] = {"robot": "leg", "rate_hz": 1 / (EVERY * STEP), "base": "fixed", "base_quat": quat}
        about |= {"kp": (25.0,) * 3, "kd": (0.6,) * 3, "excitation": f"sines{n % 2}"}
        columns = {joint_channel(c, j): v[:, i].copy() for c, v in channels.items() for i, j in enumerate(JOINTS)}
        found.append(Recording(made.meta(JOINTS, episode=f"e{n}", **about), {"t": t[::EVERY].copy(), **columns}))
    return found


def answer(folder: Path, effects: Mapping[str, Mapping[str, Any]]) -> GapResult:
    robot = leg(folder)
    return explain(recorded(robot, effects), robot, SETTINGS)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_leg_without_a_secret_has_no_gap(tmp_path: Path) -> None:
    result = answer(tmp_path, {})
    assert result.verdict == "no gap"
    assert result.named == ()


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_shift_across_the_leg_is_named_as_one_and_not_as_an_offset_of_the_encoder(tmp_path: Path) -> None:
    """Across the thigh: it turns the hip, whose encoder would have to be off by an angle that depends on the pose."""
    result = answer(tmp_path, {"link_com": {"left": {"thigh": 0.012}}})
    assert result.verdict == "explained"
    (found,) = result.named
    assert (found.effect, found.joints, found.status) == ("link_com", ("thigh",), "certified")
    assert found.params["left"]["thigh"] == pytest.approx(0.012, rel=0.08)
    assert all(abs(found.params[name]["thigh"]) < 0.001 for name in ("along", "forward"))
    assert "link mass (link_com) at thigh: left 0.01" in result.sentence
    assert "encoder_offset" not in found.alias_set


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_load_is_judged_by_the_answer_of_the_loaded_leg_to_its_initial_state(tmp_path: Path) -> None:
    robot = leg(tmp_path)
    load = {"mass": {"calf": 0.12}, "x": 0.02, "z": -0.213}
    comparison = compare(recorded(robot, {"point_load": load}), robot, SETTINGS)
    values = {
        ("point_load", k): np.array([0.0, 0.0, v["calf"]] if isinstance(v, dict) else [v] * 3) for k, v in load.items()
    }
    assert comparison.scorer.updated is not None
    scorers = comparison.scorer, comparison.scorer.updated(values)
    plain, own = (scores(s, [values], comparison.everything, comparison.dt)[0].mean() for s in scorers)
    assert own == pytest.approx(1.0, abs=0.1)
    assert plain > 1.5


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize("z", [-0.213, -0.06])
def test_a_load_on_the_calf_is_named_with_its_mass_and_its_place(tmp_path: Path, z: float) -> None:
    """At the foot, and on the shank: neither is a heavier link, nor a shift of its mass."""
    result = answer(tmp_path, {"point_load": {"mass": {"calf": 0.12}, "x": 0.02, "z": z}})
    assert result.verdict == "explained", result.sentence
    (found,) = result.named
    assert (found.effect, found.joints, found.status) == ("point_load", ("calf",), "certified")
    assert found.params["mass"]["calf"] == pytest.approx(0.12, rel=0.1)
    assert found.params["x"]["calf"] == pytest.approx(0.02, abs=0.01)
    assert found.params["z"]["calf"] == pytest.approx(z, abs=0.02)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_denser_calf_is_not_called_a_load(tmp_path: Path) -> None:
    result = answer(tmp_path, {"link_mass": {"scale": {"calf": 1.5}}})
    assert [(n.effect, n.joints) for n in result.named] == [("link_mass", ("calf",))], result.sentence
    assert result.named[0].params["scale"]["calf"] == pytest.approx(1.5, rel=0.05)
