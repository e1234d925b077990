"""Puts the ground into a MuJoCo model: a plane or a height field named `floor`."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp.sim.terrain import Terrain

FLOOR = "floor"
"""Name of the geom, its asset and its material."""

FRICTION = (1.0, 0.005, 0.0001)
"""Sliding (-), torsional (m), rolling (m) friction of the ground; the last two are MuJoCo's defaults."""

BASE_THICKNESS = 0.1
"""Solid ground below the lowest sample of a height field, m."""

VIEW_EXTENT = 2.0
"""Length that MuJoCo's viewers scale by, m: about a robot, whatever the size of the field."""


def add_to_spec(spec: mujoco.MjSpec, terrain: Terrain) -> mujoco.MjsGeom:
    """Add the ground, its look and a sun to `spec`, and return the geom.

    The geom offers contacts and accepts none (contype 1, conaffinity 0): a body that is to touch it has conaffinity 1.
    Its surface has the world heights of `terrain`: exactly, up to float64 rounding. It also fixes the visual extent and
    centre of the model, which MuJoCo would take from the whole field and clip everything near the camera.
    """
    floor = spec.worldbody.add_geom(
        name=FLOOR, contype=1, conaffinity=0, condim=3, friction=list(FRICTION), material=FLOOR, group=0
    )
    floor.castshadow = False  # it would only speckle itself, and every triangle would be drawn twice
    material = spec.add_material(name=FLOOR, specular=0.1, shininess=0.1)
    if terrain.config.kind == "flat":
        floor.type = mujoco.mjtGeom.mjGEOM_PLANE
        floor.size = [0.0, 0.0, 0.05]
        spec.add_texture(
            name=FLOOR,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            mark=mujoco.mjtMark.mjMARK_EDGE,
            rgb1=[0.34, 0.38, 0.42],
            rgb2=[0.28, 0.32, 0.36],
            markrgb=[0.5, 0.54, 0.58],
            width=300,
            height=300,
        )
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
        material.texrepeat = [2.0, 2.0]  # with texuniform: per metre, so a square has an edge of 0.5 m
        material.texuniform = True
    else:
        material.rgba = [0.52, 0.50, 0.45, 1.0]
        low, high = float(terrain.heights.min()), float(terrain.heights.max())
        span = high - low if high > low else 1.0
        x_min, x_max, y_min, y_max = terrain.extent
        spec.add_hfield(
            name=FLOOR,
            nrow=terrain.heights.shape[0],
            ncol=terrain.heights.shape[1],
            size=[0.5 * (x_max - x_min), 0.5 * (y_max - y_min), span, BASE_THICKNESS],
            userdata=((terrain.heights - low) / span).astype(np.float32).ravel(),
        )
        floor.type = mujoco.mjtGeom.mjGEOM_HFIELD
        floor.hfieldname = FLOOR
        floor.pos = [0.5 * (x_min + x_max), 0.5 * (y_min + y_max), low]
    _add_sun(spec)
    spec.stat.extent = VIEW_EXTENT
    spec.stat.center = [0.0, 0.0, 0.3]
    spec.visual.map.zfar = 150.0  # in extents: a whole field is in view
    return floor


def _add_sun(spec: mujoco.MjSpec) -> None:
    """Add a directional light above the first body, and a sky.

    The light travels with the body because MuJoCo draws shadows only within a few extents of the light's own axis.
    """
    direction = np.array([0.4, 0.3, -0.85])
    body = spec.worldbody.first_body()
    (body or spec.worldbody).add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM if body else mujoco.mjtCamLight.mjCAMLIGHT_FIXED,
        pos=(-4.0 * direction).tolist(),
        dir=direction.tolist(),
        diffuse=[0.7, 0.7, 0.7],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.72, 0.82],
        rgb2=[0.22, 0.30, 0.40],
        width=128,
        height=768,
    )
    spec.visual.rgba.haze = [0.42, 0.51, 0.61, 1.0]  # the sky at the horizon
