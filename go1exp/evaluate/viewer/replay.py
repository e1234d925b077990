"""Motions that were recorded, shown again: a log, or the windows of ``go1exp gap`` with the model before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.gap.result import GapResult, Overlay
from go1exp.logs.recording import JOINT_QUANTITIES, VECTORS, Recording, RecordingError
from go1exp.robot import JOINTS

Array = NDArray[np.float64]

UNITS = {"q": "rad", "qd": "rad/s", "q_target": "rad", "tau_est": "N m", "tau_cmd": "N m"}

STEP_S = 0.02
"""Real time from picture to picture, s."""

SLOWEST = 0.05
"""Smallest speed, s of the recording per s."""

SHOWN_ERROR = 0.15
"""Largest error of an angle as it is shown at first, rad: smaller ones are magnified to that, up to ``MOST``."""

MOST = 50.0
"""Largest magnification."""

HELD_AT = 0.5
"""Height of a trunk that is held, or of which nothing is known, m."""


@dataclass(frozen=True)
class Motion:
    """One robot through a piece.

    Attributes:
        name: measured, before, after, target.
        q: (T, J) joint angles, rad.
        base: (T, 7) position, m, and attitude w-x-y-z of the trunk; None holds it.
    """

    name: str
    q: Array
    base: Array | None = None


@dataclass(frozen=True)
class Piece:
    """A stretch of time to look at.

    Attributes:
        title: where it is from.
        t: (T,) time in the episode, s.
        motions: the first one is what was measured.
        curves: quantity -> joint -> name of a motion -> (T,), in the quantity's unit.
        noise: quantity -> joint -> standard deviation.
    """

    title: str
    t: Array
    motions: tuple[Motion, ...]
    curves: Mapping[str, Mapping[str, Mapping[str, Array]]]
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def duration(self) -> float:
        """Its length, s."""
        return float(self.t[-1] - self.t[0])

    def errors(self) -> dict[str, dict[str, float]]:
        """Return the root-mean-square error of the angles by joint and motion, rad."""
        measured = self.motions[0].q
        return {
            joint: {m.name: float(np.sqrt(np.mean((m.q[:, k] - measured[:, k]) ** 2))) for m in self.motions[1:]}
            for k, joint in enumerate(self.joints)
        }

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.curves["q"])


@dataclass(frozen=True)
class Story:
    """All that there is to look at.

    Attributes:
        kind: what it is.
        about: a sentence or two.
        pieces: one after the other.
    """

    kind: Literal["log", "gap"]
    about: str
    pieces: tuple[Piece, ...]


# ---------------------------------------------------------------------- what is asked for


@dataclass(frozen=True)
class Choose:
    """Look at another piece, by its number."""

    piece: int


@dataclass(frozen=True)
class Seek:
    """Go to another time, s from the beginning of the piece."""

    time: float


@dataclass(frozen=True)
class Play:
    """Let time pass or stand still.

    Attributes:
        running: whether it passes.
        speed: s of the recording per s.
    """

    running: bool
    speed: float


@dataclass(frozen=True)
class Magnify:
    """Show errors larger than they are."""

    times: float


Request = Choose | Seek | Play | Magnify


class Player:
    """Where one is in a story.

    Attributes:
        story: what is told.
        number: of the piece.
        time: s from its beginning.
        running: whether time passes.
        speed: s of the recording per s.
        magnify: how much larger than they are errors are shown.
    """

    def __init__(self, story: Story) -> None:
        """Begin at the beginning; windows of a gap are short, and shown slowly."""
        self.story, self.number, self.time, self.running = story, 0, 0.0, True
        self.speed = 1.0 if story.kind == "log" else 0.1
        self.magnify = 1.0 if story.kind == "log" else magnification(story.pieces)

    @property
    def piece(self) -> Piece:
        """What is looked at."""
        return self.story.pieces[self.number]

    def ask(self, request: Request) -> None:
        """Do what is asked; times and numbers beyond the ends are the ends."""
        match request:
            case Choose(piece):
                self.number, self.time = min(max(piece, 0), len(self.story.pieces) - 1), 0.0
            case Seek(time):
                self.time, self.running = min(max(time, 0.0), self.piece.duration), False
            case Play(running, speed):
                self.running, self.speed = running, max(speed, SLOWEST)
            case Magnify(times):
                self.magnify = min(max(times, 1.0), MOST)

    def advance(self, seconds: float) -> None:
        """Let real time pass; at its end a piece begins again."""
        if self.running and self.piece.duration > 0.0:
            self.time = (self.time + self.speed * seconds) % self.piece.duration

    @property
    def row(self) -> int:
        """Number of the sample that is shown."""
        t = self.piece.t
        return int(np.clip(np.searchsorted(t, t[0] + self.time + 1e-9) - 1, 0, len(t) - 1))

    def pose(self, motion: Motion) -> tuple[Array, Array | None]:
        """Return joint angles (J,) and base (7,) of a motion now; what is not measured, with its error magnified."""
        measured = self.piece.motions[0].q[self.row]
        q = measured + self.magnify * (motion.q[self.row] - measured) if motion.name in MODELS else motion.q[self.row]
        return q, None if motion.base is None else motion.base[self.row]


MODELS = ("before", "after")
"""Motions that are a model's."""


def magnification(pieces: Sequence[Piece]) -> float:
    """Return by how much the errors of the models must be magnified to be seen: a round number."""
    largest = max(
        (float(np.abs(m.q - p.motions[0].q).max()) for p in pieces for m in p.motions[1:] if m.name in MODELS),
        default=0.0,
    )
    if largest <= 0.0:
        return 1.0
    wanted = min(max(SHOWN_ERROR / largest, 1.0), MOST)
    return max(v for v in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if v <= wanted)


# ---------------------------------------------------------------------- where it comes from


def of_result(result: GapResult, where: str) -> Story:
    """Return the held-out windows of an answer, whose curves it keeps.

    Raises:
        RecordingError: if it keeps none.
    """
    pieces = tuple(_window(overlay) for overlay in result.overlays if any(n.startswith("q_") for n in overlay.measured))
    if not pieces:
        raise RecordingError(f"{where}: keeps no curves of windows; run go1exp gap again with search.overlays=8")
    return Story("gap", result.sentence, pieces)


def _window(overlay: Overlay) -> Piece:
    sources = {"measured": overlay.measured, "before": overlay.before, "after": overlay.after}
    joints = [name.removeprefix("q_") for name in overlay.measured if name.startswith("q_")]
    curves: dict[str, dict[str, dict[str, Array]]] = {}
    noise: dict[str, dict[str, float]] = {}
    for quantity in ("q", "qd", "tau_est"):
        for joint in joints:
            channel = f"{quantity}_{joint}"
            if channel in overlay.measured:
                shown = {name: values[channel] for name, values in sources.items() if channel in values}
                curves.setdefault(quantity, {})[joint] = shown
                if channel in overlay.noise:
                    noise.setdefault(quantity, {})[joint] = overlay.noise[channel]
    motions = tuple(  # joints that are not compared, of legs on the ground, are as measured
        Motion(name, np.stack([values.get(f"q_{j}", overlay.measured[f"q_{j}"]) for j in joints], axis=1))
        for name, values in sources.items()
    )
    return Piece(f"{overlay.episode}, {overlay.t[0]:.2f} s", overlay.t, motions, curves, noise)


def of_recording(recording: Recording) -> Story:
    """Return a recording of a Go1 as one piece, with its targets as a second robot.

    Raises:
        RecordingError: if it is of another robot, or has no angles.
    """
    meta = recording.meta
    if set(meta.joints) != set(JOINTS):
        raise RecordingError(f"{meta.episode}: is of the robot {meta.robot!r}; the scene has the Go1's joints alone")
    order = [meta.joints.index(joint) for joint in JOINTS]
    base = _base(recording)
    motions = [Motion("measured", recording.joint("q")[:, order], base)]
    if recording.has("q_target"):
        motions.append(Motion("target", recording.joint("q_target")[:, order], base))
    curves: dict[str, dict[str, dict[str, Array]]] = {}
    for quantity in JOINT_QUANTITIES:
        if recording.has(quantity) and quantity != "q_target":
            values = recording.joint(quantity)
            curves[quantity] = {joint: {"measured": values[:, meta.joints.index(joint)]} for joint in JOINTS}
    for k, joint in enumerate(JOINTS if len(motions) > 1 else ()):
        curves["q"][joint]["target"] = motions[1].q[:, k]
    words = f"{meta.episode}: {meta.source}, {meta.rate_hz:g} Hz, by {meta.tool}. {meta.notes}".strip()
    return Story("log", words, (Piece(meta.episode, recording.t, tuple(motions), curves),))


def _base(recording: Recording) -> Array | None:
    """Return where the trunk was (T, 7): as recorded, or as the IMU had it at the height of a stance."""
    channels, rows = recording.channels, len(recording.t)
    known = {name for name, columns in VECTORS.items() if set(columns) <= set(channels)}
    if recording.meta.base == "fixed":
        quat = np.tile(np.asarray(recording.meta.base_quat), (rows, 1))
        return np.concatenate([np.tile([0.0, 0.0, HELD_AT], (rows, 1)), quat], axis=1)
    quats = [name for name in ("base_quat", "imu_quat") if name in known]
    if not quats:
        return None
    quat = recording.block(*VECTORS[quats[0]])
    still = np.tile([0.0, 0.0, robot.NOMINAL_HEIGHT], (rows, 1))
    place = recording.block(*VECTORS["base_pos"]) if "base_pos" in known else still
    return np.concatenate([place, quat / np.linalg.norm(quat, axis=1, keepdims=True)], axis=1)


def thinned(values: Any, most: int = 1500) -> list[float]:
    """Return at most about ``most`` of many values, evenly, for a curve."""
    every = -(-len(values) // most)
    return [float(v) for v in values[::every]]
