"""The window of a simulation: panels that send the user's requests, and curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.evaluate.video import steer
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.page_server import PUSH, STAND, Gamepad, steered
from go1exp.evaluate.viewer.session import SPAN
from go1exp.evaluate.viewer.walk import Reward, WalkView
from go1exp.evaluate.viewer.window import MESSAGE_LINES, SLOW, Line, LiveWindow, Vec2, paragraph, section

TOO_SLOW = "cannot keep real time"

KEYS = {
    imgui.Key.UpArrow: 265,
    imgui.Key.DownArrow: 264,
    imgui.Key.Comma: 44,
    imgui.Key.Period: 46,
    imgui.Key.LeftArrow: 263,
    imgui.Key.RightArrow: 262,
    imgui.Key.N0: 32,
}
"""Key -> its code in ``evaluate.video.STEERING``; 0 commands zero, as the space bar in the live window."""

AXES = ("forward m/s", "left m/s", "yaw rad/s")
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0)
RATES = (None, 0.001, 0.002, 0.004, 0.005)  # physics steps to choose from, s; None is that of training
MOST_BUTTONS = 6  # number of policies up to which each has a button; more are a list
VELOCITIES: tuple[TrunkVelocity, ...] = ("exact", "estimated")
VELOCITY_AXES = (("x", "m/s"), ("y", "m/s"), ("yaw", "rad/s"))
SPARK = 22.0  # height of a reward's curve, pixels
GOOD, BAD = imgui.Vec4(0.35, 0.75, 0.4, 0.9), imgui.Vec4(0.9, 0.4, 0.3, 0.9)
HELP = ("arrows: forward, back, yaw", "comma, full stop: left, right", "0 zero, P push, space pause")


class DriveWindow(LiveWindow):
    """Panels of a simulation."""

    def __init__(self, pad: Gamepad) -> None:
        super().__init__()
        self._command, self._pad, self._sticks = [0.0, 0.0, 0.0], pad, False

    def keys(self) -> None:
        """Answer keys."""
        view: WalkView = self.view
        before = list(self._command)
        for key, code in KEYS.items():
            if imgui.IsKeyPressed(key):
                steer(self._command, code)
        self._command = [min(max(v, a), b) for v, (a, b) in zip(self._command, view.limits, strict=True)]
        if self._command != before:
            self._steer()
        if imgui.IsKeyPressed(imgui.Key.Space, False):
            self.ask(ask.Pace(not view.pace.paused, view.pace.speed))
        super().keys()

    def gamepad(self) -> None:
        """Apply the gamepad: sticks scale to the sliders' ranges; released sticks command zero."""
        before, pushed = list(self._command), self._pad.sticks()
        if pushed is not None:
            self._command = steered(pushed, self.view.limits)
        presses = self._pad.presses()
        if (pushed is None and self._sticks) or STAND in presses:
            self._command = [0.0, 0.0, 0.0]
        self._sticks = pushed is not None
        if self._command != before:
            self._steer()
        for _ in range(presses.count(PUSH)):
            self.push()

    def _steer(self) -> None:
        x, y, yaw = self._command
        self.ask(ask.Command((x, y, yaw)))

    def left(self) -> None:
        """Draw the panels."""
        view: WalkView = self.view
        self.gamepad()
        self._time(view)
        if section("Command"):
            self._command_panel(view)
        if section("Push"):
            self.push_panel()
        if section("Policy"):
            self._drivers_panel(view)
        if section("Ground"):
            self._ground_panel(view)
        if section("Sensors, delay, physics"):
            self._conditions_panel(view)
        if section("Effects", is_open=False):
            self.effects_panel(view.setup.sizes, view.effects)

    def right(self) -> None:
        """Draw the curves."""
        view: WalkView = self.view
        if section("Velocity: commanded, true, estimated"):
            self._velocity(view)
        self.body_curves()
        if section(f"Rewards: {len(view.rewards)} terms, {view.total:+.2f} per s"):
            self._rewards(view.rewards)

    def _time(self, view: WalkView) -> None:
        pace = view.pace
        if imgui.Button("Run" if pace.paused else "Pause"):
            self.ask(ask.Pace(not pace.paused, pace.speed))
        imgui.SameLine()
        imgui.BeginDisabled(not pace.paused)
        if imgui.Button("Step"):
            self.ask(ask.Step())
        imgui.EndDisabled()
        imgui.SameLine()
        if imgui.Button("Reset"):
            self.ask(ask.Reset())
        imgui.SameLine()
        _, self.follow = imgui.Checkbox("follow", self.follow)
        imgui.SetNextItemWidth(70.0)
        near = min(range(len(SPEEDS)), key=lambda k: abs(SPEEDS[k] - pace.speed))
        changed, index = imgui.Combo("speed", near, [f"{v:g}x" for v in SPEEDS])
        if changed:
            self.ask(ask.Pace(pace.paused, SPEEDS[index]))
        imgui.SameLine()
        imgui.TextUnformatted("paused" if pace.paused else f"{view.achieved:.2f}x")
        imgui.SameLine()
        imgui.TextUnformatted(f"{view.time:.1f} s")
        slow = not pace.paused and view.achieved < 0.9 * pace.speed
        imgui.TextColored(SLOW, TOO_SLOW if slow else "")  # a line in any case: what is below must not jump
        paragraph(view.message, MESSAGE_LINES)

    def _command_panel(self, view: WalkView) -> None:
        for axis, (name, (low, high)) in enumerate(zip(AXES, view.limits, strict=True)):
            imgui.SetNextItemWidth(-85.0)
            changed, value = imgui.SliderFloat(name, self._command[axis], low, high, "%.2f")
            self.note(name)
            if changed:
                self._command[axis] = value
                self._steer()
            elif not imgui.IsAnyItemActive() and not self._sticks:
                self._command[axis] = view.command[axis]
        if imgui.Button("Zero (0)", Vec2(-1.0, 0.0)):
            self._command = [0.0, 0.0, 0.0]
            self._steer()
        for line in HELP:
            imgui.TextDisabled(line)

    def _drivers_panel(self, view: WalkView) -> None:
        if len(view.labels) > MOST_BUTTONS:
            imgui.SetNextItemWidth(-85.0)
            changed, index = imgui.Combo("policy", view.labels.index(view.label), list(view.labels))
            if changed:
                self.ask(ask.SelectPolicy(view.labels[index]))
            return
        for label in view.labels:
            if imgui.RadioButton(label, label == view.label):
                self.ask(ask.SelectPolicy(label))

    def _ground_panel(self, view: WalkView) -> None:
        setup, names = view.setup, list(view.grounds)
        imgui.SetNextItemWidth(-85.0)
        changed, index = imgui.Combo("ground", names.index(setup.ground), names)
        if changed:
            self.ask(ask.SelectGround(names[index], 0.3 * view.grounds[names[index]].hardest))
        ground = view.grounds[setup.ground]
        if ground.tiles:
            tile = setup.tile if setup.tile in ground.tiles else ground.tiles[0]
            imgui.SetNextItemWidth(-85.0)
            changed, index = imgui.Combo("tile", ground.tiles.index(tile), list(ground.tiles))
            if changed:
                self.ask(ask.SelectGround(setup.ground, setup.level, ground.tiles[index]))
        if ground.hardest:
            shown = "%.0f" if ground.tiles else "%.2f"
            level = self.released_slider(f"level {ground.unit}", setup.level, ground.hardest, shown)
            if level is not None:
                self.ask(ask.SelectGround(setup.ground, level, setup.tile))

    def _conditions_panel(self, view: WalkView) -> None:
        now = ask.Conditions(view.setup.noise, view.setup.delay, view.setup.physics_dt, view.setup.trunk_velocity)
        wanted = now
        changed, noise = imgui.Checkbox("sensor noise", now.noise)
        if changed:
            wanted = replace(wanted, noise=noise)
        delay = self.released_slider("delay ms", 1e3 * now.delay, 60.0, "%.0f")
        if delay is not None:
            wanted = replace(wanted, delay=1e-3 * delay)
        imgui.SetNextItemWidth(-85.0)
        names = ["of training", *(f"{1.0 / dt:g} Hz" for dt in RATES if dt)]
        index = RATES.index(now.physics_dt) if now.physics_dt in RATES else 0
        changed, index = imgui.Combo("physics", index, names)
        imgui.SetItemTooltip(f"in force: {1.0 / view.physics_dt:g} Hz")
        if changed:
            wanted = replace(wanted, physics_dt=RATES[index])
        imgui.SetNextItemWidth(-85.0)
        changed, index = imgui.Combo("velocity", VELOCITIES.index(now.trunk_velocity), list(VELOCITIES))
        imgui.SetItemTooltip("of the trunk, that the policy sees")
        if changed:
            wanted = replace(wanted, trunk_velocity=VELOCITIES[index])
        if wanted is not now:
            self.ask(wanted)

    def _velocity(self, view: WalkView) -> None:
        for axis, (name, unit) in enumerate(VELOCITY_AXES):
            lines: list[Line] = [("estimated", view.estimated[axis])] if view.estimated else []
            lines += [("commanded", view.command_curves[axis]), ("true", view.true[axis])]  # the last one lies on top
            self.plot(f"##{name}", f"{name}  {unit}", lines, view.limits[axis])

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
