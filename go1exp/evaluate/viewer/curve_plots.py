"""Curves of a simulated robot, drawn with ImPlot."""

from __future__ import annotations

from collections.abc import Sequence

from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from go1exp import robot
from go1exp.evaluate.viewer.session import SPAN
from go1exp.evaluate.viewer.walk import Reward, Timed, WalkView
from go1exp.evaluate.viewer.window import Vec2, section

VELOCITIES = (("x", "m/s"), ("y", "m/s"), ("yaw", "rad/s"))

HEIGHT, TALL, ROW, SPARK = 110.0, 250.0, 15.0, 22.0
"""Of a plot, of one with a line for each joint, of a leg in the contact diagram, and of a reward's curve, pixels."""

PLAIN = int(implot.Flags.NoMenus) | int(implot.Flags.NoBoxSelect) | int(implot.Flags.NoMouseText)

GOOD, BAD, FOOT, PUSHED = (
    imgui.Vec4(0.35, 0.75, 0.4, 0.9),
    imgui.Vec4(0.9, 0.4, 0.3, 0.9),
    imgui.Vec4(0.45, 0.7, 1.0, 1.0),
    imgui.Vec4(1.0, 0.45, 0.2, 0.8),
)

Line = tuple[str, Sequence[float]]


class Curves:
    """The panel of curves."""

    def draw(self, view: WalkView) -> None:
        """Draw all sections that are unfolded."""
        if section("Velocity: commanded, true, estimated"):
            self._velocity(view)
        if section("Contacts"):
            self.contacts(view)
        if section("Trunk height"):
            self.plot("##height", "m", view, [("height", view.height)], (0.0, 0.5))
        if section("Torque / limit"):
            lines = list(zip(robot.JOINTS, view.torque, strict=False))
            self.plot("##torque", "-", view, lines, (0.0, 1.05), TALL)
        if section(f"Rewards: {len(view.rewards)} terms, {view.total:+.2f} per s"):
            self._rewards(view.rewards)

    def _velocity(self, view: WalkView) -> None:
        for axis, (name, unit) in enumerate(VELOCITIES):
            lines: list[Line] = [("estimated", view.estimated[axis])] if view.estimated else []
            lines += [("commanded", view.command_curves[axis]), ("true", view.true[axis])]  # the last one lies on top
            low, high = view.limits[axis]
            self.plot(f"##{name}", f"{name}  {unit}", view, lines, (low, high))

    def plot(
        self,
        label: str,
        unit: str,
        view: Timed,
        lines: Sequence[Line],
        reach: tuple[float, float],
        height: float = HEIGHT,
    ) -> None:
        """Draw lines over the last seconds, with a mark where the robot was pushed."""
        flags = PLAIN | int(implot.Flags.NoTitle) | (int(implot.Flags.NoLegend) if len(lines) == 1 else 0)
        if not implot.BeginPlot(label, Vec2(-1.0, height), flags):
            return
        implot.SetupAxes("", unit, 0, 0)
        implot.SetupAxisLimits(int(implot.Axis.X1), -SPAN, 0.0, int(implot.Cond.Always))
        implot.SetupAxisLimits(int(implot.Axis.Y1), *reach, int(implot.Cond.Once))
        implot.SetupLegend(int(implot.Location.East), int(implot.LegendFlags.Outside))
        for name, values in lines:
            implot.PlotLine(name, view.t, values)
        for t in view.pushes:
            implot.TagX(t, PUSHED, "push")
        implot.EndPlot()

    def contacts(self, view: Timed) -> None:
        """Draw a bar for each contact of a foot."""
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

    def _rewards(self, rewards: Sequence[Reward]) -> None:
        """Draw a row for each term: its name, its mean of the last second, a bar, and its curve."""
        largest = max((abs(r.mean) for r in rewards), default=0.0) or 1.0
        if not imgui.BeginTable("rewards", 4, int(imgui.TableFlags.SizingFixedFit)):
            return
        stretch = int(imgui.TableColumnFlags.WidthStretch)
        for name, flags in (("term", 0), ("per s", 0), ("mean of 1 s", stretch), (f"last {SPAN:g} s", stretch)):
            imgui.TableSetupColumn(name, flags)
        imgui.TableHeadersRow()
        for reward in rewards:
            self._reward(reward, largest)
        imgui.EndTable()

    def _reward(self, reward: Reward, largest: float) -> None:
        imgui.TableNextRow()
        imgui.TableNextColumn()
        imgui.TextUnformatted(reward.name)
        imgui.TableNextColumn()
        imgui.TextUnformatted(f"{reward.mean:+7.3f}")
        imgui.TableNextColumn()
        corner, width = imgui.GetCursorScreenPos(), imgui.GetContentRegionAvail().x
        middle = corner.x + 0.5 * width
        end = middle + 0.5 * width * reward.mean / largest
        colour = imgui.GetColorU32(GOOD if reward.mean >= 0.0 else BAD)
        box = Vec2(min(middle, end), corner.y + 4.0), Vec2(max(middle, end, middle + 1.0), corner.y + SPARK - 4.0)
        imgui.GetWindowDrawList().AddRectFilled(*box, colour)
        imgui.Dummy(Vec2(width, SPARK))
        imgui.TableNextColumn()
        flags = int(implot.Flags.CanvasOnly) | int(implot.Flags.NoInputs) | int(implot.Flags.NoFrame)
        implot.PushStyleVar(int(implot.StyleVar.PlotPadding), Vec2(0.0, 1.0))  # or nothing is left of so small a plot
        if reward.curve and implot.BeginPlot(f"##{reward.name}", Vec2(-1.0, SPARK), flags):
            axis = int(implot.AxisFlags.NoDecorations) | int(implot.AxisFlags.AutoFit)
            implot.SetupAxes("", "", axis, axis)
            implot.PlotLine("value", list(range(len(reward.curve))), reward.curve)
            implot.EndPlot()
        implot.PopStyleVar()
