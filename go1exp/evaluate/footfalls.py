"""Gait diagram under a video: stance phases of the feet over time."""

from __future__ import annotations

from collections import deque
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from go1exp import robot

if TYPE_CHECKING:
    from collections.abc import Sequence

SPAN = 2.0  # time that is shown, s; the right edge is now
TICK = 0.5  # time between two lines, s

FIRST_RGB, SECOND_RGB = (90, 170, 255), (255, 176, 70)
"""Colours of the diagonal pairs FR with RL, and FL with RR: of a trot one colour at a time is on the ground."""

COLOURS = {"FR": FIRST_RGB, "RL": FIRST_RGB, "FL": SECOND_RGB, "RR": SECOND_RGB}
GROUND_RGB, ROW_RGB, LINE_RGB = (28, 30, 34), (44, 47, 53), (88, 92, 100)
ROW_SHARE = 0.022  # height of a row over the height of the picture


@cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return a font with digits of one width, so that changing numbers do not move."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSansMono.ttf")), size)


class Footfalls:
    """Remembers the contacts of one robot's feet for the last ``SPAN`` s and draws them."""

    def __init__(self, dt: float) -> None:
        """Begin without a past; ``dt`` is the time between two calls of ``add``, s."""
        self._past: deque[Sequence[bool]] = deque(maxlen=max(1, round(SPAN / dt)))
        self._length = self._past.maxlen or 1
        self._tick = TICK / dt

    def add(self, contact: Sequence[bool]) -> None:
        """Take in which feet, FR FL RR RL, are on the ground now."""
        self._past.append(contact)

    def clear(self) -> None:
        """Forget the past: another episode begins."""
        self._past.clear()

    def under(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) with the diagram below it, higher by an even number of rows.

        The diagram keeps to the middle of the picture, so that it survives a crop to a square.
        """
        height, width = picture.shape[:2]
        row = max(4, round(ROW_SHARE * height))
        gap = max(1, row // 5)
        strip = 2 * ((robot.NUM_LEGS * (row + gap) + 3 * gap + 1) // 2)
        side = min(width, height + strip)
        image = Image.new("RGB", (width, strip), GROUND_RGB)
        draw, letters = ImageDraw.Draw(image), font(max(6, row))
        left = (width - side) // 2 + round(letters.getlength("FR  "))
        span = (width + side) // 2 - left - row
        for k, leg in enumerate(robot.LEGS):
            top = 2 * gap + k * (row + gap)
            bottom = top + row - 1
            draw.text((left - letters.getlength("FR "), top + row // 2), leg, COLOURS[leg], letters, anchor="lm")
            draw.rectangle((left, top, left + span, bottom), ROW_RGB)
            for start, stop in self._stances(k):
                x0, x1 = (left + round(span * (at / self._length)) for at in (start, stop))
                draw.rectangle((x0, top, max(x0, x1 - 1), bottom), COLOURS[leg])
        for k in range(1, round(self._length / self._tick)):
            x = left + round(span * (1.0 - k * self._tick / self._length))
            draw.line((x, 0, x, strip), LINE_RGB)
        return np.concatenate([picture, np.asarray(image)])

    def _stances(self, foot: int) -> list[tuple[int, int]]:
        """Return begin and end of each time on the ground, in samples from the left edge."""
        flags = np.zeros(self._length + 2, np.int8)
        past = [bool(contact[foot]) for contact in self._past]
        flags[1 + self._length - len(past) : -1] = past
        change = np.diff(flags)
        return list(zip(np.flatnonzero(change == 1).tolist(), np.flatnonzero(change == -1).tolist(), strict=True))
