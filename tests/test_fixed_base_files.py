"""Files of a robot of one's own: URDF, and bodies that the compiler would merge."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from go1exp.sim.physics.fixed_base import FixedBaseError, build_fixed_base

LINK = '<inertial><mass value="0.3"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
URDF = f"""<robot name="bench"><link name="base_link">{LINK}</link><link name="arm_link">{LINK}{{visual}}</link>
<joint name="arm" type="revolute"><parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="2" velocity="8"/></joint></robot>"""
MJCF = """<mujoco><compiler fusestatic="true"/><worldbody><body name="base_link">
<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><body name="arm_link"><joint name="arm"/>
<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("name", "text"), [("arm.urdf", URDF.format(visual="")), ("arm.xml", MJCF)])
def test_a_base_without_a_joint_remains_a_body(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    model = build_fixed_base(tmp_path / name, "base_link", ["arm"], [2.0], 0.001)
    assert [model.body(k).name for k in range(model.nbody)] == ["world", "trunk", "arm"]


def test_a_mesh_that_is_missing_is_named_in_one_line(tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="meshes/link.stl"/></geometry></collision>'
    (tmp_path / "arm.urdf").write_text(URDF.format(visual=mesh))
    with pytest.raises(FixedBaseError, match=r"^mjcf = .*arm\.urdf.*link\.stl") as caught:
        build_fixed_base(tmp_path / "arm.urdf", "base_link", ["arm"], [2.0], 0.001)
    assert len(str(caught.value).splitlines()) == 1


def test_a_link_whose_mass_lies_on_its_joint_takes_another_mass(tmp_path: Path) -> None:
    """MuJoCo calls such a body simple, and refuses to move its centre of mass afterwards."""
    text = """<mujoco><worldbody><body name="stand"><inertial mass="1" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="arm"><joint name="arm" axis="0 0 1"/>
        <inertial mass="0.1" pos="0 0 0" diaginertia="1e-2 1e-2 1e-2"/></body></body></worldbody></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    model = build_fixed_base(tmp_path / "arm.xml", "stand", ["arm"], [2.0], 0.001)
    assert model.body_simple[model.body("arm").id] == 0
    model.body("arm").ipos[:] = [0.05, 0.0, 0.0]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_forward(model, data)
    assert data.M[0] == pytest.approx(1e-2 + 0.1 * 0.05**2)
