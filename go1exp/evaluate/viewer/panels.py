"""Panels that more than one window has."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from mujoco.studio.dear_imgui import dear_imgui as imgui

from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.effects import LARGEST
from go1exp.evaluate.viewer.window import Vec2


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
        """Push as the sliders say."""
        self._send(ask.Push(self._impulse, math.radians(self._direction)))

    def draw(self) -> None:
        """Draw sliders and button."""
        imgui.SetNextItemWidth(-85.0)
        _, self._impulse = imgui.SliderFloat("N s", self._impulse, 0.0, 60.0, "%.0f")
        imgui.SetNextItemWidth(-85.0)
        _, self._direction = imgui.SliderFloat("deg", self._direction, -180.0, 180.0, "%.0f")
        imgui.SetItemTooltip("where to, from the robot's heading: 0 forward, 90 to its left")
        if imgui.Button("Push (P)", Vec2(-1.0, 0.0)):
            self.push()
        low, high = imgui.GetItemRectMin(), imgui.GetItemRectMax()
        self.places["push"] = (low.x, low.y, high.x, high.y)


class ReleasedSlider:
    """Sliders whose value counts when they are let go: what they ask for takes time."""

    def __init__(self) -> None:
        self._draft: dict[str, float] = {}

    def draw(self, label: str, now: float, high: float, shown: str, width: float = -85.0) -> float | None:
        """Draw a slider from 0; return its value when it is let go after a change."""
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

    def __init__(self, send: Callable[[ask.Effects], None]) -> None:
        """Send what is chosen by ``send``."""
        self._send, self._slider = send, ReleasedSlider()

    def draw(self, sizes: Mapping[str, float], texts: Mapping[str, str]) -> None:
        """Draw a box and a slider for each effect of ``texts``, which says what it is."""
        for name, text in texts.items():
            changed, on = imgui.Checkbox(f"##{name}", sizes.get(name, 0.0) > 0.0)
            if changed:
                self._send(ask.Effects({**sizes, name: 1.0 if on else 0.0}))
            imgui.SameLine()
            imgui.BeginDisabled(not sizes.get(name, 0.0) > 0.0)
            size = self._slider.draw(name, sizes.get(name, 0.0), LARGEST, "%.2f", -130.0)
            imgui.EndDisabled()
            imgui.SetItemTooltip(text)
            if size is not None:
                self._send(ask.Effects({**sizes, name: size}))
