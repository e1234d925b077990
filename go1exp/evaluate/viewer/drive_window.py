"""The window of a simulation: panels that send the user's requests, and curves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mujoco.studio.dear_imgui import dear_imgui as imgui

from go1exp.evaluate.video import steer
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.page_server import PUSH, STAND, Gamepad, steered
from go1exp.evaluate.viewer.walk import WalkView
from go1exp.evaluate.viewer.window import (
    MESSAGE_LINES,
    Curves,
    EffectsPanel,
    PushPanel,
    ReleasedSlider,
    Vec2,
    Window,
    arrow_shape,
    paragraph,
    section,
)

SLOW = imgui.Vec4(1.0, 0.7, 0.3, 1.0)

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

PUSH_KEY = imgui.Key.P

AXES = ("forward m/s", "left m/s", "yaw rad/s")
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0)
RATES = (None, 0.001, 0.002, 0.004, 0.005)  # physics steps to choose from, s; None is that of training
MOST_BUTTONS = 6  # number of policies up to which each has a button; more are a list
VELOCITIES = ("exact", "estimated")

HELP = ("arrows: forward, back, yaw", "comma, full stop: left, right", "0 zero, P push, space pause")


class DriveWindow(Window):
    """Panels of a simulation; ``places`` of controls on the page are left, top, right, bottom, pixels."""

    def __init__(self, pad: Gamepad) -> None:
        super().__init__("Robot", "Curves")
        self._command, self._pad, self._sticks = [0.0, 0.0, 0.0], pad, False
        self._push = PushPanel(self.ask)
        self._plots = Curves()
        self._effects, self._slider = EffectsPanel(self.ask), ReleasedSlider()
        self.places = self._push.places

    # ------------------------------------------------------------------ keys and gamepad

    def keys(self) -> None:
        """Answer keys."""
        view: WalkView = self.view
        before = list(self._command)
        for key, code in KEYS.items():
            if imgui.IsKeyPressed(key):
                steer(self._command, code)
        self._bounded(view)
        if self._command != before:
            self._steer()
        if imgui.IsKeyPressed(imgui.Key.Space, False):
            self.ask(ask.Pace(not view.pace.paused, view.pace.speed))
        if imgui.IsKeyPressed(PUSH_KEY, False):
            self._push.push()
        if imgui.IsKeyPressed(imgui.Key.Backspace, False):
            self.ask(ask.Reset())

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
            self._push.push()

    def _bounded(self, view: WalkView) -> None:
        self._command = [min(max(v, a), b) for v, (a, b) in zip(self._command, view.limits, strict=True)]

    def _steer(self) -> None:
        x, y, yaw = self._command
        self.ask(ask.Command((x, y, yaw)))

    # ------------------------------------------------------------------ panels

    def left(self) -> None:
        """Draw the panels."""
        view: WalkView = self.view
        self.gamepad()
        self._time(view)
        if section("Command"):
            self._command_panel(view)
        if section("Push"):
            self._push.draw()
        if section("Policy"):
            self._drivers_panel(view)
        if section("Ground"):
            self._ground_panel(view)
        if section("Sensors, delay, physics"):
            self._conditions_panel(view)
        if section("Effects", is_open=False):
            self._effects.draw(view.setup.sizes, view.effects)

    def right(self) -> None:
        """Draw the curves."""
        self._plots.draw(self.view)

    def scene(self) -> Iterable[Any]:
        """Return the arrows."""
        return [arrow_shape(arrow) for arrow in self.view.arrows]

    def _note(self, name: str) -> None:
        low, high = imgui.GetItemRectMin(), imgui.GetItemRectMax()
        self.places[name] = (low.x, low.y, high.x, high.y)

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
        changed, index = imgui.Combo("speed", _nearest(SPEEDS, pace.speed), [f"{v:g}x" for v in SPEEDS])
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
            self._note(name)
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
            level = self._slider.draw(f"level {ground.unit}", setup.level, ground.hardest, shown)
            if level is not None:
                self.ask(ask.SelectGround(setup.ground, level, setup.tile))

    def _conditions_panel(self, view: WalkView) -> None:
        now = ask.Conditions(view.setup.noise, view.setup.delay, view.setup.physics_dt, view.setup.trunk_velocity)
        wanted: dict[str, Any] = {}
        changed, noise = imgui.Checkbox("sensor noise", now.noise)
        if changed:
            wanted["noise"] = noise
        delay = self._slider.draw("delay ms", 1e3 * now.delay, 60.0, "%.0f")
        if delay is not None:
            wanted["delay"] = 1e-3 * delay
        imgui.SetNextItemWidth(-85.0)
        names = ["of training", *(f"{1.0 / dt:g} Hz" for dt in RATES if dt)]
        index = RATES.index(now.physics_dt) if now.physics_dt in RATES else 0
        changed, index = imgui.Combo("physics", index, names)
        imgui.SetItemTooltip(f"in force: {1.0 / view.physics_dt:g} Hz")
        if changed:
            wanted["physics_dt"] = RATES[index]
        imgui.SetNextItemWidth(-85.0)
        changed, index = imgui.Combo("velocity", VELOCITIES.index(now.trunk_velocity), list(VELOCITIES))
        imgui.SetItemTooltip("of the trunk, that the policy sees")
        if changed:
            wanted["trunk_velocity"] = VELOCITIES[index]
        if wanted:
            self.ask(ask.Conditions(**{**now.__dict__, **wanted}))


def _nearest(values: tuple[float, ...], value: float) -> int:
    return min(range(len(values)), key=lambda k: abs(values[k] - value))
