"""Base of the viewer's windows: docked panels, a camera that follows, the mouse, arrows; shared panels and curves."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from go1exp import robot
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.requests import LARGEST
from go1exp.evaluate.viewer.session import SPAN
from go1exp.evaluate.viewer.walk import Arrow, Timed
from go1exp.evaluate.viewer.web import Ask, Shown
from go1exp.sim.env.camera import AZIMUTH, DISTANCE, ELEVATION

LEFT, RIGHT = 0.23, 0.42  # width of the panels: the left one's share of the window, and the right one's of what is left
ARROW_WIDTH = 0.013  # m
Vec2 = imgui.Vec2


class Window(plugin.ViewerPlugin):
    """Base of the windows: draws ``view``, None before the first one; the camera goes with the robot to ``follow``."""

    def __init__(self, *panels: str) -> None:
        """Dock two panels of these names at the left and at the right."""
        self.view: Any = None
        self.follow, self._left, self._right = True, *panels
        self._docked = self._looking = False
        self._ux = ux.UxState()

    def left(self) -> None:
        """Fill the left panel."""
        raise NotImplementedError

    def right(self) -> None:
        """Fill the right panel."""
        raise NotImplementedError

    def keys(self) -> None:
        """Handle keys."""

    def scene(self) -> Iterable[mujoco.MjvGeom]:
        """Return shapes (``MjvGeom``) beside the model's own."""
        return ()

    def sight(self) -> tuple[np.ndarray, float]:
        """Return the camera's first target relative to the robot, m, and its distance, relative to that of a clip."""
        return np.zeros(3), 1.6

    def ask(self, request: object) -> None:
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


def arrow_shape(arrow: Arrow) -> mujoco.MjvGeom:
    """Return an arrow as a shape of the scene."""
    geom, kind = mujoco.MjvGeom(), mujoco.mjtGeom.mjGEOM_ARROW
    rgba = np.array([*arrow.rgb, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
    mujoco.mjv_connector(geom, kind, ARROW_WIDTH, arrow.start, arrow.end)
    geom.emission = 0.5  # bright whatever the light
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    return geom


def paragraph(text: str, lines: int = 0) -> None:
    """Write text broken between words, over at least ``lines`` lines, so that the controls below stay in place."""
    columns = int(imgui.GetContentRegionAvail().x / imgui.CalcTextSize("n").x)
    broken = textwrap.wrap(text, max(columns, 10))
    for line in broken + [""] * (lines - len(broken)):
        imgui.TextUnformatted(line)


MESSAGE_LINES = 2  # lines reserved for the message to the user


def section(label: str, is_open: bool = True) -> bool:
    """Begin a section that can be folded; return whether it is unfolded."""
    flags = int(imgui.TreeNodeFlags.DefaultOpen) if is_open else 0
    return bool(imgui.CollapsingHeader(label, flags))


PLOT, TALL, ROW = 110.0, 250.0, 15.0  # height of a plot, of one with a line for each joint, of a leg's contacts, pixels
PLAIN = int(implot.Flags.NoMenus) | int(implot.Flags.NoBoxSelect) | int(implot.Flags.NoMouseText)
FOOT, PUSHED = imgui.Vec4(0.45, 0.7, 1.0, 1.0), imgui.Vec4(1.0, 0.45, 0.2, 0.8)
SLOW = imgui.Vec4(1.0, 0.7, 0.3, 1.0)
Line = tuple[str, Sequence[float]]


class LiveWindow(Window):
    """Base of the windows of a robot that moves: pushes, effects, arrows and curves."""

    def __init__(self) -> None:
        super().__init__("Robot", "Curves")
        self._impulse, self._direction = 20.0, 90.0
        self._drafts: dict[str, float] = {}  # values of sliders that are not released yet
        self.places: dict[str, tuple[float, float, float, float]] = {}  # of controls: left, top, right, bottom, pixels

    def keys(self) -> None:
        """Push by P, reset by Backspace."""
        if imgui.IsKeyPressed(imgui.Key.P, False):
            self.push()
        if imgui.IsKeyPressed(imgui.Key.Backspace, False):
            self.ask(ask.Reset())

    def scene(self) -> Iterable[mujoco.MjvGeom]:
        """Return the arrows."""
        return [arrow_shape(arrow) for arrow in self.view.arrows]

    def note(self, name: str) -> None:
        """Note the place of the last control."""
        low, high = imgui.GetItemRectMin(), imgui.GetItemRectMax()
        self.places[name] = (low.x, low.y, high.x, high.y)

    def push(self) -> None:
        """Push by the sliders' values."""
        self.ask(ask.Push(self._impulse, math.radians(self._direction)))

    def push_panel(self) -> None:
        """Draw impulse, direction and button of a push."""
        imgui.SetNextItemWidth(-85.0)
        _, self._impulse = imgui.SliderFloat("N s", self._impulse, 0.0, 60.0, "%.0f")
        imgui.SetNextItemWidth(-85.0)
        _, self._direction = imgui.SliderFloat("deg", self._direction, -180.0, 180.0, "%.0f")
        imgui.SetItemTooltip("direction relative to the heading: 0 forward, 90 left")
        if imgui.Button("Push (P)", Vec2(-1.0, 0.0)):
            self.push()
        self.note("push")

    def released_slider(self, label: str, now: float, high: float, shown: str, width: float = -85.0) -> float | None:
        """Draw a slider from 0; return its value when it is released after a change: the request takes time."""
        imgui.SetNextItemWidth(width)
        changed, value = imgui.SliderFloat(label, self._drafts.get(label, now), 0.0, high, shown)
        if changed:
            self._drafts[label] = value
        if imgui.IsItemDeactivatedAfterEdit():
            return self._drafts.pop(label, value)
        if not imgui.IsItemActive():
            self._drafts.pop(label, None)
        return None

    def effects_panel(self, sizes: Mapping[str, float], texts: Mapping[str, str]) -> None:
        """Draw a checkbox and a slider for each effect of ``texts``, its description."""
        for name, text in texts.items():
            changed, on = imgui.Checkbox(f"##{name}", sizes.get(name, 0.0) > 0.0)
            if changed:
                self.ask(ask.SetEffects({**sizes, name: 1.0 if on else 0.0}))
            imgui.SameLine()
            imgui.BeginDisabled(not sizes.get(name, 0.0) > 0.0)
            size = self.released_slider(name, sizes.get(name, 0.0), LARGEST, "%.2f", -130.0)
            imgui.EndDisabled()
            imgui.SetItemTooltip(text)
            if size is not None:
                self.ask(ask.SetEffects({**sizes, name: size}))

    def body_curves(self) -> None:
        """Draw the sections of contacts, height and torque."""
        view: Timed = self.view
        if section("Contacts"):
            self._contacts(view)
        if section("Trunk height"):
            self.plot("##height", "m", [("height", view.height)], (0.0, 0.5))
        if section("Torque / limit"):
            lines = list(zip(robot.JOINTS, view.torque, strict=False))
            self.plot("##torque", "-", lines, (0.0, 1.05), tall=True)

    def plot(self, key: str, unit: str, lines: Sequence[Line], reach: tuple[float, float], tall: bool = False) -> None:
        """Draw lines over the last seconds, with a mark where the robot was pushed."""
        flags = PLAIN | int(implot.Flags.NoTitle) | (int(implot.Flags.NoLegend) if len(lines) == 1 else 0)
        if not implot.BeginPlot(key, Vec2(-1.0, TALL if tall else PLOT), flags):
            return
        implot.SetupAxes("", unit, 0, 0)
        implot.SetupAxisLimits(int(implot.Axis.X1), -SPAN, 0.0, int(implot.Cond.Always))
        implot.SetupAxisLimits(int(implot.Axis.Y1), *reach, int(implot.Cond.Once))
        implot.SetupLegend(int(implot.Location.East), int(implot.LegendFlags.Outside))
        for name, values in lines:
            implot.PlotLine(name, self.view.t, values)
        for t in self.view.pushes:
            implot.TagX(t, PUSHED, "push")
        implot.EndPlot()

    def _contacts(self, view: Timed) -> None:
        imgui.BeginGroup()
        for leg in robot.LEGS:
            imgui.TextUnformatted(leg)
        imgui.EndGroup()
        imgui.SameLine()
        corner, width = imgui.GetCursorScreenPos(), imgui.GetContentRegionAvail().x
        pitch = imgui.GetFontSize() + 4.0
        draw, colour = imgui.GetWindowDrawList(), imgui.GetColorU32(FOOT)
        for row, runs in enumerate(view.contacts):
            top = corner.y + row * pitch
            for start, end in runs:
                a, b = (corner.x + width * (1.0 + max(t, -SPAN) / SPAN) for t in (start, end))
                draw.AddRectFilled(Vec2(a, top), Vec2(b, top + ROW), colour)
        for t in view.pushes:
            x = corner.x + width * (1.0 + t / SPAN)
            draw.AddLine(Vec2(x, corner.y), Vec2(x, corner.y + 4 * pitch), imgui.GetColorU32(PUSHED))
        imgui.Dummy(Vec2(width, 4 * pitch))
