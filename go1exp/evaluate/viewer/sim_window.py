"""The window of ``go1exp sim viewer=web``: who drives the robot and how well in time, pushes, and curves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from go1exp import robot
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.curve_plots import PLAIN, TALL, Curves
from go1exp.evaluate.viewer.drive_window import PUSH_KEY, SLOW
from go1exp.evaluate.viewer.history import SPAN
from go1exp.evaluate.viewer.panels import EffectsPanel, PushPanel
from go1exp.evaluate.viewer.sim_show import SimView
from go1exp.evaluate.viewer.window import MESSAGE_LINES, Vec2, Window, arrow_shape, paragraph, section

PACKETS = 150.0
"""Height of the plot of intervals, pixels."""

LEAST_MS = 5.0
"""The axis of the intervals reaches at least as far, ms."""

BEHIND_S = 0.001
"""Time behind from which the robot is said to be late, s."""


class SimWindow(Window):
    """Panels for a robot that somebody else drives.

    Attributes:
        places: where controls are on the page, left, top, right, bottom, pixels.
    """

    def __init__(self) -> None:
        super().__init__("Robot", "Curves")
        self._push, self._effects = PushPanel(self.ask), EffectsPanel(self.ask)
        self._plots = Curves()

    @property
    def places(self) -> dict[str, tuple[float, float, float, float]]:
        """Where controls are on the page."""
        return self._push.places

    def keys(self) -> None:
        """Answer keys."""
        if imgui.IsKeyPressed(PUSH_KEY, False):
            self._push.push()
        if imgui.IsKeyPressed(imgui.Key.Backspace, False):
            self.ask(ask.Reset())

    def scene(self) -> Iterable[Any]:
        """Return the arrow of a push."""
        return [arrow_shape(arrow) for arrow in self.view.arrows]

    def left(self) -> None:
        """Draw the panels."""
        view: SimView = self.view
        if imgui.Button("Put back"):
            self.ask(ask.Reset())
        imgui.SetItemTooltip("into its first state (Backspace); its client is not told")
        imgui.SameLine()
        _, self.follow = imgui.Checkbox("follow", self.follow)
        imgui.SameLine()
        imgui.TextUnformatted(f"{view.time:.1f} s")
        paragraph(view.posture)
        late = f"{1e3 * view.slipped:.0f} ms behind real time since it began" if view.slipped > BEHIND_S else ""
        imgui.TextColored(SLOW, late)
        paragraph(view.message, MESSAGE_LINES)
        if section("Who speaks"):
            self._speaker(view)
        if section("Push"):
            self._push.draw()
        if section("Effects", is_open=False):
            self._effects.draw(view.sizes, view.known)

    def _speaker(self, view: SimView) -> None:
        p = view.packets
        if p.peer is None:
            paragraph("nobody yet")
        else:
            paragraph(p.peer if p.speaking else f"nobody; {p.peer} did")
        rows = [("packets in, last 1 s", f"{p.rate}"), ("states out, per s", f"{p.answers:.0f}")]
        for label, times in (("interval", p.every), ("new command", p.new)):
            spread = ((name, getattr(times, name)) for name in ("p50", "p99", "worst"))
            rows += [(f"{label} {name}, ms", "-" if math.isnan(v) else f"{v:.2f}") for name, v in spread]
        rows += [("lost by the network", f"{p.lost}"), ("refused", f"{sum(p.refused.values())}")]
        rows += [(f"  {why}", f"{count}") for why, count in p.refused.items()]
        if not imgui.BeginTable("packets", 2, int(imgui.TableFlags.SizingStretchProp)):
            return
        for row in rows:
            imgui.TableNextRow()
            for text in row:
                imgui.TableNextColumn()
                imgui.TextUnformatted(text)
        imgui.EndTable()

    def right(self) -> None:
        """Draw the curves."""
        view: SimView = self.view
        if section("Client's timing: every packet, new commands"):
            self._intervals(view)
        if section("True velocity"):
            lines = list(zip(("forward m/s", "left m/s", "turn rad/s"), view.velocity, strict=True))
            self._plots.plot("##velocity", "", view, lines, (-1.5, 1.5))
        if section("Contacts"):
            self._plots.contacts(view)
        if section("Trunk height"):
            self._plots.plot("##height", "m", view, [("height", view.height)], (0.0, 0.5))
        if section("Torque over its limit"):
            lines = list(zip(robot.JOINTS, view.torque, strict=True))
            self._plots.plot("##torque", "-", view, lines, (0.0, 1.05), TALL)

    def _intervals(self, view: SimView) -> None:
        """Draw a point for each packet of the last seconds."""
        p = view.packets
        if not implot.BeginPlot("##intervals", Vec2(-1.0, PACKETS), PLAIN | int(implot.Flags.NoTitle)):
            return
        implot.SetupAxes("", "ms", 0, 0)
        implot.SetupAxisLimits(int(implot.Axis.X1), -SPAN, 0.0, int(implot.Cond.Always))
        top = 1.1 * max([LEAST_MS, *p.every.interval, *p.new.interval])
        implot.SetupAxisLimits(int(implot.Axis.Y1), 0.0, top, int(implot.Cond.Always))
        outside = int(implot.LegendFlags.Horizontal) | int(implot.LegendFlags.Outside)
        implot.SetupLegend(int(implot.Location.North), outside)
        for name, times in (("every packet", p.every), ("new command", p.new)):
            if times.t:
                implot.PlotScatter(name, times.t, times.interval)
        implot.EndPlot()
