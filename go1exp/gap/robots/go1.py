"""The Go1 as ``gap`` replays it: suspended, standing, or in swing phases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, cast

import numpy as np

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.config.schema.registry import Term
from go1exp.gap.data.cutting import cut
from go1exp.gap.data.prepare import HINT, TELLING, Ready, contact_of, contact_warnings
from go1exp.gap.data.standing import StandingWindows, cut_standing, for_feet, missing
from go1exp.gap.data.swings import SwingWindows, cut_swings, for_swings
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Machine, drive_law
from go1exp.gap.replay.walking import HEAVY, StandingReplayer, SwingReplayer
from go1exp.gap.result import GapSettings, Phase
from go1exp.gap.robots.protocol import Robot
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.config import RobotConfig
from go1exp.sim.effects.tolerances import DECLARED, Tolerances
from go1exp.sim.env.plant import actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors, build_model, weigh_down
from go1exp.sim.terrain import TerrainConfig, build_terrain

GO1 = "go1"
ONE_GROUP = (tuple(range(robot.NUM_JOINTS)),)
"""Legs feel each other through a trunk that is free: all joints are one group."""

NEEDED = ("t", "q", "qd", "q_target")  # channels, or quantities, without which nothing can be replayed


NO_SENSORS = 1 << 13
"""MuJoCo's mjDSBL_SENSOR: the IMU's readings follow from the motion of the base, and those of contacts cost time."""

BASE_PROBE = (5.0e-4, 1.0e-3, 1.0e-3, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""Changes of a base's initial height, roll, pitch, velocity and rate by which their influence is measured."""

IMU_PROBE = (0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.0005)
"""Errors of accelerometer, m/s2, gyro, rad/s, and delay, s, by which the influence of the IMU is measured."""

LEGS = tuple(tuple(range(3 * leg, 3 * leg + 3)) for leg in range(robot.NUM_LEGS))
ON_MUJOCO = DECLARED.on(MUJOCO_CONTACT)


@dataclass(frozen=True)
class Go1:
    """Base of the Go1's kinds of comparison, which differ in what a ``Machine`` says and in whether the trunk moves."""

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = ONE_GROUP
    base_probe: tuple[float, ...] = ()
    on_ground: bool = False
    tolerances: Tolerances = DECLARED
    free_trunk: ClassVar[bool] = True
    guessed_gains: ClassVar[bool] = False

    @property
    def effort(self) -> tuple[float, ...]:
        """Peak torque (J,), N m."""
        return tuple(float(v) for v in robot.per_joint(self.config.effort_limit))

    def drive(self) -> Term:
        """Return the ideal PD law."""
        return drive_law("pd")

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> Robot:
        """Return the robot as it is in these recordings: itself, if its trunk is free."""
        return cast(Robot, self)

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are."""
        return Ready(tuple(recordings), settings)

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared, a line each; with a free trunk, one of a held trunk can be."""
        meta, name = recording.meta, recording.meta.episode
        flaws = []
        if meta.robot != GO1:
            flaws.append(f"{name}: is of the robot {meta.robot!r}; the model is of {GO1!r}; {HINT}")
        if meta.joints != self.joints:
            flaws.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(self.joints)}")
            return flaws
        if meta.base != "fixed" and not self.free_trunk:
            flaws.append(f"{name}: the trunk is free; only robots with a fixed base can be compared")
        if meta.kp is None or meta.kd is None:
            flaws.append(f"{name}: says no gains (kp, kd)")
        flaws += [f"{name}: no {q}" for q in ("q", "qd", "q_target") if not recording.has(q)]
        if self.free_trunk:
            flaws += [f"{name}: no {quantity}" for quantity in missing(recording)]
        # The weight of a standing robot moves joints against their targets; the comparison shows a flipped sign.
        telling = (*TELLING, "sign") if meta.base == "floating" else TELLING
        if not flaws:
            for flaw in report.flaws:
                needed = flaw.channel in (*NEEDED, "all") or flaw.channel.startswith(("q_", "qd_"))
                if flaw.verdict == "bad" and needed and flaw.check not in telling:
                    flaws.append(f"{name}: {flaw.channel}: {flaw.message}")
        return flaws

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[MujocoCpu, ActuatorSetup]:
        """Return a backend with ``num`` robots, and their drives; a free trunk has no use for ``base_quat``."""
        model, blocks = self._model(physics_dt, base_quat, mounted)
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, actuator_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))

    def _model(self, physics_dt: float, base_quat: Sequence[float], mounted: bool) -> tuple[Any, Sensors]:
        raise NotImplementedError


@dataclass(frozen=True)
class StandingGo1(Go1):
    """A Go1 on flat ground, its trunk free, with its contact's tolerances; ``held`` is the same, its trunk held."""

    base_probe: tuple[float, ...] = BASE_PROBE
    on_ground: bool = True
    tolerances: Tolerances = ON_MUJOCO
    contact: ContactConfig = MUJOCO_CONTACT
    held: Machine = field(kw_only=True)

    def _model(self, physics_dt: float, base_quat: Sequence[float], mounted: bool) -> tuple[Any, Sensors]:
        ground = build_terrain(TerrainConfig(kind="flat"))
        model, blocks = build_model(self.config, ground, physics_dt, contact=self.contact)
        model.opt.disableflags |= NO_SENSORS
        return model, blocks

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are, with windows that suit contact."""
        warnings = tuple(contact_warnings(recordings, self.contact))
        return Ready(tuple(recordings), for_feet(settings, recordings), warnings=warnings)

    def windows(self, ready: Ready) -> StandingWindows:
        """Cut recordings into windows that begin where at least two feet carry weight."""
        return cut_standing(ready.recordings, ready.settings, self.config)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows on the feet, and those of a held trunk among them."""
        standing = cast(StandingWindows, windows)  # that this robot cut
        return StandingReplayer(self, standing, quats, max_rows, threads, held=self.held)


@dataclass(frozen=True)
class SwingingGo1(Go1):
    """A Go1 that walks, of which the legs in the air are compared: nothing that acts on trunk or feet is felt.

    All joints are one group, since which legs swing changes from window to window; ``base_probe`` is of the IMU.
    """

    base_probe: tuple[float, ...] = IMU_PROBE

    def _model(self, physics_dt: float, base_quat: Sequence[float], mounted: bool) -> tuple[Any, Sensors]:
        model, blocks = build_model(self.config, None, physics_dt)
        weigh_down(model, HEAVY)
        return model, blocks

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return the recordings as they are, with windows that suit swings."""
        return Ready(tuple(recordings), for_swings(settings))

    def windows(self, ready: Ready) -> SwingWindows:
        """Cut recordings into windows of legs in the air."""
        return cut_swings(ready.recordings, ready.settings, self.config)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows of legs in the air."""
        return SwingReplayer(self, cast(SwingWindows, windows), quats, max_rows, threads)


@dataclass(frozen=True)
class SuspendedGo1(Go1):
    """A Go1 whose trunk is held: legs do not feel each other. ``contact`` of its feet: None is that of recordings."""

    groups: tuple[tuple[int, ...], ...] = LEGS
    contact: ContactConfig | None = None
    free_trunk: ClassVar[bool] = False

    @property
    def top_speed(self) -> tuple[float, ...]:
        """Speed without load (J,), rad/s."""
        return tuple(float(v) for v in robot.per_joint(self.config.velocity_limit))

    @property
    def angle_range(self) -> np.ndarray:
        """Lowest and highest angle (J, 2), rad."""
        return robot.JOINT_POS_LIMITS.copy()

    def _model(self, physics_dt: float, base_quat: Sequence[float], mounted: bool) -> tuple[Any, Sensors]:
        w, x, y, z = base_quat
        return build_model(self.config, None, physics_dt, held=(w, x, y, z), mounted=mounted)

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> Robot:
        """Return the Go1 standing, its legs in the air, or this one; ConfigError if contacts of recordings differ."""
        if not any(r.meta.base == "floating" for r in recordings):
            return self
        if phase == "swing":
            return SwingingGo1(self.config, tolerances=self.tolerances)
        contact = contact_of(recordings, self.contact)
        held, known = replace(self, groups=ONE_GROUP), self.tolerances.on(contact)
        return StandingGo1(self.config, held=held, tolerances=known, contact=contact)

    def windows(self, ready: Ready) -> Windows:
        """Cut recordings into windows."""
        return cut(ready.recordings, ready.settings)

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what replays windows of a held trunk."""
        return Replayer(self, windows, quats, max_rows, threads)


def suspended(config: RobotConfig, tolerances: Tolerances = DECLARED, contact: ContactConfig | None = None) -> Robot:
    """Return a Go1 whose trunk is held; where it stands it has ``contact``, or the one that recordings name."""
    return SuspendedGo1(config, tolerances=tolerances, contact=contact)
