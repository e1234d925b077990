"""The log of a walk: arrays that are allocated before the walk, and written after its end."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from go1exp import __version__
from go1exp.base.files import opened
from go1exp.deploy.runtime.controller import PHASES, Cycle
from go1exp.deploy.runtime.metadata import Metadata

if TYPE_CHECKING:
    from go1exp.config.schema.physics import ContactConfig
    from go1exp.logs.recording import Meta, Recording

STATES_PER_S = 500.0
"""States that a Go1 sends in a second."""

STATE = (
    *(("t", 1), ("clock", 1), ("q", 12), ("qd", 12), ("tau_est", 12)),
    *(("imu_quat", 4), ("imu_gyro", 3), ("imu_acc", 3), ("foot_force", 4)),
)
CYCLE = (
    *(("t", 1), ("phase", 1), ("number", 1), ("damping", 1), ("q_target", 12), ("command", 3), ("estimate", 3)),
    *(("sent_at", 1), ("age", 1), ("q", 12)),
)
"""Parts of a row: name and width. Times s; ``phase`` an index of ``PHASES``; ``number`` of the command sent, or 0;
``sent_at`` and ``age`` as in ``Cycle``; ``q`` of the newest state."""


RISING = [PHASES.index(name) for name in ("standing_up", "handing_over")]
"""Phases whose gains are not those of walking, unless the robot is suspended."""


class Ring:
    """The newest rows of numbers, in an array of fixed size."""

    def __init__(self, parts: tuple[tuple[str, int], ...], size: int) -> None:
        """Allocate ``size`` rows of ``parts``; filling them with NaN now avoids page faults during the walk."""
        self._rows = np.full((size, sum(width for _, width in parts)), np.nan)
        self.columns, place = {}, 0
        for name, width in parts:
            self.columns[name] = slice(place, place + width)
            place += width
        self.count = 0

    def next(self) -> np.ndarray:
        """Return the row to be filled next: the oldest, once all are full."""
        row: np.ndarray = self._rows[self.count % len(self._rows)]
        self.count += 1
        return row

    @property
    def overwritten(self) -> int:
        """Number of rows that were overwritten."""
        return max(self.count - len(self._rows), 0)

    def rows(self) -> np.ndarray:
        """Return the rows that are kept, oldest first."""
        if self.count <= len(self._rows):
            return self._rows[: self.count]
        return np.roll(self._rows, -(self.count % len(self._rows)), axis=0)

    def part(self, name: str) -> np.ndarray:
        """Return a part of all rows that are kept, (T, width), or (T,) if its width is 1."""
        return self.part_of(self.rows(), name)

    def part_of(self, rows: np.ndarray, name: str) -> np.ndarray:
        """Return a part of ``rows`` (T, ...), as ``part`` does of those that are kept."""
        values = rows[:, self.columns[name]]
        return values[:, 0] if values.shape[1] == 1 else values


@dataclass(frozen=True)
class About:
    """Origin of a log.

    Attributes:
        metadata: of the bundle.
        kp: (J,) N m/rad, in force while walking and in every row of the recording.
        kd: (J,) N m s/rad.
        simulated: not measured on hardware.
        newton: the feet's readings are in newtons; if not, they are left out of the recording.
        episode: the recording's name.
        excitation: name of the motion.
        suspended: whether its trunk was held in the air; the mean attitude of the IMU is recorded then, and the stance
            is approached with the same gains.
        varied: whether the gains change all the time; rows of all gains are recorded then.
        notes: for the reader.
        trained: the configuration of the policy's run, with the contact of its feet.
    """

    metadata: Metadata
    kp: np.ndarray
    kd: np.ndarray
    simulated: bool
    newton: bool
    episode: str
    excitation: str = "policy"
    suspended: bool = False
    varied: bool = False
    notes: str = ""
    trained: Mapping[str, Any] = field(default_factory=dict)


class Log:
    """Keeps every cycle in memory.

    Attributes:
        states: every received state.
        cycles: every cycle.
        phases: when each phase began, s of the runtime's clock.
        first_command: when the first command was sent, s; None before.
    """

    def __init__(self, rate: float, keep: float) -> None:
        """Allocate ``keep`` s at ``rate`` cycles per second; of a longer walk the newest are kept."""
        self.states = Ring(STATE, math.ceil(keep * STATES_PER_S) + 1)
        self.cycles = Ring(CYCLE, math.ceil(keep * rate) + 1)
        self.phases: dict[str, float] = {}
        self.first_command: float | None = None
        self._sent = 0

    def note(self, cycle: Cycle) -> None:
        """Keep a cycle and the states received in it."""
        for state in cycle.fresh:
            row = self.states.next()
            # in place, by the widths of STATE: nothing is allocated during the walk
            row[0], row[1] = state.t, state.clock
            row[2:14], row[14:26], row[26:38] = state.joint_pos, state.joint_vel, state.joint_torque
            row[38:42], row[42:45], row[45:48], row[48:52] = (
                *(state.imu_quat, state.imu_gyro, state.imu_acc),
                state.foot_force,
            )
        row = self.cycles.next()
        row[0], row[1], row[2], row[3] = cycle.t, PHASES.index(cycle.phase), 0, False
        row[4:16] = np.nan
        if cycle.command is not None:
            self._sent += 1
            self.first_command = cycle.t if self.first_command is None else self.first_command
            row[2], row[3], row[4:16] = self._sent, cycle.command.damping, cycle.command.joint_target
        row[16:19], row[19:22] = cycle.velocity, cycle.base_lin_vel
        row[22], row[23] = cycle.sent_at, cycle.age
        row[24:36] = np.nan if cycle.state is None else cycle.state.joint_pos
        self.phases.setdefault(cycle.phase, cycle.t)

    def recording(
        self, about: About, truth: Mapping[str, np.ndarray] | None = None, applied: np.ndarray | None = None
    ) -> Recording | None:
        """Return the walk under the gains of ``about``, up to the first command that brakes; None if there was none.

        Args:
            about: its origin.
            truth: columns of the format by name, with ``clock``, s; rows are joined where the clocks are the same.
            applied: (T, 4 + J) commands of a simulated robot: clock, s, whether one applied, targets, rad, largest kp
                and kd.
        """
        from go1exp.logs.recording import Recording

        rows = self._newest_sent(about) if applied is None else self._reported(about, applied)
        if rows is None:
            return None
        kept, targets = rows
        clock = self.measured("clock")[kept]
        t = self.measured("t")[kept] if np.isnan(clock).any() else clock
        channels = self._channels(about, kept, targets)
        if truth is not None:
            channels |= _joined(truth, clock)
        # A recording needs an increasing clock and finite values; other rows are dropped and counted in the notes.
        good = np.concatenate([[True], np.diff(np.maximum.accumulate(t)) > 0])
        good &= np.isfinite(np.stack(list(channels.values()))).all(axis=0)
        if good.sum() < 2:
            return None
        notes = [about.notes, UNKNOWN_DELAY if applied is None else ""]
        notes += [] if good.all() else [f"{int((~good).sum())} rows that were not finite or not in time are left out"]
        channels = {name: np.ascontiguousarray(values[good]) for name, values in {"t": t, **channels}.items()}
        return Recording(_meta(about, channels, "; ".join(note for note in notes if note)), channels)

    def _channels(self, about: About, kept: np.ndarray, targets: np.ndarray) -> dict[str, np.ndarray]:
        """Return what was measured in the states ``kept`` (S,) bool, by column, each (T,), with targets (T, J)."""
        from go1exp.logs.recording import FOOT_FORCE, VECTORS, columns, joint_columns

        joints = about.metadata.joints
        channels: dict[str, np.ndarray] = {}
        for name in ("q", "qd", "tau_est"):
            channels |= joint_columns(name, joints, self.measured(name)[kept])
        channels |= joint_columns("q_target", joints, targets)
        quat = self.measured("imu_quat")[kept]
        length = np.linalg.norm(quat, axis=1, keepdims=True)
        quat = quat / np.where(length > 0.5, length, np.nan)  # an IMU that has not started has no attitude
        vectors = {"imu_quat": quat} | {name: self.measured(name)[kept] for name in ("imu_gyro", "imu_acc")}
        for name, values in vectors.items():
            channels |= columns(VECTORS[name], values)
        if about.newton:
            legs = (FOOT_FORCE + leg for leg in about.metadata.legs)
            channels |= columns(legs, self.measured("foot_force")[kept])
        return channels

    def measured(self, name: str) -> np.ndarray:
        """Return a part of the states that are kept, (T, ...), in the order in which they were measured.

        An overtaken state counts as having arrived with the first of those that overtook it.
        """
        rows = self.states.rows()  # once: a ring that is full is copied
        clock, part = self.states.part_of(rows, "clock"), self.states.part_of(rows, name)
        if np.isnan(clock).any() or (np.diff(clock) >= 0.0).all():
            return part
        part = part[np.argsort(clock, kind="stable")]
        return np.minimum.accumulate(part[::-1])[::-1] if name == "t" else part

    def _reported(self, about: About, applied: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the states (T,) bool measured under a command with the gains of ``about``, and their targets."""
        clock = self.measured("clock")
        if not len(applied) or not len(clock) or np.isnan(clock).any():
            return None
        nearest = np.clip(np.searchsorted(applied[:, 0], clock - 1e-6), 0, len(applied) - 1)
        under = (np.abs(applied[nearest, 0] - clock) < 1e-6) & (applied[nearest, 1] > 0)
        if not about.varied:
            under &= (np.abs(applied[nearest, -2:] - [about.kp.max(), about.kd.max()]) < 1e-6).all(axis=1)
        return (under, applied[nearest[under], 2:-2]) if under.any() else None

    def _newest_sent(self, about: About) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the same for a robot that does not report the applied command: the newest one sent by then counts."""
        sent = self.cycles.part("number") > 0
        if not sent.any() or not self.states.count:
            return None
        at, target = self.cycles.part("t")[sent], self.cycles.part("q_target")[sent]
        newest = np.searchsorted(at, self.measured("t"), "right") - 1
        others = np.isin(self.cycles.part("phase")[sent], [] if about.suspended else RISING)
        under = (newest >= 0) & ~((self.cycles.part("damping")[sent] > 0) | others)[newest]
        return (under, target[newest[under]]) if under.any() else None


UNKNOWN_DELAY = (
    "q_target is the newest sent target: the robot does not report the applied one, and the network delays it"
)


def _meta(about: About, channels: Mapping[str, np.ndarray], notes: str) -> Meta:
    from go1exp.logs.recording import VECTORS, Meta

    return Meta(
        robot=about.metadata.robot,
        joints=about.metadata.joints,
        rate_hz=float(np.round(1.0 / np.median(np.diff(channels["t"])), 3)),
        base="fixed" if about.suspended else "floating",
        base_quat=_attitude(np.stack([channels[name] for name in VECTORS["imu_quat"]])) if about.suspended else None,
        kp=tuple(map(float, about.kp)),
        kd=tuple(map(float, about.kd)),
        tau_limit=about.metadata.torque_limit,
        excitation=about.excitation,
        episode=about.episode,
        repeat_of=None,
        source="simulated" if about.simulated else "measured",
        tool="go1exp deploy",
        versions={"go1exp": __version__, "onnxruntime": metadata.version("onnxruntime")},
        notes=notes,
        contact=_contact(about.trained),
    )


def _contact(trained: Mapping[str, Any]) -> ContactConfig | None:
    """Return the contact of a run, None if it cannot be read; one of an older version had MuJoCo's own."""
    from go1exp.config.schema.physics import MUJOCO_CONTACT, read_contact

    if not trained:
        return None
    return read_contact(trained["contact"]) if "contact" in trained else MUJOCO_CONTACT


def _attitude(quat: np.ndarray) -> tuple[float, float, float, float]:
    """Return the mean attitude w-x-y-z of quaternions (4, T), of which q and -q are the same (Markley et al., 2007)."""
    mean = np.linalg.eigh(quat @ quat.T)[1][:, -1]
    w, x, y, z = np.where(mean[0] < 0.0, -mean, mean).tolist()
    return w, x, y, z


def _joined(truth: Mapping[str, np.ndarray], clock: np.ndarray) -> dict[str, np.ndarray]:
    """Return the true columns at the times of a clock; NaN where they are unknown."""
    nearest = np.clip(np.searchsorted(truth["clock"], clock - 1e-6), 0, len(truth["clock"]) - 1)
    same = np.abs(truth["clock"][nearest] - clock) < 1e-6
    return {name: np.where(same, values[nearest], np.nan) for name, values in truth.items() if name != "clock"}


def write_cycles(path: Path, log: Log) -> None:
    """Write the cycles as NumPy's archive: velocities commanded and estimated, targets, phases; the runtime's clock."""
    content: dict[str, Any] = {name: log.cycles.part(name) for name, _ in CYCLE}
    with opened(path) as file:
        np.savez(file, phases=np.array(PHASES), **content)
