"""Base of the viewer's windows: docked panels, a camera that follows, the mouse, arrows; and shared panels."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui

from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.requests import LARGEST
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

    # ------------------------------------------------------------------ to be overridden

    def left(self) -> None:
        """Fill the left panel."""
        raise NotImplementedError

    def right(self) -> None:
        """Fill the right panel."""
        raise NotImplementedError

    def keys(self) -> None:
        """Handle keys."""

    def scene(self) -> Iterable[Any]:
        """Return shapes (``MjvGeom``) beside the model's own."""
        return ()

    def sight(self) -> tuple[Any, float]:
        """Return the camera's first target relative to the robot, m, and its distance, relative to that of a clip."""
        return np.zeros(3), 1.6

    # ------------------------------------------------------------------ messages

    def ask(self, request: Any) -> None:
        """Send a request of the user."""
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
        """Point the camera at the robot once, then follow it if wanted."""
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
        """Dock the panels, once."""
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
    """Write text broken between words (ImGui breaks within words), over at least ``lines`` lines.

    The minimum keeps the controls below in place when the text changes.
    """
    columns = int(imgui.GetContentRegionAvail().x / imgui.CalcTextSize("n").x)
    broken = textwrap.wrap(text, max(columns, 10))
    for line in broken + [""] * (lines - len(broken)):
        imgui.TextUnformatted(line)


MESSAGE_LINES = 2
"""Lines reserved for the message to the user."""


def section(label: str, is_open: bool = True) -> bool:
    """Begin a section that can be folded; return whether it is unfolded."""
    flags = int(imgui.TreeNodeFlags.DefaultOpen) if is_open else 0
    return bool(imgui.CollapsingHeader(label, flags))


__all__ = ["MESSAGE_LINES", "Vec2", "Window", "arrow_shape", "imgui", "paragraph", "section"]


class PushPanel:
    """Impulse, direction and button of a push.

    Attributes:
        places: where its button is on the page, left, top, right, bottom, pixels.
    """

    def __init__(self, send: Callable[[ask.Push], None]) -> None:
        """Send pushes by ``send``."""
        self._send, self._impulse, self._direction = send, 20.0, 90.0
        self.places: dict[str, tuple[float, float, float, float]] = {}

    def push(self) -> None:
        """Push by the sliders' values."""
        self._send(ask.Push(self._impulse, math.radians(self._direction)))

    def draw(self) -> None:
        """Draw sliders and button."""
        imgui.SetNextItemWidth(-85.0)
        _, self._impulse = imgui.SliderFloat("N s", self._impulse, 0.0, 60.0, "%.0f")
        imgui.SetNextItemWidth(-85.0)
        _, self._direction = imgui.SliderFloat("deg", self._direction, -180.0, 180.0, "%.0f")
        imgui.SetItemTooltip("direction relative to the heading: 0 forward, 90 left")
        if imgui.Button("Push (P)", Vec2(-1.0, 0.0)):
            self.push()
        low, high = imgui.GetItemRectMin(), imgui.GetItemRectMax()
        self.places["push"] = (low.x, low.y, high.x, high.y)


class ReleasedSlider:
    """Sliders whose value is sent when they are released: the request takes time."""

    def __init__(self) -> None:
        self._draft: dict[str, float] = {}

    def draw(self, label: str, now: float, high: float, shown: str, width: float = -85.0) -> float | None:
        """Draw a slider from 0; return its value when it is released after a change."""
        imgui.SetNextItemWidth(width)
        changed, value = imgui.SliderFloat(label, self._draft.get(label, now), 0.0, high, shown)
        if changed:
            self._draft[label] = value
        if imgui.IsItemDeactivatedAfterEdit():
            return self._draft.pop(label, value)
        if not imgui.IsItemActive():
            self._draft.pop(label, None)
        return None


class EffectsPanel:
    """Each effect on or off, and its size."""

    def __init__(self, send: Callable[[ask.SetEffects], None]) -> None:
        """Send the selection by ``send``."""
        self._send, self._slider = send, ReleasedSlider()

    def draw(self, sizes: Mapping[str, float], texts: Mapping[str, str]) -> None:
        """Draw a checkbox and a slider for each effect of ``texts``, its description."""
        for name, text in texts.items():
            changed, on = imgui.Checkbox(f"##{name}", sizes.get(name, 0.0) > 0.0)
            if changed:
                self._send(ask.SetEffects({**sizes, name: 1.0 if on else 0.0}))
            imgui.SameLine()
            imgui.BeginDisabled(not sizes.get(name, 0.0) > 0.0)
            size = self._slider.draw(name, sizes.get(name, 0.0), LARGEST, "%.2f", -130.0)
            imgui.EndDisabled()
            imgui.SetItemTooltip(text)
            if size is not None:
                self._send(ask.SetEffects({**sizes, name: size}))
