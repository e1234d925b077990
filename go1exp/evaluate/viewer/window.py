"""What every window of ours has: places for the panels, a camera that follows, the mouse, arrows in the scene."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui

from go1exp.evaluate.viewer.walk import Arrow
from go1exp.evaluate.viewer.web import Ask, Shown
from go1exp.sim.env.camera import AZIMUTH, DISTANCE, ELEVATION

LEFT, RIGHT = 0.23, 0.42
"""Width of the panels: the left one's share of the window, and the right one's of what is left."""

ARROW_WIDTH = 0.013
"""m."""

Vec2 = imgui.Vec2


class Window(plugin.ViewerPlugin):
    """Base of the windows.

    Attributes:
        view: what is to be drawn; None before the first one.
        follow: whether the camera goes with the robot.
    """

    def __init__(self, *panels: str) -> None:
        """Dock two panels of these names at the left and at the right."""
        self.view: Any = None
        self.follow, self._left, self._right = True, *panels
        self._docked = self._looking = False
        self._ux = ux.UxState()

    # ------------------------------------------------------------------ what a subclass draws

    def left(self) -> None:
        """Fill the left panel."""
        raise NotImplementedError

    def right(self) -> None:
        """Fill the right panel."""
        raise NotImplementedError

    def keys(self) -> None:
        """Answer keys."""

    def scene(self) -> Iterable[Any]:
        """Return shapes (``MjvGeom``) beside the model's own."""
        return ()

    def sight(self) -> tuple[Any, float]:
        """Return where to look at first, from the robot, m, and from how far, in distances of a clip's camera."""
        return np.zeros(3), 1.6

    # ------------------------------------------------------------------ messages

    def ask(self, request: Any) -> None:
        """Send what a user asks for."""
        self.viewer.send_to_sim(Ask(request))

    @messages.handler
    def _on_shown(self, event: Shown) -> None:
        self.view = event.view

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_update(self, event: messages.UpdateEvent) -> None:
        model, data, camera = self.viewer.model, self.viewer.data, self.viewer.camera
        if not imgui.GetIO().WantCaptureKeyboard and self.view is not None:
            self.keys()
        flying = self.viewer.client_camera is None
        inputs.handle_mouse_events(
            model, data, camera, self.viewer.vis_options, self.viewer.perturb, self._ux, move_camera=flying
        )
        if model.nbody > 1 and self.view is not None:
            self._look()
        self.viewer.extra_geoms[:] = list(self.scene()) if self.view is not None else []

    def _look(self) -> None:
        """Look at the robot once, then follow it or not."""
        camera = self.viewer.camera
        if not self._looking:
            self._looking = True
            place, times = self.sight()
            camera.lookat[:] = self.viewer.data.xpos[1] + place
            camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, times * DISTANCE
        tracking = camera.type == int(mujoco.mjtCamera.mjCAMERA_TRACKING)
        if self.follow and not tracking:
            camera.type, camera.trackbodyid = int(mujoco.mjtCamera.mjCAMERA_TRACKING), 1
            self._ux.camera_index = ux.TRACKING_CAMERA_IDX
        elif not self.follow and tracking:
            camera.type, camera.trackbodyid = int(mujoco.mjtCamera.mjCAMERA_FREE), -1
            self._ux.camera_index = ux.TUMBLE_CAMERA_IDX
        self.viewer.camera_index = self._ux.camera_index

    @messages.handler
    def _on_gui(self, event: messages.BuildGuiEvent) -> None:
        ux.setup_theme(ux.GuiTheme.DARK)
        self._dock()
        for name, fill in ((self._left, self.left), (self._right, self.right)):
            imgui.Begin(name)
            if self.view is None:
                imgui.TextUnformatted("waiting for the robot ...")
            else:
                fill()
            imgui.End()

    def _dock(self) -> None:
        """Give the panels their places, once; the scene shows through between them."""
        flags = imgui.DockNodeFlags
        root = imgui.DockSpaceOverMainViewport(0, int(flags.PassthruCentralNode))
        if self._docked:
            return
        self._docked = True
        left, rest = imgui.DockBuilderSplitNode(root, imgui.Dir.Left, LEFT)
        right, _ = imgui.DockBuilderSplitNode(rest, imgui.Dir.Right, RIGHT)
        imgui.DockBuilderDockWindow(self._left, left)
        imgui.DockBuilderDockWindow(self._right, right)
        imgui.DockBuilderFinish(root)

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_model(self, event: messages.PostModelEvent) -> None:
        self._looking = self._looking and self.follow


def arrow_shape(arrow: Arrow) -> Any:
    """Return an arrow as a shape of the scene."""
    geom, kind = mujoco.MjvGeom(), mujoco.mjtGeom.mjGEOM_ARROW
    rgba = np.array([*arrow.rgb, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
    mujoco.mjv_connector(geom, kind, ARROW_WIDTH, arrow.start, arrow.end)
    geom.emission = 0.5  # bright whatever the light
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    return geom


def paragraph(text: str, lines: int = 0) -> None:
    """Write text over several lines, broken between words (ImGui's own breaks fall within them).

    It takes the room of ``lines`` at least: what is below text that comes and goes must not jump from under the mouse.
    """
    columns = int(imgui.GetContentRegionAvail().x / imgui.CalcTextSize("n").x)
    broken = textwrap.wrap(text, max(columns, 10))
    for line in broken + [""] * (lines - len(broken)):
        imgui.TextUnformatted(line)


MESSAGE_LINES = 2
"""Room for what a user must know, of ``paragraph``."""


def section(label: str, is_open: bool = True) -> bool:
    """Begin a section that can be folded; return whether it is unfolded."""
    flags = int(imgui.TreeNodeFlags.DefaultOpen) if is_open else 0
    return bool(imgui.CollapsingHeader(label, flags))


__all__ = ["MESSAGE_LINES", "Vec2", "Window", "arrow_shape", "imgui", "paragraph", "section"]
