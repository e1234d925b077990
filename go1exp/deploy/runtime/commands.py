"""Command sources: numbers, a file, a sine, keys, a gamepad; all limited to the bundle's ranges.

A source is called with the time since walking began, s, and returns the velocity (3,): x and y in m/s, yaw in rad/s,
in the trunk's frame. ``poll`` is called in every cycle, also before walking; ``close`` releases its devices.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import math
import os
import re
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.errors import Expected

AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""Names of the ranges in a bundle's metadata, in the order of a command."""

Stop = Callable[[str], None]
"""``Safety.stop``: called with the origin of the request."""


class CommandError(Expected):
    """A command source is not available; the message gives the reason and an alternative."""


UNLIMITED = np.array([[-math.inf, math.inf]] * 3)


class Constant:
    """A constant velocity, limited to ranges; base of the other sources.

    Attributes:
        cut: number of cycles in which each axis was limited, (3,).
    """

    def __init__(self, velocity: Sequence[float], ranges: np.ndarray = UNLIMITED) -> None:
        """Command the velocity (3,) within ``ranges`` (3, 2); raise CommandError if it is not three finite numbers."""
        self._velocity = np.array(velocity, dtype=float)
        if self._velocity.shape != (3,) or not np.isfinite(self._velocity).all():
            raise CommandError(f"command {list(velocity)}: must be three finite numbers: x m/s, y m/s, yaw rad/s")
        self._ranges, self.cut = ranges, np.zeros(3, dtype=np.int64)

    def __call__(self, t: float) -> np.ndarray:
        """Return the limited velocity (3,); NaN stays NaN, which the controller treats as a fault."""
        command = self.wanted(t)
        limited = np.clip(command, self._ranges[:, 0], self._ranges[:, 1])
        self.cut += command != limited
        return limited

    def wanted(self, t: float) -> np.ndarray:
        """Return the velocity (3,) before it is limited."""
        return self._velocity

    def poll(self) -> None:
        """Read keys, sticks and buttons without waiting."""

    def close(self) -> None:
        """Release the terminal or the gamepad."""


class Table(Constant):
    """Rows of a CSV file, each held until the next one's time; zero before the first."""

    def __init__(self, path: Path, ranges: np.ndarray = UNLIMITED) -> None:
        """Read columns t, x, y, yaw (s, m/s, m/s, rad/s), with or without a line of names.

        Raises:
            CommandError: if a row is not four finite numbers, times do not grow, or there is none.
            OSError: if the file cannot be read.
        """
        rows: list[list[float]] = []
        with Path(path).open(newline="") as file:
            for line, cells in enumerate(csv.reader(file), start=1):
                if not cells or cells[0].lstrip().startswith("#"):
                    continue
                try:
                    rows.append([float(cell) for cell in cells])
                except ValueError:
                    if rows or [cell.strip() for cell in cells] != ["t", "x", "y", "yaw"]:
                        raise CommandError(f"{path}:{line}: {','.join(cells)!r} must be t,x,y,yaw in numbers") from None
                    continue
                if len(cells) != 4 or not all(map(math.isfinite, rows[-1])):
                    raise CommandError(f"{path}:{line}: must be four finite numbers: t,x,y,yaw")
                if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
                    raise CommandError(f"{path}:{line}: t = {rows[-1][0]:g} does not come after {rows[-2][0]:g}")
        if not rows:
            raise CommandError(f"{path}: no rows; each must be t,x,y,yaw")
        super().__init__((0.0, 0.0, 0.0), ranges)
        table = np.array(rows)
        self._times, self._rows = table[:, 0], table[:, 1:]

    def wanted(self, t: float) -> np.ndarray:
        """Return the latest row."""
        k = int(np.searchsorted(self._times, t + 1e-9)) - 1  # 1e-9: rounding of t must not miss a row's time
        return self._rows[k] if k >= 0 else self._velocity


class Sinusoid(Constant):
    """Sines of one period for all three velocities, as in the paper's velocity experiment."""

    def __init__(self, amplitude: Sequence[float], period: float, ranges: np.ndarray = UNLIMITED) -> None:
        """Set amplitudes (3,), m/s, m/s and rad/s, and the period, s.

        Raises:
            CommandError: if they are not finite numbers, or the period is not positive.
        """
        super().__init__(amplitude, ranges)
        if not (period > 0 and math.isfinite(period)):
            raise CommandError(f"period {period}: must be a positive number of seconds")
        self._rate = 2.0 * math.pi / period

    def wanted(self, t: float) -> np.ndarray:
        """Return the velocity (3,) of the sines."""
        return self._velocity * math.sin(self._rate * t)


STEPS = {
    **dict.fromkeys(("w", "W", "\x1b[A", "\x1bOA"), (0.1, 0.0, 0.0)),
    **dict.fromkeys(("s", "S", "\x1b[B", "\x1bOB"), (-0.1, 0.0, 0.0)),
    **dict.fromkeys(("a", "A"), (0.0, 0.1, 0.0)),
    **dict.fromkeys(("d", "D"), (0.0, -0.1, 0.0)),
    **dict.fromkeys(("\x1b[D", "\x1bOD"), (0.0, 0.0, 0.2)),
    **dict.fromkeys(("\x1b[C", "\x1bOC"), (0.0, 0.0, -0.2)),
}
"""Key -> change of the velocity: m/s, m/s, rad/s. Arrow keys arrive as three characters."""

ENDS = {"\x1b": "key Esc", "q": "key q", "Q": "key q"}
"""Keys that end the walk."""

KEYS = "W S or up down: forward, back; A D: left, right; left right: turn; space: zero; Esc or q: end (twice: brake)"


class Keyboard(Constant):
    """Keys of the terminal change the velocity in steps; space makes it zero, Esc or q ends the walk."""

    def __init__(self, stop: Stop, ranges: np.ndarray, descriptor: int | None = None, end: Stop | None = None) -> None:
        """Read the terminal's keys one by one; the resulting velocity is kept within the ranges.

        Raises:
            CommandError: if there is no terminal.
        """
        super().__init__((0.0, 0.0, 0.0), ranges)
        import termios
        import tty

        try:
            self._keys = sys.stdin.fileno() if descriptor is None else descriptor
            self._before = termios.tcgetattr(self._keys)
            tty.setcbreak(self._keys)
        except (OSError, ValueError, termios.error) as error:
            raise CommandError(f"command=keyboard: standard input is no terminal ({error})") from None
        self._stop, self._end = stop, end or stop
        self._open = True

    def poll(self) -> None:
        """Read all keys pressed since the last call."""
        while self._open and select.select([self._keys], [], [], 0)[0]:
            data = os.read(self._keys, 64)
            if not data:
                self._stop("end of the terminal")
                return
            # An arrow is three characters, Esc alone is one.
            for key in re.findall(r"\x1b[\[O].?|.", data.decode(errors="replace"), re.DOTALL):
                self._press(key)

    def _press(self, key: str) -> None:
        if key in ENDS:
            self._end(ENDS[key])
        elif key == " ":
            self._velocity = np.zeros(3)
        elif key in STEPS:
            # rounded: steps of 0.1 that are added up reach zero exactly
            self._velocity = np.clip(np.round(self._velocity + STEPS[key], 6), *self._ranges.T)

    def close(self) -> None:
        """Restore the terminal's settings."""
        if self._open:
            import termios

            self._open = False
            termios.tcsetattr(self._keys, termios.TCSADRAIN, self._before)


DEAD = 0.1
"""Dead zone of a stick about its middle, as a share of its range."""


class Gamepad(Constant):
    """Sticks of a gamepad: left for x and y, right for yaw; any of the first two buttons stops the robot."""

    def __init__(self, stop: Stop, ranges: np.ndarray) -> None:
        """Open the first gamepad; a stick at its end gives the end of the range, 1 m/s or 1 rad/s where there is none.

        Raises:
            CommandError: if pygame is not installed, or there is no gamepad.
        """
        super().__init__((0.0, 0.0, 0.0), ranges)
        # pygame needs a video driver even for a gamepad; the robot's computer has no display.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            pygame: Any = importlib.import_module("pygame")
        except ImportError:
            raise CommandError("command=gamepad: needs pygame (pip install pygame); or use command=keyboard") from None
        pygame.init()
        if not pygame.joystick.get_count():
            pygame.quit()
            raise CommandError("command=gamepad: no gamepad is connected; or use command=keyboard")
        self._pygame = pygame
        self._pad = pygame.joystick.Joystick(0)
        self._stop, self._ends = stop, np.where(np.isfinite(ranges), ranges, np.sign(ranges))

    def poll(self) -> None:
        """Read sticks and buttons."""
        for event in self._pygame.event.get():
            if event.type == self._pygame.JOYDEVICEREMOVED:
                self._stop("loss of the gamepad")
        if self._pad.get_button(0) or self._pad.get_button(1):
            self._stop("gamepad button")
        last = self._pad.get_numaxes() - 1
        # Sticks count right and back as positive, commands left and forward: hence the sign.
        sticks = -np.array([self._pad.get_axis(min(axis, last)) for axis in (1, 0, 3)])
        self._velocity = stretched(sticks, self._ends)

    def close(self) -> None:
        """Release the gamepad."""
        self._pygame.quit()


def stretched(sticks: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Return the velocity (3,) for sticks (3,) from -1 to 1: 0 is zero, the ends are those of ``ranges`` (3, 2)."""
    moved = np.where(np.abs(sticks) < DEAD, 0.0, sticks)
    return np.where(moved < 0, -moved * np.minimum(ranges[:, 0], 0.0), moved * np.maximum(ranges[:, 1], 0.0))


def range_array(given: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Return lowest and highest command (3, 2) of a bundle's metadata.

    An axis without a range in the bundle is not limited.
    """
    return np.array([given.get(name, (-math.inf, math.inf)) for name in AXES], dtype=float)


@dataclass(frozen=True)
class CommandConfig:
    """A command source: three numbers, a file, ``sinusoid``, ``keyboard`` or ``gamepad``; and the sine's values."""

    source: tuple[float, ...] | str
    amplitude: tuple[float, ...] = (1.0, 0.3, 0.8)
    period: float = 10.0


def make(config: CommandConfig, ranges: np.ndarray, stop: Stop, end: Stop | None = None) -> Constant:
    """Return a command source, limited to ``ranges`` (3, 2).

    ``stop`` is called to brake at once, ``end`` (if given) for an orderly end; both with the origin of the request.

    Raises:
        CommandError: if the source is not available.
        OSError: if its file cannot be read.
    """
    if not isinstance(config.source, str):
        return Constant(config.source, ranges)
    if config.source == "sinusoid":
        return Sinusoid(config.amplitude, config.period, ranges)
    if config.source == "keyboard":
        return Keyboard(stop, ranges, end=end)
    if config.source == "gamepad":
        return Gamepad(stop, ranges)
    if Path(config.source).suffix == ".csv":
        return Table(Path(config.source), ranges)
    raise CommandError(
        f"command {config.source!r}: must be three numbers such as [0.5,0.0,0.0], a file.csv, "
        "sinusoid, keyboard or gamepad"
    )


def parsed(text: str) -> tuple[float, ...] | str:
    """Parse a command-line argument: ``0.5,0,0`` is three numbers, anything else a name."""
    with contextlib.suppress(ValueError):
        return tuple(float(part) for part in text.strip("[]()").split(","))
    return text
