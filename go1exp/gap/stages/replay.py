"""The stage ``replay``: the simulator beside a recording, window by window, under the same commands.

No verdict and no search. Initial states are those of the search: estimated, and moved to where each window fits best.
So what is left is not the unknown initial state. What a robot's sensors do not measure (how fast its trunk moves) is
compared where a recording has the truth, as those of a simulated robot may.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from go1exp.base.errors import EXIT_CODES
from go1exp.base.tensors.threads import one_thread
from go1exp.gap.comparison import Comparison, NotComparable, Progress, compare, robot_from
from go1exp.gap.data.cutting import even_clock, noise_of
from go1exp.gap.data.standing import AXES, rows_at
from go1exp.gap.replay.rows import Rows, variants
from go1exp.gap.report import words
from go1exp.gap.report.words import UNITS
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.initial_state import solved
from go1exp.gap.score.likelihood import Scorer, excess
from go1exp.gap.search.fit import residuals
from go1exp.logs.recording import VECTORS, Recording, joint_channels
from go1exp.robot.config import RobotConfig

TURN, SPEED = ("roll", "pitch", "yaw"), ("base_lin_vel_x_b", "base_lin_vel_y_b", "base_lin_vel_z_b")
TRUNK_CHANNELS = {"imu_gyro": AXES[:3], "imu_acc": AXES[3:], "attitude": TURN, "base_lin_vel": SPEED}
TRUNK_UNITS = words.TRUNK_UNITS | {"attitude": "rad", "base_lin_vel": "m/s"}
WORST = 3  # windows that are named as the worst


@dataclass(frozen=True)
class Part:
    """The recordings of one kind of base, held or free."""

    joints: tuple[str, ...]  # their names
    episodes: tuple[str, ...]  # (W,) name of each window's recording
    begin: np.ndarray  # (W,) when the window's scored part begins, s of the recording's clock
    rmse: np.ndarray  # (W, C) root mean squares of simulated minus measured of each window, by channel; SI units
    noise: np.ndarray  # (C,) of the sensors by channel; NaN where nothing is known of it
    # (C,) names: ``q_FR_hip`` ..., ``imu_gyro_x`` ..., ``roll``, ``pitch``, ``yaw`` (a rotation in the trunk's axes),
    # and the velocity of the trunk in its own axes
    channels: tuple[str, ...]
    # chi2 per value of angles, speeds and IMU, the rest of the initial state averaged out; 1 is right
    times_floor: float
    # what is behind it: ``t`` (W, n) s, ``valid`` (W, n), and ``measured`` and ``simulated`` (W, n, C)
    curves: Mapping[str, np.ndarray]

    @property
    def total(self) -> dict[str, float]:
        """Root mean square over all windows by channel."""
        return dict(zip(self.channels, np.sqrt(np.mean(self.rmse**2, axis=0)).tolist(), strict=True))

    def quantity(self, name: str, joints: Sequence[str] | None = None) -> float:
        """Return the root mean square over all joints of ``q``, ``qd`` or ``tau_est``; NaN if there is none."""
        rms = [self.total[c] for c in joint_channels(name, joints or self.joints) if c in self.channels]
        return float(np.sqrt(np.mean(np.square(rms)))) if rms else np.nan

    def lines(self) -> list[str]:
        """Return it as lines for people."""
        total, noise = self.total, dict(zip(self.channels, self.noise, strict=True))
        kinds = [name for name in UNITS if joint_channels(name, self.joints)[0] in total]
        rows = {joint: [total[joint_channels(name, [joint])[0]] for name in kinds] for joint in self.joints}
        rows["all"] = [self.quantity(name) for name in kinds]
        rows["noise"] = [np.median([noise[c] for c in joint_channels(name, self.joints)]) for name in kinds]
        lines = [f"{len(self.begin)} windows; error {self.times_floor:.3g} times the floor (1 is right)"]
        lines.append(f"  {'RMSE':10}" + "".join(f"{f'{name}, {UNITS[name]}':>16}" for name in kinds))
        lines += [f"  {label:10}" + "".join(f"{value:16.4g}" for value in values) for label, values in rows.items()]
        for name, columns in TRUNK_CHANNELS.items():
            if columns[0] in total:
                known = np.array([noise[c] for c in columns])
                of_it = f"; noise {np.median(known):.2g}" if np.isfinite(known).all() else ""
                values = " ".join(f"{total[c]:.3g}" for c in columns)
                lines.append(f"  {name} x y z: {values} {TRUNK_UNITS[name]}{of_it}")
        angles = [k for k, c in enumerate(self.channels) if c in joint_channels("q", self.joints)]
        each = np.sqrt(np.mean(self.rmse[:, angles] ** 2, axis=1))
        worst = [f"{self.episodes[k]} at {self.begin[k]:.2f} s: {each[k]:.3g}" for k in np.argsort(-each)[:WORST]]
        return [*lines, f"  worst windows, q in rad: {', '.join(worst)}"]


@dataclass(frozen=True)
class ReplayResult:
    """The simulator beside the recordings."""

    flaws: tuple[str, ...] = ()  # why the logs cannot be replayed; empty if they can
    parts: tuple[Part, ...] = ()  # the recordings by their bases
    warnings: tuple[str, ...] = ()  # what was chosen, a sentence each
    physics_dt: float = field(default=float("nan"))  # step of the simulation, s

    @property
    def exit_code(self) -> int:
        """0, or that of a bad log."""
        return EXIT_CODES["bad log"] if self.flaws else 0

    def text(self) -> str:
        """Return it as lines for people."""
        if self.flaws:
            return "\n".join(["these logs cannot be replayed:", *(f"  {f}" for f in self.flaws)])
        head = f"the simulator at {1e3 * self.physics_dt:g} ms under the same commands:"
        return "\n".join([*self.warnings, head, *(line for part in self.parts for line in part.lines())])

    def content(self) -> dict[str, object]:
        """Return it as plain data, without the curves."""
        parts = []
        for part in self.parts:
            known = {c: float(v) for c, v in zip(part.channels, part.noise, strict=True) if np.isfinite(v)}
            each = [
                {"episode": e, "begin": float(b), "rmse": dict(zip(part.channels, map(float, row), strict=True))}
                for e, b, row in zip(part.episodes, part.begin, part.rmse, strict=True)
            ]
            parts.append({"rmse": part.total, "noise": known, "times_floor": part.times_floor, "windows": each})
        about = {"warnings": list(self.warnings), "flaws": list(self.flaws)}
        return {"physics_dt": self.physics_dt, **about, "parts": parts}


def replay(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings,
    physics_dt: float,
    on_progress: Progress = lambda what, share: None,
) -> ReplayResult:
    """Replay recordings of one robot open loop, in steps of at most ``physics_dt`` s."""
    robot = robot_from(robot)
    settings = dataclasses.replace(settings, torque=False, physics_dt=physics_dt, phase="whole")
    kinds = [[r for r in recordings if (r.meta.base == "floating") == free] for free in (False, True)]
    replayed = ReplayResult(physics_dt=physics_dt)
    with one_thread():
        for same_base in filter(None, kinds):
            on_progress("replaying the logs", len(replayed.parts) / 2)
            try:
                comparison = compare(same_base, robot, settings, physics_dt=physics_dt, fewest=1)
            except NotComparable as error:
                return ReplayResult(error.flaws)
            warnings = (*replayed.warnings, *comparison.ready.warnings)
            replayed = ReplayResult((), (*replayed.parts, _part(comparison)), warnings, comparison.dt)
    on_progress("done", 1.0)
    return replayed


def _part(comparison: Comparison) -> Part:
    """Simulate the recordings of one kind of base, and put every reading beside what was measured."""
    score, dt, everything = comparison.scorer, comparison.dt, comparison.everything
    w = score.windows
    residual = residuals(score, [{}], everything, dt)[0]
    measured, reference, noise = _measured(comparison)
    simulated = _simulated(comparison, residual, reference)
    channels = tuple(name for name in simulated if name in measured)
    ours, theirs = (np.stack([values[name] for name in channels], axis=2) for values in (simulated, measured))
    weight = (w.valid / w.valid.sum(1, keepdims=True))[..., None]
    return Part(
        joints=w.joints,
        episodes=tuple(comparison.recordings[k].meta.episode for k in w.episode),
        begin=w.begin + comparison.settings.burn_s,
        rmse=np.sqrt(np.sum((ours - theirs) ** 2 * weight, axis=1)),
        noise=np.array([noise.get(name, np.nan) for name in channels]),
        channels=channels,
        times_floor=1.0 + excess(score.chi2(residual, everything)),
        curves={"t": w.begin[:, None] + w.t, "valid": w.valid, "measured": theirs, "simulated": ours},
    )


def _simulated(
    comparison: Comparison, residual: np.ndarray, reference: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return what the simulator's sensors, and its trunk, tell (W, n) by channel."""
    score, w, free = comparison.scorer, comparison.scorer.windows, bool(comparison.robot.base_probe)
    replayer = score.replayer.observing(dataclasses.replace(w, quantities=w.observable))
    rows = variants(comparison.robot, {}, comparison.everything, []) if free else _begun(score, residual)
    y = replayer.run(rows, comparison.dt)
    channels = {f"{name}_{j}": y[:, :, c, k] for c, name in enumerate(UNITS) for k, j in enumerate(w.joints)}
    if free:
        channels |= {name: y[:, :, 3, k] for k, name in enumerate(AXES)} | _trunk(y[:, :, 4, :7], reference)
    return channels


def _begun(score: Scorer, residual: np.ndarray) -> Rows:
    """Return rows of a held robot whose windows begin where, to first order, they fit best."""
    w, machine = score.windows, score.replayer.machine
    x, _ = solved(score.state, residual)
    places = len(machine.groups[0])
    q, qd = np.zeros_like(w.q), np.zeros_like(w.qd)
    for g, group in enumerate(machine.groups):
        joints = list(group)
        q[:, joints] = x[:, g, :places] * w.q_sd[:, joints]
        qd[:, joints] = x[:, g, places : 2 * places] * w.qd_sd[:, joints]
    plain = variants(machine, {}, np.arange(len(w)), [])
    return dataclasses.replace(plain, q=q, qd=qd)


Readings = tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, float]]
"""Readings (W, n) by channel; the measured attitude (W, n, 4) as ``attitude``; and noises by channel."""


def _measured(comparison: Comparison) -> Readings:
    w, recordings = comparison.scorer.windows, comparison.recordings
    clocks = [even_clock(r) for r in recordings]
    rows = [rows_at(clocks[e], begin + t) for e, begin, t in zip(w.episode, w.begin, w.t, strict=True)]

    def taken(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([values[e][k] for e, k in zip(w.episode, rows, strict=True)])

    readings: dict[str, np.ndarray] = {}
    noise: dict[str, float] = {}
    for name in UNITS:
        if all(r.has(name) for r in recordings):
            series = [r.joint(name) for r in recordings]
            columns = joint_channels(name, w.joints)
            readings |= dict(zip(columns, np.moveaxis(taken(series), 2, 0), strict=True))
            noise |= dict(zip(columns, noise_of(series).tolist(), strict=True))
    if not comparison.robot.base_probe:
        return readings, {}, noise
    of_trunk, reference, trunk_noise = _measured_trunk(recordings, taken)
    return readings | of_trunk | {name: np.zeros_like(w.t) for name in TURN}, reference, noise | trunk_noise


def _measured_trunk(recordings: Sequence[Recording], taken: Callable[[Sequence[np.ndarray]], np.ndarray]) -> Readings:
    """Return the IMU's readings, and the trunk's true velocity if recorded: ``taken`` makes (T, c) to (W, n, c)."""
    imu = [r.block(*AXES) for r in recordings]
    readings = dict(zip(AXES, np.moveaxis(taken(imu), 2, 0), strict=True))
    noise = dict(zip(AXES[:3], noise_of([v[:, :3] for v in imu]).tolist(), strict=True))
    noise |= dict(zip(AXES[3:], noise_of([v[:, 3:] for v in imu]).tolist(), strict=True))
    quats = [r.block(*VECTORS["imu_quat"]) for r in recordings]
    reference = {"attitude": taken(quats)}
    turns = [Rotation.from_quat(v, scalar_first=True) for v in quats]
    small = [(turn[:-1].inv() * turn[1:]).as_rotvec().cumsum(axis=0) for turn in turns]
    noise |= dict(zip(TURN, noise_of(small).tolist(), strict=True))
    if all(c in r.channels for r in recordings for c in (*VECTORS["base_lin_vel"], *VECTORS["base_quat"])):
        velocity = taken([r.block(*VECTORS["base_lin_vel"]) for r in recordings])
        true_attitude = taken([r.block(*VECTORS["base_quat"]) for r in recordings])
        body = _turned_back(true_attitude, velocity)
        readings |= dict(zip(SPEED, np.moveaxis(body, 2, 0), strict=True))
    return readings, reference, noise


def _turns(quat: np.ndarray) -> Rotation:
    return Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True)


def _turned_back(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) of the world in the axes of bodies with attitudes (..., 4)."""
    return np.asarray(_turns(quat).inv().apply(vector.reshape(-1, 3))).reshape(vector.shape)


def _trunk(simulated: np.ndarray, reference: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the turn (W, n) from measured to simulated attitude, and the velocity in the simulated trunk's axes."""
    quat, speed = simulated[..., :4], simulated[..., 4:]
    turn = (_turns(reference["attitude"]).inv() * _turns(quat)).as_rotvec().reshape(speed.shape)
    channels = dict(zip(TURN, np.moveaxis(turn, 2, 0), strict=True))
    return channels | dict(zip(SPEED, np.moveaxis(_turned_back(quat, speed), 2, 0), strict=True))
