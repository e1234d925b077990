"""Pictures of a running environment, drawn off screen.

MuJoCo binds ``mujoco.Renderer`` to one GL library when ``mujoco`` is first imported, from MUJOCO_GL, and takes one that
needs a display if that is unset. Pictures are wanted long after that import and mostly without a display, so the
library is chosen here and the context is made directly, without ``mujoco.Renderer``.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import importlib.util
import math
import os
import subprocess
import sys
import weakref
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from go1exp.config.schema.registry import Expected
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.scene import FLOOR, build_model
from go1exp.sim.terrain import Terrain

Picture = NDArray[np.uint8]
"""(H, W, 3), RGB."""

COMMAND_RGB, MEASURED_RGB = (0.25, 0.6, 1.0), (0.35, 0.9, 0.4)
"""Colours of the commanded and of the measured velocity."""

GL_LIBRARIES = ("egl", "osmesa")
"""GL libraries that draw without a display, the faster one first."""

GL_HELP = (
    "On Debian and Ubuntu install the packages libegl1 libopengl0 libgl1-mesa-dri (for egl) or libosmesa6 (for "
    "osmesa). MUJOCO_GL=egl or MUJOCO_GL=osmesa selects one; without it the first that works is taken."
)

GROUND_RANGE = 10.0
"""Distance up to which a height field is drawn around the robot, m: in software, a whole one takes 1 s a picture."""

GROUND_PACE = 2.0
"""The drawn part moves by whole multiples of this, m: two squares of MuJoCo's checker, so that the pattern does not
move."""

AZIMUTH, ELEVATION, DISTANCE = 128.0, -16.0, 1.5
"""Line of sight against the robot's first heading, deg, and against the horizon, deg; its length, m."""

FOLLOW_TIME = 0.12
"""Time constant with which the camera follows the trunk, s."""

VELOCITY_TIME = 0.2
"""Time constant of the drawn velocity, s: about half a gait cycle."""

LEAST_DRAWN, ARROW_SCALE = 0.15, 0.35
"""Speed below which there is no arrow, m/s; length of an arrow per speed, m / (m/s)."""

REACH, FASTEST = 1.0, 5.0
"""A robot whose distance from its last position exceeds this, m, plus this speed, m/s, times the time, was reset: the
camera then jumps to it."""

_PROBE = """
import os, mujoco
from mujoco.{name} import GLContext
context = GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
os._exit(0)
"""


class RenderingUnavailable(Expected):
    """There is no GL library to draw with; the message says what to install or set."""


def missing_for_mp4() -> str | None:
    """Return what an .mp4 needs that is not installed, None if nothing is."""
    if importlib.util.find_spec("imageio_ffmpeg") is not None:
        return None
    return "an .mp4 needs the package imageio-ffmpeg: pip install 'go1exp[video]'"


@functools.cache
def choose_gl() -> str:
    """Return the GL library to draw with: the one that MUJOCO_GL names, else the first that works on this machine.

    Each is tried in a process of its own (0.6 s), because a failed import would keep PyOpenGL from trying the next.

    Raises:
        RenderingUnavailable: if there is none.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted:
        if wanted not in (*GL_LIBRARIES, "glfw"):
            raise RenderingUnavailable(f"cannot draw: MUJOCO_GL={wanted!r} is no GL library. {GL_HELP}")
        return wanted
    failures = []
    for name in GL_LIBRARIES:
        reason = _why_not(name)
        if not reason:
            return name
        failures.append(f"{name}: {reason}")
    raise RenderingUnavailable(f"cannot draw: no GL library works. {GL_HELP} ({'; '.join(failures)})")


def _why_not(name: str) -> str:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE.format(name=name)], capture_output=True, text=True, timeout=60
        )
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]


def _contexts(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    name = choose_gl()
    try:
        gl = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    except Exception as error:  # each library fails in its own way
        raise RenderingUnavailable(f"cannot draw with {name}. {GL_HELP} ({type(error).__name__}: {error})") from error
    return gl, context


class Stage:
    """The scene with its decorative shapes, and the robot of one environment in it.

    Of a height field it has only the part around the robot.
    """

    def __init__(self, core: Go1Core, decoration: bool = True) -> None:
        """Build the scene with the robot at the origin; without decoration it has the shapes that touch."""
        self.core = core
        self._decoration = decoration
        self.has_field = core.terrain.config.kind != "flat"
        self._window = self._cut((0.0, 0.0))
        self.model = self._build()
        self.data = mujoco.MjData(self.model)
        vis = self.model.vis
        vis.headlight.ambient[:] = 0.25
        vis.map.fogstart, vis.map.fogend = 2.5, 4.9  # in extents of 2 m: hides the edge of the drawn ground
        vis.rgba.fog[:] = vis.rgba.haze
        vis.quality.shadowsize = 2048  # half of the default: 12 ms a picture less in software, and looks the same

    def place(self, env: int) -> bool:
        """Take over the state of an environment; return whether the ground was exchanged with it."""
        backend = self.core.backend
        self.data.qpos[:] = backend.qpos[env].cpu().numpy()
        self.data.qvel[:] = backend.qvel[env].cpu().numpy()
        moved = self.has_field and self._move_window()
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # the sun follows the trunk's centre of mass
        mujoco.mj_camlight(self.model, self.data)
        return moved

    def heading(self) -> float:
        """Yaw of the trunk, rad."""
        w, x, y, z = self.data.qpos[3:7]
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    def _build(self) -> mujoco.MjModel:
        task = self.core.task
        return build_model(task.robot, self._window, task.sim.physics_dt, self._decoration, contact=task.contact)[0]

    def _cut(self, xy: tuple[float, float]) -> Terrain:
        """Return the ground within GROUND_RANGE of a place, or as much as there is."""
        whole = self.core.terrain
        size = 2 * round(GROUND_RANGE / whole.resolution) + 1
        pace = round(GROUND_PACE / whole.resolution)

        def start(place: float, origin: float, count: int) -> int:
            wanted = pace * round(((place - origin) / whole.resolution - size // 2) / pace)
            return min(max(wanted, 0), max(count - size, 0))

        ny, nx = whole.heights.shape
        i, j = start(xy[0], whole.x0, nx), start(xy[1], whole.y0, ny)
        x0, y0 = whole.x0 + i * whole.resolution, whole.y0 + j * whole.resolution
        return replace(whole, heights=whole.heights[j : j + size, i : i + size], x0=x0, y0=y0)

    def _move_window(self) -> bool:
        """Centre the window on a robot that has come too near its edge; return whether that changed anything."""
        x_min, x_max, y_min, y_max = self._window.extent
        x, y = self.data.qpos[:2]
        if max(abs(x - 0.5 * (x_min + x_max)), abs(y - 0.5 * (y_min + y_max))) < GROUND_PACE:
            return False
        window = self._cut((x, y))
        if (window.x0, window.y0) == (self._window.x0, self._window.y0):
            return False
        self._window = window
        fresh, floor = self._build(), self.model.geom(FLOOR).id
        self.model.hfield_data[:] = fresh.hfield_data
        self.model.hfield_size[:] = fresh.hfield_size
        self.model.geom_pos[floor] = fresh.geom_pos[floor]
        return True


class Camera:
    """Follows one robot at a time from the front and the side.

    Args:
        core: the environments; any may be drawn at any time.
        width: of the picture, pixels.
        height: of the picture, pixels.
        decoration: draw the visual shapes of the robot, not its collision shapes.

    Raises:
        RenderingUnavailable: if there is no GL library to draw with.
    """

    def __init__(self, core: Go1Core, width: int = 640, height: int = 480, decoration: bool = True) -> None:
        self._context = None
        self.stage = Stage(core, decoration)
        model = self.stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl, self._context = _contexts(model, width, height)
        # Without this the context would be freed after its library at the end, with a message on stderr.
        self._at_exit = functools.partial(_close, weakref.ref(self))
        atexit.register(self._at_exit)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=500)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = self.stage.has_field
        self._option = mujoco.MjvOption()
        self._option.geomgroup[3] = not decoration
        self._view = mujoco.MjvCamera()
        self._view.elevation, self._view.distance = ELEVATION, DISTANCE
        self._env, self._step = -1, 0
        self._velocity = np.zeros(2)

    def frame(self, env: int) -> Picture:
        """Draw an environment as it is now, (H, W, 3); two calls without a step between them draw the same."""
        if self._context is None:
            raise RuntimeError("the camera is closed")
        self._gl.make_current()
        model, data = self.stage.model, self.stage.data
        if self.stage.place(env):
            mujoco.mjr_uploadHField(model, self._context, 0)
        self._follow(env)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        for _ in range(2):  # the first call places the infinite plane around the previous camera position
            mujoco.mjv_updateScene(model, data, self._option, None, self._view, everything, self._scene)
        draw_velocities(self._scene, self.stage, self.stage.core.command.value[env], self._velocity)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        picture = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._rect, self._context)
        return np.flipud(picture).copy()  # OpenGL counts rows from below

    def close(self) -> None:
        """Release the GL context; frames cannot be drawn any more."""
        if self._context is not None:
            atexit.unregister(self._at_exit)
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._context = None

    def __del__(self) -> None:
        self.close()  # makes its own context current first; otherwise MuJoCo would free the objects of another camera

    def _follow(self, env: int) -> None:
        """Move the camera, and the velocity to be drawn, on by the time since the last picture."""
        qpos, qvel, core = self.stage.data.qpos, self.stage.data.qvel, self.stage.core
        step = int(core.steps[env])
        elapsed = (step - self._step) * core.task.sim.policy_dt
        velocity = qvel[:2].copy()
        far = np.linalg.norm(qpos[:3] - self._view.lookat) > REACH + FASTEST * abs(elapsed)
        if env != self._env or elapsed < 0 or far:
            self._view.azimuth = AZIMUTH + math.degrees(self.stage.heading())
            self._view.lookat[:] = qpos[:3]
            self._velocity[:] = velocity
        else:
            self._view.lookat += (1.0 - math.exp(-elapsed / FOLLOW_TIME)) * (qpos[:3] - self._view.lookat)
            self._velocity += (1.0 - math.exp(-elapsed / VELOCITY_TIME)) * (velocity - self._velocity)
        self._env, self._step = env, step


def _close(camera: weakref.ref[Camera]) -> None:
    if (alive := camera()) is not None:
        alive.close()


def draw_velocities(scene: mujoco.MjvScene, stage: Stage, command: Tensor, velocity: NDArray[np.float64]) -> None:
    """Add arrows above the robot to a scene: commanded (blue) and actual (green) velocity.

    Args:
        scene: to add them to.
        stage: where the robot is.
        command: (3,) x and y in the robot's frame, m/s; the yaw rate is not drawn.
        velocity: (2,) in the world's frame, m/s.
    """
    heading = stage.heading()
    cos, sin = math.cos(heading), math.sin(heading)
    x, y = command[:2].tolist()
    wanted = (cos * x - sin * y, sin * x + cos * y)
    for (x, y), rgb, height in ((wanted, COMMAND_RGB, 0.28), (velocity, MEASURED_RGB, 0.23)):
        if math.hypot(x, y) < LEAST_DRAWN or scene.ngeom >= scene.maxgeom:
            continue
        geom, shape = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_ARROW
        start = stage.data.qpos[:3] + np.array([0.0, 0.0, height])
        end = start + ARROW_SCALE * np.array([x, y, 0.0])
        rgba = np.array([*rgb, 1.0], np.float32)
        mujoco.mjv_initGeom(geom, shape, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(geom, shape, 0.013, start, end)
        geom.emission = 0.5  # bright whatever the light
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
        scene.ngeom += 1
