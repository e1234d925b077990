"""Contacts of MuJoCo Warp with a height field are MuJoCo's, beside edges and below the surface too."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from benchmarks.height_field import OFF, RADIUS, Array, deepest_of_mujoco, deepest_of_warp, on_rough_ground, scene

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra gpu"),
    pytest.mark.slow("go1exp/sim/physics/warp_kernels.py", "go1exp/sim/physics/mujoco_warp.py"),
]


def of_backend(model: mujoco.MjModel, places: Array) -> Array:
    """Return the depths that ``backend=warp`` has."""
    from go1exp.sim.physics import mujoco_warp as backend

    assert backend.use_mujocos_law() == ()  # done as the backend was imported
    return deepest_of_warp(model, places)


def test_a_foot_beside_the_edge_of_a_box_is_as_deep_as_in_mujoco() -> None:
    """The smallest scene: a ramp of 63 degrees, and a ball 3 mm deep in the flat ground at its foot."""
    heights = np.zeros((5, 5))
    heights[:, 3:] = 0.2
    model = scene(heights, (0.2, 0.2))
    x = np.linspace(-0.08, -0.001, 40)
    places = np.stack([x, np.full(40, 0.013), np.full(40, RADIUS - 0.003)], axis=1)
    expected = deepest_of_mujoco(model, places)
    np.testing.assert_allclose(of_backend(model, places), expected, rtol=0, atol=1e-5)
    assert expected.min() > -0.02


@pytest.mark.parametrize("depth", [0.005, 0.03])
def test_contacts_on_the_paper_s_ground_are_as_deep_as_in_mujoco(depth: float) -> None:
    model, places = on_rough_ground(1500, depth, 0)
    difference = of_backend(model, places) - deepest_of_mujoco(model, places)
    assert np.isfinite(difference).mean() > 0.98  # the rest touches in the last bit, or does not
    assert np.nanmax(np.abs(difference)) < OFF


def test_the_engine_still_needs_it() -> None:
    """If this fails the engine has a law of its own no more, and ``warp_height_field.py`` can go."""
    code = "from go1exp.sim.physics.warp_kernels import use_mujocos_law as u; print(u())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip().splitlines()[-1] == "('_inflate', '_epa_witness')"
