"""Designs played on the model: what they would ask of the robot, and the recordings that would come of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from go1exp.base.files import write_text
from go1exp.gap.comparison import Comparison
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.windows import Windows
from go1exp.gap.design.plan import Design, Limits, Used
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.score.likelihood import Scorer, scorer
from go1exp.logs.excitations import Motion
from go1exp.logs.recording import FLAG, Recording, RecordingError, joint_channels

SETTLE_S = 0.5  # time for which the first target is held before a design begins, s
CLOCK = 0.01  # relative error of a logger's clock up to which commands are sent at the rate that recordings say
PLAYED = ("q", "qd", "tau_est")  # what is kept of a rehearsal: angles, speeds, and the torque that the drives make
FADE_S = 1.0  # time at the beginning of a motion that is not evaluated, s: motions grow from rest


@dataclass(frozen=True)
class Rehearsal:
    """A design as the model plays it."""

    design: Design  # which
    motion: Motion  # its commands
    kp: np.ndarray  # (J,) N m/rad
    kd: np.ndarray  # (J,) N m s/rad
    q: np.ndarray  # (T, J) angles, rad
    qd: np.ndarray  # (T, J) speeds, rad/s
    used: Used  # of the limits


@dataclass
class Stage:
    """Where designs, ``seconds`` s long, are rehearsed: the recordings at hand, limits, and values of the model."""

    comparison: Comparison
    limits: Limits
    theta: Theta
    seconds: float

    def __post_init__(self) -> None:
        """Find the usual gains, and the noise of the sensors."""
        windows = self.comparison.windows
        both = np.concatenate([windows.kp, windows.kd], axis=1)
        kinds, count = np.unique(both, axis=0, return_counts=True)
        self.kp, self.kd = np.split(kinds[count.argmax()], 2)
        self.noise = np.median(windows.scale, axis=0)
        nominal = 1.0 / self.comparison.recordings[0].meta.rate_hz
        self.period = nominal if abs(windows.period / nominal - 1.0) < CLOCK else windows.period

    def gains(self, design: Design) -> tuple[np.ndarray, np.ndarray]:
        """Return a design's gains (J,), to three digits: those that are printed are those that were tried."""
        return tuple(  # type: ignore[return-value]
            np.array([float(f"{v:.3g}") for v in factor * usual])
            for factor, usual in zip(design.gains, (self.kp, self.kd), strict=True)
        )

    def rehearsed(self, designs: Sequence[Design], dt: float) -> list[Rehearsal]:
        """Play designs side by side on the model; those whose excitation this robot cannot do are left out."""
        made = [(d, d.motion(self.seconds, self.period, self.limits)) for d in designs]
        able = [(d, m) for d, m in made if m is not None]
        if not able:
            return []
        windows = self._whole([d for d, _ in able], [m for _, m in able])
        machine = self.comparison.robot
        quats = np.array([d.attitude.quat for d, _ in able])
        settings = self.comparison.settings
        player = machine.replayer(windows, quats, settings.max_rows, settings.threads)
        y = player.run(variants(machine, self.theta, np.arange(len(windows)), []), dt)
        return [
            Rehearsal(d, m, kp, kd, q, qd, self.limits.used(q, qd, torque))
            for (d, m), kp, kd, (q, qd, torque) in zip(able, windows.kp, windows.kd, np.moveaxis(y, 2, 1), strict=True)
        ]

    def _whole(self, designs: Sequence[Design], motions: Sequence[Motion]) -> Windows:
        """Return designs as windows that are as long as they are, from rest at the first target."""
        like, count = self.comparison.windows, len(designs)
        steps, joints = motions[0].target.shape
        kp, kd = (np.stack(each) for each in zip(*(self.gains(d) for d in designs), strict=True))
        t = SETTLE_S + np.arange(steps) * self.period
        begun = np.concatenate([[-1.0], t])
        start = np.stack([m.start for m in motions])
        flat, zero = np.zeros((count, joints)), np.zeros(count)
        return dataclasses.replace(
            like,
            quantities=PLAYED,
            episode=np.arange(count),
            begin=zero,
            origin=zero,
            q=start,
            qd=flat,
            qdd=flat,
            q_sd=flat + 1.0,
            qd_sd=flat + 1.0,
            kp=kp,
            kd=kd,
            t=np.tile(t, (count, 1)),
            y=np.zeros((count, steps, len(PLAYED), joints)),
            scale=np.ones((count, len(PLAYED), joints)),
            valid=np.ones((count, steps), dtype=bool),
            edges=tuple((begun, np.concatenate([m.target[:1], m.target])) for m in motions),
            switches=tuple((begun, np.concatenate([[True], m.torque_enable])) for m in motions),
            length=float(t[-1]) + self.period,
        )

    def recording(self, played: Rehearsal, seed: int) -> Recording:
        """Return what the robot's logger would write of a design, noise included."""
        windows, like = self.comparison.windows, self.comparison.recordings[0].meta
        rng, joints = np.random.default_rng(seed), windows.joints
        channels = {"t": np.arange(len(played.q)) * self.period}
        sensed = {"q_target": played.motion.target}
        for c, (name, values) in enumerate((("q", played.q), ("qd", played.qd))):
            sd = np.where(np.isfinite(self.noise[c]), self.noise[c], 0.0)
            sensed[name] = values + sd * rng.standard_normal(values.shape)
        for name, values in sensed.items():
            channels |= dict(zip(joint_channels(name, joints), values.T, strict=True))
        channels[FLAG] = played.motion.torque_enable
        return Recording(
            dataclasses.replace(
                like,
                joints=joints,
                rate_hz=1.0 / self.period,
                base="fixed",
                base_quat=played.design.attitude.quat,
                kp=tuple(float(v) for v in played.kp),
                kd=tuple(float(v) for v in played.kd),
                excitation=played.design.excitation,
                episode=f"design_{seed}",
                repeat_of=None,
                source="simulated",
                tool="go1exp gap next",
            ),
            channels,
        )

    def scored(self, played: Sequence[Rehearsal], dt: float, few: int) -> Scorer:
        """Return what scores replays of designs: their windows, whose ``episode`` is the number of the design.

        At most ``few`` windows of each, spread over the motion but for its beginning. RecordingError if not one window
        fits.
        """
        comparison, settings = self.comparison, self.comparison.settings
        recordings = [_later(self.recording(r, k), FADE_S) for k, r in enumerate(played)]
        stride = (self.seconds - FADE_S - settings.burn_s - settings.window_s) / few
        settings = dataclasses.replace(settings, stride_s=max(stride, settings.stride_s))
        ready = Ready(tuple(recordings), settings, comparison.ready.ignored, ())
        windows = comparison.robot.windows(ready)
        quats = np.array([played[e].design.attitude.quat for e in windows.episode])
        replayer = comparison.robot.replayer(windows, quats, settings.max_rows, settings.threads)
        step = np.array([comparison.numerical.get(name, 0.0) for name in windows.quantities])
        scale = np.hypot(windows.scale, step[:, None])
        return scorer(replayer, self.theta, scale, dt, settings.clock_s)


def _later(recording: Recording, seconds: float) -> Recording:
    keep = recording.t >= recording.t[0] + seconds
    if keep.sum() < 2:
        raise RecordingError(f"{recording.meta.episode}: shorter than {seconds:g} s")
    return Recording(recording.meta, {name: values[keep] for name, values in recording.channels.items()})


def write(played: Rehearsal, joints: tuple[str, ...], period: float, path: Path) -> Path:
    """Write a design as a CSV for ``playback``: t, s; targets, rad; gains, N m/rad and N m s/rad; drives on or not."""
    rows = len(played.motion.target)
    names = ["t", *joint_channels("q_target", joints), *joint_channels("kp", joints), *joint_channels("kd", joints)]
    gains = np.tile(np.concatenate([played.kp, played.kd]), (rows, 1))
    t = np.arange(rows)[:, None] * period
    values = np.concatenate([t, played.motion.target, gains], axis=1)
    lines = [",".join([*names, FLAG])]
    for row, on in zip(values, played.motion.torque_enable, strict=True):
        lines.append(",".join([f"{row[0]:.6f}", *(f"{v:.5f}".rstrip("0").rstrip(".") for v in row[1:]), str(int(on))]))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "\n".join(lines) + "\n")
    return path
