"""Any chain of hinges on a fixed base, from a description."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import go1exp.sim.actuator  # noqa: F401  (registers every actuator)
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.registry import ConfigError, Entry, Term
from go1exp.gap.data.cutting import Place, cut
from go1exp.gap.data.prepare import Ready, noise_in_time, spaced
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import pd, voltage
from go1exp.gap.result import Clock, GapSettings, Phase
from go1exp.gap.robots.completion import clock_warnings, completed, flaws_of, gain_warnings, wrong_speeds
from go1exp.gap.robots.description import ModelConfig
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.setup import Gains
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
    """A robot of hinges on a fixed base.

    Attributes:
        config: its description.
        joints: names, as recordings have them.
        groups: numbers of the joints that move together.
        effort: peak torque (J,), N m.
        top_speed: (J,) rad/s.
        tolerances: of nominal parameters.
        base_probe: none.
        on_ground: no.
    """

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
        """Check a description against its MuJoCo file.

        Raises:
            ConfigError: with every problem, each naming its key.
        """
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
    ) -> tuple[Any, ActuatorSetup]:
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

    def drive(self) -> Term:
        """Return what turns commands into torques."""
        if self.config.drive == "torque":
            return Term("torque", Entry("actuator", "torque", TorqueDrive), {})
        return voltage(self.config.stall_torque) if self.config.drive == "voltage" else pd()

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> FixedBase:
        """Return itself: its base is always fixed."""
        return self

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared, a line each."""
        return flaws_of(recording, report, self.config)

    def by_clock(self, clock: Clock, speeds: Literal["checked", "ignored"] | None = None) -> FixedBase:
        """Return the robot whose recordings are read by one clock; ``speeds`` as in its description, kept if None."""
        return replace(self, config=replace(self.config, clock=clock, speeds=speeds or self.config.speeds))

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return recordings with what they lack taken from the description, and windows whose number is affordable.

        Raises:
            ValueError: if which clock they are read by is still to be compared.
        """
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
