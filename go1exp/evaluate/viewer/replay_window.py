"""The window of a recording, or of a result of ``go1exp gap``: a time line, and the joint's curves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from go1exp.evaluate.viewer.replay import MODELS, MOST, UNITS, Change, Ghost, Piece, ReplayView, Story
from go1exp.evaluate.viewer.window import Vec2, Window, paragraph, section

COLOURS: dict[str, tuple[float, float, float, float]] = {
    "measured": (0.35, 0.65, 1.0, 0.45),
    "target": (1.0, 0.75, 0.2, 0.3),
    "after": (0.45, 0.75, 0.5, 1.0),
}
"""Of the robots beside the model's own: red, green, blue, opacity."""

SPEEDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)
NAMES = {"q": "angle", "qd": "velocity", "tau_est": "torque, reported", "tau_cmd": "torque, commanded"}
HEIGHT = 165.0  # of a plot, pixels
Curve = tuple[str, list[float], list[float]]  # name, times in s, values
NOW = imgui.Vec4(1.0, 1.0, 1.0, 0.6)


class ReplayWindow(Window):
    """Panels for a recording or an answer."""

    def __init__(self, story: Story) -> None:
        super().__init__("Recording", "Curves")
        self._story = story
        self._joint = 0
        self._ghosts_shown = True
        self._scenes: list[tuple[mujoco.MjvScene, mujoco.MjData]] = []
        self._model: mujoco.MjModel | None = None
        self._key: tuple[int, str] | None = None
        self._lines: dict[str, dict[str, list[Curve]]] = {}

    def sight(self) -> tuple[np.ndarray, float]:
        """Return a place between the robots, from far enough to see all."""
        shift = max((ghost.shift for ghost in self.view.ghosts), key=lambda v: float(abs(v).sum()), default=np.zeros(3))
        self.follow = self.follow and not shift.any()
        return 0.5 * shift, 1.6 + float(np.linalg.norm(shift))

    def scene(self) -> Iterable[mujoco.MjvGeom]:
        """Return the shapes of the robots beside the model's own."""
        view: ReplayView = self.view
        if not self._ghosts_shown:
            return []
        if self._model is not self.viewer.model or len(self._scenes) != len(view.ghosts):
            self._model = self.viewer.model
            self._scenes = [(mujoco.MjvScene(self._model, 500), mujoco.MjData(self._model)) for _ in view.ghosts]
        shapes: list[mujoco.MjvGeom] = []
        for ghost, (scene, data) in zip(view.ghosts, self._scenes, strict=True):
            if len(ghost.qpos) == self._model.nq:
                shapes += self._shapes(ghost, scene, data)
        return shapes

    def _shapes(self, ghost: Ghost, scene: mujoco.MjvScene, data: mujoco.MjData) -> list[mujoco.MjvGeom]:
        assert self._model is not None
        data.qpos[:] = ghost.qpos
        mujoco.mj_kinematics(self._model, data)
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_updateScene(self._model, data, self.viewer.vis_options, None, self.viewer.camera, moving, scene)
        shapes = [scene.geoms[k] for k in range(scene.ngeom)]
        for geom in shapes:
            geom.pos[:] += ghost.shift
            geom.rgba[:] = COLOURS[ghost.name]
            geom.matid = -1
            geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
        return shapes

    def keys(self) -> None:
        """Answer keys."""
        view: ReplayView = self.view
        if imgui.IsKeyPressed(imgui.Key.Space, False):
            self.ask(Change(running=not view.running))
        step = 0.01 * self._story.pieces[view.number].duration
        for key, sign in ((imgui.Key.LeftArrow, -1.0), (imgui.Key.RightArrow, 1.0)):
            if imgui.IsKeyPressed(key):
                self.ask(Change(time=view.time + sign * step))
        for key, sign in ((imgui.Key.UpArrow, -1), (imgui.Key.DownArrow, 1)):
            if imgui.IsKeyPressed(key):
                self.ask(Change(piece=view.number + sign))

    def left(self) -> None:
        """Draw time line, pieces and joints."""
        view: ReplayView = self.view
        piece = self._story.pieces[view.number]
        paragraph(self._story.about)
        if section("Time"):
            self._time(view, piece)
        if self._story.kind == "gap" and section("Shown"):
            self._shown(view)
        if len(self._story.pieces) > 1 and section("Held-out windows"):
            for k, other in enumerate(self._story.pieces):
                if imgui.RadioButton(f"{other.title}##{k}", k == view.number):
                    self.ask(Change(piece=k))
        if section("Joint: error of the angle, mrad"):
            self._joints(piece)

    def _time(self, view: ReplayView, piece: Piece) -> None:
        if imgui.Button("Pause" if view.running else "Play"):
            self.ask(Change(running=not view.running))
        imgui.SameLine()
        imgui.SetNextItemWidth(80.0)
        near = min(range(len(SPEEDS)), key=lambda k: abs(SPEEDS[k] - view.speed))
        changed, index = imgui.Combo("speed", near, [f"{v:g}x" for v in SPEEDS])
        if changed:
            self.ask(Change(speed=SPEEDS[index]))
        if self._story.kind == "log":  # the camera cannot follow two robots
            imgui.SameLine()
            _, self.follow = imgui.Checkbox("follow", self.follow)
        imgui.SetNextItemWidth(-40.0)
        changed, time = imgui.SliderFloat("s", view.time, 0.0, piece.duration, "%.3f")
        if changed:
            self.ask(Change(time=time))
        imgui.TextDisabled("space: play, pause")
        imgui.TextDisabled("arrows: time, window")

    def _shown(self, view: ReplayView) -> None:
        imgui.SetNextItemWidth(-110.0)
        changed, times = imgui.SliderFloat("magnified", view.magnify, 1.0, MOST, "%.0f times")
        if changed:
            self.ask(Change(magnify=times))
        paragraph("errors in the scene only; curves and numbers are not magnified")
        _, self._ghosts_shown = imgui.Checkbox("measured, and after", self._ghosts_shown)
        paragraph("Left: before, the nominal model. Right, green: after, with the identified effects. Blue: measured.")

    def _joints(self, piece: Piece) -> None:
        errors = piece.errors()
        names = [m.name for m in piece.motions[1:]]
        if not imgui.BeginTable("joints", 1 + len(names), int(imgui.TableFlags.SizingStretchProp)):
            return
        for name in ("joint", *names):
            imgui.TableSetupColumn(name)
        imgui.TableHeadersRow()
        for k, joint in enumerate(piece.joints):
            imgui.TableNextRow()
            imgui.TableNextColumn()
            if imgui.RadioButton(joint, k == self._joint):
                self._joint = k
            for name in names:
                imgui.TableNextColumn()
                imgui.TextUnformatted(f"{1e3 * errors[joint][name]:.2f}")
        imgui.EndTable()

    def right(self) -> None:
        """Draw the curves of the chosen joint."""
        view: ReplayView = self.view
        piece = self._story.pieces[view.number]
        joint = piece.joints[min(self._joint, len(piece.joints) - 1)]
        key = (view.number, joint)
        if key != self._key:
            self._key, self._lines = key, _lines(piece, joint)
        for quantity, lines in self._lines.items():
            label = NAMES.get(quantity, quantity)
            if section(f"{joint}: {label}"):
                self._plot(f"##{quantity}", UNITS.get(quantity, ""), lines["values"], view.time, piece)
                if lines["errors"]:
                    self._plot(f"##e{quantity}", f"error {UNITS[quantity]}", lines["errors"], view.time, piece)

    def _plot(self, label: str, unit: str, lines: Sequence[Curve], now: float, piece: Piece) -> None:
        flags = int(implot.Flags.NoMenus) | int(implot.Flags.NoTitle) | int(implot.Flags.NoMouseText)
        if not implot.BeginPlot(label, Vec2(-1.0, HEIGHT), flags):
            return
        margin = Vec2(0.0, 0.1)  # or a constant error lies on the frame, unseen
        implot.PushStyleVar(int(implot.StyleVar.FitPadding), margin)
        fit = int(implot.AxisFlags.AutoFit)
        implot.SetupAxes("time, s", unit, 0, fit)
        implot.SetupAxisLimits(int(implot.Axis.X1), 0.0, piece.duration, int(implot.Cond.Once))
        outside = int(implot.LegendFlags.Horizontal) | int(implot.LegendFlags.Outside)
        implot.SetupLegend(int(implot.Location.North), outside)
        for name, t, values in lines:
            implot.PlotLine(name, t, values)
        implot.TagX(now, NOW, f"{now:.3f}")
        implot.EndPlot()
        implot.PopStyleVar()


def _lines(piece: Piece, joint: str) -> dict[str, dict[str, list[Curve]]]:
    """Return the curves of a joint by quantity, ready to be drawn: values, errors, and the noise beside errors."""
    t = thinned(piece.t - piece.t[0])
    drawn = {}
    for quantity, by_joint in piece.curves.items():
        curves = by_joint[joint]
        values = [(name, t, thinned(v)) for name, v in curves.items()]
        models = {name: v for name, v in curves.items() if name in MODELS}
        errors = [(name, t, thinned(v - curves["measured"])) for name, v in models.items()]
        if errors:  # a line for what was measured, so that the others keep their colours
            errors.insert(0, ("measured", t, [0.0] * len(t)))
        if errors and joint in piece.noise.get(quantity, {}):
            level = piece.noise[quantity][joint]
            errors += [("noise", t, [sign * level] * len(t)) for sign in (1.0, -1.0)]
        drawn[quantity] = {"values": values, "errors": errors}
    return drawn


def thinned(values: np.ndarray, most: int = 1500) -> list[float]:
    """Return at most about ``most`` values, evenly spaced, for a curve."""
    every = -(-len(values) // most)
    return [float(v) for v in values[::every]]
