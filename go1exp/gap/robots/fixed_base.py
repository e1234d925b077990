"""Any chain of hinges on a fixed base, from a description, and its recordings completed by that description.

Such recordings may have no gains or velocities, or velocities that disagree with their own angles. What is then
compared, and what is assumed, is written to the warnings.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import go1exp.sim.actuator  # noqa: F401  (registers every actuator)
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import ConfigError, Entry, Term
from go1exp.gap.data.cutting import Place, cut
from go1exp.gap.data.prepare import HINT, TELLING, Ready, clock_of_speeds, noise_in_time, slope, spaced
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import drive_law
from go1exp.gap.result import Clock, GapSettings, Phase
from go1exp.gap.robots.description import Go1Model, ModelConfig
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.robots.protocol import Robot
from go1exp.logs.audit import AuditReport
from go1exp.logs.audit.related import SPEED_CHECKS
from go1exp.logs.recording import Recording, joint_channel, joint_channels
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.config import RobotConfig
from go1exp.sim.actuator.motors import Gains
from go1exp.sim.effects.tolerances import DECLARED, Tolerances
from go1exp.sim.physics.fixed_base import FixedBaseError, build_fixed_base, feel_each_other
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import NO_SENSORS


class TorqueDrive(Gains):
    """A drive that is commanded a torque: its target is a torque, N m, clipped at the peak. Gains do nothing."""

    def __init__(self, setup: ActuatorSetup) -> None:
        """Note the peak torque."""
        self.kp, self.kd = setup.zeros(), setup.zeros()
        self._limit = setup.effort_limit

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the joint torques (N, J), N m."""
        return torch.clamp(target, -self._limit, self._limit)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""


@dataclass(frozen=True)
class FixedBase:
    """A robot of hinges on a fixed base: its description, its ``top_speed`` (J,) in rad/s, and all of a ``Machine``."""

    config: ModelConfig
    joints: tuple[str, ...]
    groups: tuple[tuple[int, ...], ...]
    effort: tuple[float, ...]
    top_speed: tuple[float, ...]
    tolerances: Tolerances = DECLARED
    base_probe: tuple[float, ...] = ()
    on_ground: bool = False

    @staticmethod
    def from_config(config: ModelConfig, path: str = "model") -> FixedBase:
        """Check a description against its MuJoCo file; ConfigError with every problem, each naming its key."""
        index = {name: k for k, name in enumerate(config.joints)}
        groups = tuple(tuple(index[name] for name in group) for group in config.joint_groups)
        effort, top = (tuple(float(v) for v in config.per_joint(name)) for name in ("torque_limit", "speed_limit"))
        machine = FixedBase(config, config.joints, groups, effort, top, Tolerances.from_effects(config.tolerances))
        try:
            model = machine.model(0.001, (1.0, 0.0, 0.0, 0.0))
        except FixedBaseError as error:
            raise ConfigError([f"{path}.{error}"]) from None
        group_of = {k: g for g, members in enumerate(groups) for k in members}
        for a in range(len(index)):
            for b in range(a):
                if group_of[a] != group_of[b] and feel_each_other(model, a, b):
                    names = f"{config.joints[b]} and {config.joints[a]}"
                    raise ConfigError([f"{path}.groups: {names} must be in one group, since one carries the other"])
        return machine

    @property
    def angle_range(self) -> np.ndarray:
        """Lowest and highest angle (J, 2), rad; NaN where the MuJoCo file has no stops."""
        model = self.model(0.001, (1.0, 0.0, 0.0, 0.0))
        return np.where(model.jnt_limited[:, None], model.jnt_range, np.nan)

    def model(self, physics_dt: float, base_quat: Sequence[float], mounted: bool = False) -> Any:
        """Return the compiled MuJoCo model; the base of one that is ``mounted`` can move."""
        file, base = Path(self.config.mjcf), self.config.base
        return build_fixed_base(file, base, self.joints, self.effort, physics_dt, base_quat, mounted)

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[MujocoCpu, ActuatorSetup]:
        """Return a backend with ``num`` robots, and their drives."""
        backend = MujocoCpu(self.model(physics_dt, base_quat, mounted), NO_SENSORS, num, threads)
        like = backend.qpos

        def tensor(values: Sequence[float]) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=like.dtype, device=like.device)

        setup = ActuatorSetup(
            num_envs=num,
            physics_dt=physics_dt,
            joints=self.joints,
            effort_limit=tensor(self.effort),
            velocity_limit=tensor(self.top_speed),
            armature=backend.compiled("dof_armature")[-len(self.joints) :],
            random=EnvRandom(0, num, device=like.device),
            device=like.device,
            dtype=like.dtype,
            floating=False,
            mounted=mounted,
        )
        return backend, setup

    @property
    def guessed_gains(self) -> bool:
        """Whether the model has gains, for recordings that say none."""
        return self.config.kp is not None or self.config.firmware is not None

    def drive(self) -> Term:
        """Return what turns commands into torques."""
        if self.config.drive == "torque":
            return Term("torque", Entry("actuator", "torque", TorqueDrive), {})
        # The motor's line goes from the stall torque, or else the peak torque, to the top speed.
        voltage = self.config.drive == "voltage"
        return drive_law("voltage", stall=self.config.stall_torque) if voltage else drive_law("pd")

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> FixedBase:
        """Return itself: its base is always fixed."""
        return self

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared, a line each."""
        meta, name, config = recording.meta, recording.meta.episode, self.config
        flaws = []
        if meta.robot not in config.robots:
            flaws.append(f"{name}: is of the robot {meta.robot!r}; the model is of {', '.join(config.robots)}; {HINT}")
        if sorted(meta.joints) != sorted(config.joints):
            flaws.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(config.joints)}")
            return flaws
        if meta.base != "fixed":
            flaws.append(f"{name}: the base is free; only robots with a fixed base can be compared")
        command = "tau_cmd" if config.drive == "torque" else "q_target"
        flaws += [f"{name}: no {quantity}" for quantity in ("q", command) if not recording.has(quantity)]
        if config.drive != "torque" and gains_of(recording, config) is None:
            flaws.append(f"{name}: says no gains (kp, kd), and the model has none")
        needed = {"t", "all", *joint_channels("q", meta.joints), *joint_channels(command, meta.joints)}
        for flaw in report.flaws:
            # Windows with a hole are left out anyway, so holes are bad only where hardly any window is left.
            if flaw.verdict == "bad" and flaw.channel in needed and flaw.check not in (*TELLING, "gaps"):
                flaws.append(f"{name}: {flaw.channel}: {flaw.message}")
        return flaws

    def by_clock(self, clock: Clock, speeds: Literal["checked", "ignored"] | None = None) -> FixedBase:
        """Return the robot whose recordings are read by one clock; ``speeds`` as in its description, kept if None."""
        return replace(self, config=replace(self.config, clock=clock, speeds=speeds or self.config.speeds))

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return recordings with what the description adds, and affordable windows; ValueError if the clock is open."""
        if self.config.clock == "compare":
            raise ValueError("model.clock = 'compare': take a clock first (gap.comparison.compare does)")
        warnings = []
        wrong = wrong_speeds(recordings, reports, self.config)
        if wrong:
            warnings.append(f"Speeds are not compared, and initial speeds come from the angles: {wrong}.")
        whole = tuple(completed(r, self.config, bool(wrong)) for r in recordings)
        warnings += [*clock_warnings(recordings, whole, self.config), *gain_warnings(recordings, self.config)]
        settings, spacing_warnings = spaced(whole, settings, len(self.groups[0]))
        return Ready(whole, settings, ("qd",) if wrong else (), (*warnings, *spacing_warnings))

    def windows(self, ready: Ready, places: Sequence[Sequence[Place]] | None = None) -> Windows:
        """Cut recordings into windows, at ``places`` of each if given; what is ignored has infinite noise."""
        windows = cut(ready.recordings, ready.settings, places=places)
        if self.config.clock == "speeds":
            windows.scale[:, 0] = noise_in_time(ready.recordings)
        for c, quantity in enumerate(windows.quantities):
            if quantity in ready.ignored:
                windows.scale[:, c] = np.inf
        return windows

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what runs this robot through windows."""
        return Replayer(self, windows, quats, max_rows, threads)


def wrong_speeds(recordings: Sequence[Recording], reports: Sequence[AuditReport], config: ModelConfig) -> str:
    """Return why speeds are not compared; empty if they are."""
    if config.clock == "speeds":
        return "they make the clock"
    if config.speeds == "ignored":
        return "the model says so (speeds: ignored)"
    missing = sum(not r.has("qd") for r in recordings)
    if missing:
        return f"{missing} of {len(recordings)} recordings have none"
    bad = [
        flaw
        for report in reports
        for flaw in report.flaws
        if flaw.channel.startswith("qd_") and (flaw.verdict == "bad" or flaw.check in SPEED_CHECKS)
    ]
    return f"{bad[0].channel} {bad[0].message}, and {len(bad) - 1} more such" if bad else ""


def clock_warnings(before: Sequence[Recording], after: Sequence[Recording], config: ModelConfig) -> list[str]:
    """Return what became of the clocks, a sentence each."""
    if config.clock != "speeds":
        return []
    without = [r.meta.episode for r in before if not r.has("qd")]
    rates = [len(r.t) / float(r.t[-1] - r.t[0]) for r in after]
    rate = f"Times were worked out from speeds and angles: rows come at {min(rates):.4g} to {max(rates):.4g} Hz."
    return [rate, *(f"{name} has no speeds and keeps its clock." for name in without)]


def gains_of(recording: Recording, config: ModelConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the gains (J,) in the robot's order; None if one is not known."""
    meta = recording.meta
    if config.drive == "torque":
        return np.zeros(len(config.joints)), np.zeros(len(config.joints))
    order = [meta.joints.index(name) for name in config.joints]
    kp, kd = config.per_joint("kp"), config.per_joint("kd")
    if config.firmware and (match := re.search(config.firmware.note, meta.notes)):
        kp = np.full(len(config.joints), config.firmware.kp * float(match.group(1)))
    kp = kp if meta.kp is None else np.array(meta.kp)[order]
    kd = kd if meta.kd is None else np.array(meta.kd)[order]
    return None if np.isnan([kp, kd]).any() else (kp, kd)


def gain_warnings(recordings: Sequence[Recording], config: ModelConfig) -> list[str]:
    """Return which gains were taken from the model, a sentence each."""
    if config.drive == "torque":
        return ["Commanded torques are played open loop."]
    guessed = [name for name in ("kp", "kd") if any(getattr(r.meta, name) is None for r in recordings)]
    if not guessed:
        return []
    shown = []
    for name, place in (("kp", 0), ("kd", 1)):
        values = np.concatenate([gains[place] for r in recordings if (gains := gains_of(r, config))])
        if name in guessed:
            shown.append(f"{name} {' '.join(f'{v:.3g}' for v in np.unique(values.round(6)))}")
    return [f"Gains that the recordings do not say are the model's guess: {', '.join(shown)}."]


def completed(recording: Recording, config: ModelConfig, speeds: bool) -> Recording:
    """Return a recording with joints in order, gains, a command in the place of the target, and speeds from angles."""
    gains = gains_of(recording, config)
    assert gains is not None
    channels = dict(recording.channels)
    if config.drive == "torque":
        for joint in config.joints:
            channels[joint_channel("q_target", joint)] = channels[joint_channel("tau_cmd", joint)]
    if config.clock == "speeds" and recording.has("qd"):
        q, qd = (recording.block(*joint_channels(name, config.joints)) for name in ("q", "qd"))
        channels["t"] = clock_of_speeds(recording.t, q, qd)
    if speeds:
        for joint in config.joints:
            channels[joint_channel("qd", joint)] = slope(channels["t"], channels[joint_channel("q", joint)])
    kp, kd = (tuple(float(v) for v in values) for values in gains)
    limit = tuple(float(v) for v in config.per_joint("torque_limit"))
    meta = dataclasses.replace(recording.meta, joints=config.joints, kp=kp, kd=kd, tau_limit=limit)
    return Recording(meta, channels)


def robot_of(
    model: ModelConfig | Go1Model, config: RobotConfig, path: str = "model", contact: ContactConfig | None = None
) -> Robot:
    """Return the robot of a description, which messages call ``path``; the Go1 is ``config``, suspended.

    ``contact`` is of a Go1's feet, if one was chosen. ConfigError naming the key, if its MuJoCo file does not suit it,
    or a contact was chosen for a fixed base.
    """
    if isinstance(model, Go1Model):
        return suspended(config, Tolerances.from_effects(model.tolerances), contact)
    if contact is not None:
        raise ConfigError(
            [f"contact: is of the feet of a Go1; {path} is a robot on a fixed base, and it would do nothing"]
        )
    return FixedBase.from_config(model, path)
