"""Replay of recorded motions: a log, or the windows of ``go1exp gap`` with the model before and after."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.gap.replay.rows import Machine
from go1exp.gap.result import GapResult, Overlay
from go1exp.logs.recording import JOINT_QUANTITIES, VECTORS, Recording, RecordingError
from go1exp.robot import JOINTS
from go1exp.robot.config import RobotConfig
from go1exp.sim.env.camera import AZIMUTH
from go1exp.sim.physics.scene import build_model
from go1exp.sim.terrain import TerrainConfig, build_terrain

Array = NDArray[np.float64]
UNITS = {"q": "rad", "qd": "rad/s", "q_target": "rad", "tau_est": "N m", "tau_cmd": "N m"}
STEP_S = 0.02  # real time between two frames, s
SLOWEST = 0.05  # s of the recording per s

SHOWN_ERROR = 0.15
"""Largest error of an angle as it is shown at first, rad: smaller ones are magnified to that, up to ``MOST``."""

MOST = 50.0  # largest magnification
HELD_AT = 0.5  # height of a trunk that is held, or of which nothing is known, m


@dataclass(frozen=True)
class Motion:
    """Motion of one robot over a piece."""

    name: str  # measured, before, after, target
    q: Array  # (T, J) joint angles, rad
    base: Array | None = None  # (T, 7) position, m, and attitude w-x-y-z of the trunk; None holds it


@dataclass(frozen=True)
class Piece:
    """A time span of a recording."""

    title: str  # its origin
    t: Array  # (T,) time in the episode, s
    motions: tuple[Motion, ...]  # the first one is what was measured
    # quantity -> joint -> name of a motion -> (T,), in the quantity's unit
    curves: Mapping[str, Mapping[str, Mapping[str, Array]]]
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # quantity -> joint -> standard deviation

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
    """A replay: one or more pieces."""

    kind: Literal["log", "gap"]  # of a log, or of a result of ``go1exp gap``
    about: str
    pieces: tuple[Piece, ...]


@dataclass(frozen=True)
class Change:
    """Request of the user; None keeps what there is."""

    piece: int | None = None  # number of the piece, which begins anew
    time: float | None = None  # s from the beginning of the piece, where time then stands still
    running: bool | None = None  # whether time passes
    speed: float | None = None  # s of the recording per s
    magnify: float | None = None  # factor by which errors are magnified


class Player:
    """Position in a story: ``time`` in s, ``speed`` in s of it per s, and the factor by which errors are magnified."""

    def __init__(self, story: Story) -> None:
        """Start at the beginning; windows of a gap are short, and shown slowly."""
        self.story, self.number, self.time, self.running = story, 0, 0.0, True
        self.speed = 1.0 if story.kind == "log" else 0.1
        self.magnify = 1.0 if story.kind == "log" else magnification(story.pieces)

    @property
    def piece(self) -> Piece:
        """The present piece."""
        return self.story.pieces[self.number]

    def ask(self, request: Change) -> None:
        """Apply a request; times and numbers are clipped to their range."""
        if request.piece is not None:
            self.number, self.time = min(max(request.piece, 0), len(self.story.pieces) - 1), 0.0
        if request.time is not None:
            self.time, self.running = min(max(request.time, 0.0), self.piece.duration), False
        if request.running is not None:
            self.running = request.running
        if request.speed is not None:
            self.speed = max(request.speed, SLOWEST)
        if request.magnify is not None:
            self.magnify = min(max(request.magnify, 1.0), MOST)

    def advance(self, seconds: float) -> None:
        """Advance by real time; a piece repeats at its end."""
        if self.running and self.piece.duration > 0.0:
            self.time = (self.time + self.speed * seconds) % self.piece.duration

    @property
    def row(self) -> int:
        """Index of the shown sample."""
        t = self.piece.t
        return int(np.clip(np.searchsorted(t, t[0] + self.time + 1e-9) - 1, 0, len(t) - 1))

    def pose(self, motion: Motion) -> tuple[Array, Array | None]:
        """Return joint angles (J,) and base (7,) of a motion now; a model's with its error magnified."""
        measured = self.piece.motions[0].q[self.row]
        q = measured + self.magnify * (motion.q[self.row] - measured) if motion.name in MODELS else motion.q[self.row]
        return q, None if motion.base is None else motion.base[self.row]


MODELS = ("before", "after")  # names of the models' motions


def magnification(pieces: Sequence[Piece]) -> float:
    """Return the magnification that makes the models' errors visible: a round number."""
    largest = max(
        (float(np.abs(m.q - p.motions[0].q).max()) for p in pieces for m in p.motions[1:] if m.name in MODELS),
        default=0.0,
    )
    if largest <= 0.0:
        return 1.0
    wanted = min(max(SHOWN_ERROR / largest, 1.0), MOST)
    return max(v for v in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if v <= wanted)


def of_result(result: GapResult, where: str) -> Story:
    """Return the held-out windows of a result that keeps their curves; raise RecordingError if it keeps none."""
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
    """Return a Go1's recording, targets as a second robot; raise RecordingError of other robots, or without angles."""
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
    """Return the pose of the trunk (T, 7): as recorded, or the IMU's attitude at the height of a stance."""
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


APART = 0.9
"""Distance to the right, as the camera sees it, of the model after from that before, in extents of the robot."""


@dataclass(frozen=True)
class Ghost:
    """A robot drawn in addition to the model's own."""

    name: str
    qpos: Array
    shift: Array  # (3,) displacement, m


@dataclass(frozen=True)
class ReplayView:
    """Content of the panels beside the story, which they have themselves: it is long, and this is sent often."""

    number: int
    time: float  # s from its beginning
    running: bool
    speed: float  # s of the recording per s
    magnify: float  # factor by which errors are magnified
    ghosts: tuple[Ghost, ...]  # robots drawn in addition to the model's own, which is the first motion shown


class ReplayShow:
    """A story in its scene."""

    def __init__(self, story: Story, config: RobotConfig, model: mujoco.MjModel | None = None) -> None:
        """Build the scene, with the Go1 or another robot's model on its base; raise ValueError of a missing joint."""
        self.player = Player(story)
        if model is None:
            ground = build_terrain(TerrainConfig(kind="flat"))
            model = build_model(config, ground, 0.002, decoration=True)[0]
            model.vis.headlight.ambient[:] = 0.25
        self.model, self.data = model, mujoco.MjData(model)
        self._free = bool(model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE)
        names = story.pieces[0].joints
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]
        if min(ids) < 0:
            raise ValueError(f"the model has no joint {names[ids.index(-1)]!r}")
        self._at = model.jnt_qposadr[ids]
        wide = APART * float(model.stat.extent) * (0.4 if self._free else 1.0)
        self._apart = wide * np.array([math.sin(math.radians(AZIMUTH)), -math.cos(math.radians(AZIMUTH)), 0.0])
        self._place()

    def ask(self, request: Change) -> None:
        """Apply a request of the user."""
        self.player.ask(request)

    def tick(self) -> float:
        """Advance; return the time until the next call, s."""
        self.player.advance(STEP_S)
        self._place()
        return STEP_S

    def _qpos(self, motion: Motion) -> Array:
        qpos = self.model.qpos0.copy()
        q, base = self.player.pose(motion)
        if self._free:
            qpos[:7] = [0.0, 0.0, HELD_AT, 1.0, 0.0, 0.0, 0.0] if base is None else base
        qpos[self._at] = q
        return np.asarray(qpos)

    def _place(self) -> None:
        """Put the model's own robot into the first motion that is shown: of a gap that before."""
        motions = {m.name: m for m in self.player.piece.motions}
        first = motions.get("before", self.player.piece.motions[0])
        self.data.qpos[:] = self._qpos(first)
        self.data.qvel[:] = 0.0
        mujoco.mj_kinematics(self.model, self.data)

    def _ghosts(self) -> tuple[Ghost, ...]:
        poses = {m.name: self._qpos(m) for m in self.player.piece.motions}
        in_place = np.zeros(3)
        if self.player.story.kind == "log":
            return tuple(Ghost(name, qpos, in_place) for name, qpos in poses.items() if name != "measured")
        measured = poses["measured"]
        return (
            Ghost("measured", measured, in_place),
            Ghost("after", poses["after"], self._apart),
            Ghost("measured", measured, self._apart),
        )

    def view(self) -> ReplayView:
        """Return the content of the panels."""
        p = self.player
        return ReplayView(p.number, p.time, p.running, p.speed, p.magnify, self._ghosts())


def model_of(robot: Machine) -> mujoco.MjModel:
    """Return the compiled model of a robot of ``go1exp gap`` on its base."""
    return robot.build(1, 0.002, (1.0, 0.0, 0.0, 0.0), 1)[0].model
