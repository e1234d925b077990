"""``protocol=recover``: getting up, and a fall after which the motors only brake."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from go1exp import robot
from go1exp.base.report import plots
from go1exp.config.schema.registry import Gain, NonNegative, Positive, protocol, within
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, lives
from go1exp.evaluate.protocol.plan import NEVER, Array, Brake, Braking, Impulse, Impulses, Plan, Signal
from go1exp.evaluate.quantities import ROBOT, Column, Derived, Row, Summaries, values

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.evaluate.protocol.stage import Stage
    from go1exp.mdp.types import Snapshot

LYING, PUSHED = ("side", "back"), "pushed"
FIGURES = 3  # of ``posture``
AFTER = ("rested", "rest_s", "sink", "torque_share", "joint_speed")  # columns of a robot that fell
Tilt = Annotated[float, Field(gt=0, lt=NEVER)]


@settings
class Stand:
    """When a robot stands.

    Attributes:
        height: least height of the trunk over the ground, m.
        tilt: largest angle of the trunk to the vertical, rad.
        hold_s: time for which both must hold, s.
    """

    height: Annotated[Positive, within(0.0, 1.0, "m")]
    tilt: Tilt
    hold_s: Positive


@settings
class Rest:
    """When a robot lies still.

    Attributes:
        speed: largest speed of the trunk, m/s, and largest angular velocity, rad/s.
        joint_speed: largest joint velocity, rad/s.
    """

    speed: Positive
    joint_speed: Positive


@settings
class Push:
    """The kick that makes a robot fall.

    Attributes:
        impulse: N s; 12.74 kg gain 1 m/s by 12.7.
        push_s: duration of the half-sine force, s.
        after_s: time before it, s.
    """

    impulse: Impulse
    push_s: Positive
    after_s: NonNegative


@settings
class AfterFall:
    """Braking after a fall.

    Attributes:
        tilt: angle of the trunk to the vertical from which on the motors only brake, rad.
        kd: braking gain, N m s/rad.
        seconds: time that is watched after the kick, s.
    """

    tilt: Tilt
    kd: Gain
    seconds: Positive


@protocol("recover")
@settings
class Recover(Protocol):
    """Getting up from side and back; and a fall after which the motors only brake: speeds, and time until at rest.

    Attributes:
        drop_m: height of the trunk from which robots fall on side or back, with random joint angles, m.
        hold: gains with which their joints are held there: kp N m/rad, kd N m s/rad.
        settle_s: time until they lie still and the policy begins, s.
        seconds: time to get up, with a zero command, s.
        stand: when a robot stands.
        rest: when a robot lies still.
        command: commanded velocity before the push.
        push: the push.
        brake: what follows it.
    """

    drop_m: Annotated[float, Field(gt=0, le=2)]
    hold: tuple[Gain, Gain]
    settle_s: Positive
    seconds: Positive
    stand: Stand
    rest: Rest
    command: Signal
    push: Push
    brake: AfterFall

    identical: ClassVar[bool] = False
    keys: ClassVar[tuple[str, ...]] = ("case",)
    derived_names: ClassVar[tuple[str, ...]] = ("median_s",)
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column("lay", "", "lay still, tilted as after a fall, when the policy began", "share"),
        Column("stood", "", "stood up and stayed so for the time to hold, of those that lay", "share", "higher"),
        Column("stand_s", "s", "time until it stands, of those that stood up", better="lower"),
        Column("toppled", "", "fell, so that the motors braked", "share"),
        Column("rested", "", "at rest at the end, of those that fell", "share", "higher"),
        Column("rest_s", "s", "time from the fall until at rest, of those", better="lower"),
        Column("sink", "m/s", "largest downward speed of the trunk after the fall", better="lower"),
        Column("torque_share", "", "largest torque of a joint over its peak torque", better="lower"),
        Column("joint_speed", "rad/s", "largest joint velocity", better="lower"),
    )

    @property
    def watched(self) -> float:
        """Length of the walk with its push, s."""
        return self.push.after_s + self.push.push_s + self.brake.seconds

    def lengths(self) -> list[Length]:
        """Return those of settling, of getting up and of the fall."""
        lying, before = len(LYING) * self.robots, self.push.after_s + self.push.push_s
        pushed = [
            Cause("brake.seconds", self.brake.seconds, fitting=lambda seconds: seconds - before),
            Cause("push.after_s", self.push.after_s, fitting=lambda seconds: seconds - self.watched + before),
        ]
        return [
            Length(self.settle_s, lying, [Cause("settle_s", self.settle_s)], figures=FIGURES),
            Length(self.seconds, lying, [Cause("seconds", self.seconds)], 0.0, bool(self.terms()), figures=FIGURES),
            Length(self.watched, self.robots, pushed, figures=FIGURES),
        ]

    def play(self, stage: Stage) -> Played:
        """Let robots lie down and get up, then push others over."""
        return Played(self._get_up(stage) + self._fall(stage))

    def _get_up(self, stage: Stage) -> list[Row]:
        """Return a row for each robot that lay on its side, then for each that lay on its back."""
        count, (kp, kd) = len(LYING) * self.robots, self.hold
        nothing = np.zeros((len(stage.times(self.settle_s)), count, 3))
        start = np.stack([self.lying(stage, n) for n in range(count)])
        dropped: dict[str, Any] = {"start": start, "terminations": (), "figures": posture}
        drop = stage.session(Plan(nothing, **dropped, braking=Braking(0.0, kd, kp)))
        figures = drop.run(len(nothing)).figures
        assert figures is not None
        lay = self._at_rest(figures)[-1] & (figures[-1, :, 0] > self.brake.tilt)
        dropped["start"] = drop.core.backend.qpos.numpy().copy()
        nothing, listen = np.zeros((len(stage.times(self.seconds)), count, 3)), 0 if self.terms() else None
        rise = stage.session(Plan(nothing, **dropped, braking=Braking(NEVER, 0.0), listen_from=listen))
        motion = rise.run(len(nothing))
        assert motion.figures is not None
        assert rise.brake is not None
        times = stood_up(motion.height, motion.figures[..., 0], motion.dt, self.stand)
        rows = lives(motion)
        for n, row in enumerate(rows):
            stood = bool(np.isfinite(times[n])) if lay[n] else None
            row |= {"case": LYING[n // self.robots], ROBOT: n % self.robots, "lay": bool(lay[n]), "fell": None}
            row |= {"stood": stood, "stand_s": round(float(times[n]), 4) if stood else None}
            row |= {name: float(getattr(rise.brake, name)[n]) for name in ("torque_share", "joint_speed")}
        self.measure(motion, rows)
        return rows

    def lying(self, stage: Stage, n: int) -> Array:
        """Return the state (19,) from which a robot is dropped; odd robots on the other side."""
        case, number = LYING[n // self.robots], n % self.robots
        rng = np.random.default_rng([stage.setting.seed, number])
        roll = np.pi if case == "back" else 0.5 * np.pi * (-1.0 if number % 2 else 1.0)
        half_yaw, half_roll = 0.5 * rng.uniform(-np.pi, np.pi), 0.5 * roll
        about_z, about_x = (np.array([np.cos(half), np.sin(half)]) for half in (half_yaw, half_roll))
        quat = np.outer(about_z, about_x).ravel()[[0, 1, 3, 2]]  # the roll, then the yaw
        joints = rng.uniform(*robot.JOINT_POS_LIMITS.T)
        return np.concatenate([[0.0, 0.0, self.drop_m], quat, joints])

    def _fall(self, stage: Stage) -> list[Row]:
        """Return a row for each robot that was pushed while walking, from all sides in turn."""
        n, t = self.robots, stage.times(self.watched)
        each = (np.full((n, 1), self.push.after_s), np.full((n, 1), self.push.impulse))
        sides = 2.0 * np.pi * np.arange(n)[:, None] / n
        kick = Impulses(*each, sides, self.push.push_s)
        command = np.repeat(self.command.at(t)[:, None], n, 1)
        braking = Braking(self.brake.tilt, self.brake.kd)
        session = stage.session(Plan(command, impulses=kick, terminations=(), braking=braking, figures=posture))
        motion = session.run(len(t))
        brake = session.brake
        assert brake is not None
        assert motion.figures is not None
        rests = self._at_rest(motion.figures)
        rows = lives(motion)
        for k, row in enumerate(rows):
            fell = bool(brake.since[k].isfinite())
            row |= {"case": PUSHED, ROBOT: k, "toppled": fell, "fell": fell}
            row["moving_s"] = min(row["moving_s"], round(float(brake.since[k]), 4))
            row |= self._after(brake, k, rests[:, k], motion.t) if fell else dict.fromkeys(AFTER)
        return rows

    def _after(self, brake: Brake, k: int, rests: NDArray[np.bool_], t: Array) -> Row:
        """Return what was largest after the fall of robot ``k``, and when it was at rest for good."""
        row: Row = {name: float(getattr(brake, name)[k]) for name in AFTER[2:]}
        moving = np.flatnonzero(~rests)
        rested = not len(moving) or int(moving[-1]) < len(t) - 1
        since = float(t[moving[-1] + 1] - brake.since[k]) if rested and len(moving) else None
        return row | {"rested": rested, "rest_s": since}

    def _at_rest(self, figures: Array) -> NDArray[np.bool_]:
        """Return (T, N) whether robots lie still."""
        return np.asarray((figures[..., 1] < self.rest.speed) & (figures[..., 2] < self.rest.joint_speed))

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return the median time to stand up from each posture."""
        text = "median time until it stands, of those that stood up"
        return [Derived("median_s", "s", text, {"case": case}, "lower", _median) for case in LYING]

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the share that stands over time."""
        text = "Share of robots that stand, and stay so, over the time since the policy began."
        return [plots.Drawing("standing", "Getting up", text, partial(_standing, plays, self.seconds))]


def posture(s: Snapshot) -> Tensor:
    """Return tilt, rad, larger speed of the trunk (m/s, rad/s), and largest joint velocity, rad/s (N, 3)."""
    tilt = torch.acos((-s.projected_gravity_b[:, 2]).clamp(-1.0, 1.0))
    speed = torch.maximum(s.base_lin_vel_b.norm(dim=-1), s.base_ang_vel_b.norm(dim=-1))
    return torch.stack([tilt, speed, s.joint_vel.abs().amax(-1)], 1)


def stood_up(height: Array, tilt: Array, dt: float, stand: Stand) -> Array:
    """Return the time (N,) from which each robot stands for ``hold_s``, s; NaN if it never does."""
    good = (height >= stand.height) & (tilt <= stand.tilt)
    hold = max(1, round(stand.hold_s / dt))
    times = np.full(good.shape[1], np.nan)
    for n in range(good.shape[1]):
        held = np.flatnonzero(np.convolve(good[:, n], np.ones(hold), "valid") > hold - 0.5)
        if len(held) and len(good) >= hold:
            times[n] = (held[0] + 1) * dt
    return times


def _median(rows: Sequence[Row]) -> float:
    each = values(rows, "stand_s")
    return float(np.nanmedian(each)) if np.isfinite(each).any() else np.nan


def _standing(plays: Mapping[str, Played], seconds: float) -> plots.Figure:
    figure, axes = plots.panels(1, len(LYING), height=2.2, sharey=True)
    for k, (who, played) in enumerate(plays.items()):
        for ax, case in zip(axes[0], LYING, strict=True):
            rows = [r for r in played.rows if r["case"] == case and r["lay"]]
            times = np.sort([r["stand_s"] for r in rows if r["stood"]])
            share = np.arange(len(times) + 1) / max(len(rows), 1)
            at = np.concatenate([[0.0], times, [seconds]])
            ax.step(at, [*share, share[-1]], where="post", color=plots.COLOURS[k % len(plots.COLOURS)], label=who)
            ax.set_title(f"from the {case}", loc="left")
            ax.set(xlabel="time (s)", ylim=(-0.04, 1.04))
    axes[0, 0].set_ylabel("share that stands")
    plots.legend(figure, axes[0, 0])
    return figure
