"""The machine that is replayed, and rows of a batched replay: a window, parameter values and an initial state each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

import go1exp.sim.actuator
import go1exp.sim.effects  # noqa: F401  (registers every effect)
from go1exp.config.schema.registry import Term, bind
from go1exp.robot import MOUNT_HINGES, MOUNT_SLIDES
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.tolerances import Tolerances, declared, effect_class, sizes
from go1exp.sim.physics.backend import PhysicsBackend


class Machine(Protocol):
    """A robot that can be replayed."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Joints that move together, equally many in each group; groups do not feel each other."""

    @property
    def base_probe(self) -> tuple[float, ...]:
        """Changes of a free base's initial state, or of its IMU's errors, that are measured; empty for a held one."""

    @property
    def on_ground(self) -> bool:
        """Whether it stands, so that it feels what acts on its trunk and on the ground."""

    @property
    def guessed_gains(self) -> bool:
        """Whether the model has gains, for recordings that say none."""

    @property
    def effort(self) -> tuple[float, ...]:
        """Peak torque (J,), N m."""

    @property
    def tolerances(self) -> Tolerances:
        """How far the nominal parameters may be off."""

    def drive(self) -> Term:
        """Return what turns commands into torques."""

    def build(
        self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int, mounted: bool = False
    ) -> tuple[PhysicsBackend, ActuatorSetup]:
        """Return a backend with ``num`` robots that steps by ``physics_dt`` s, and their drives.

        A base that is held has the attitude ``base_quat``, w-x-y-z, and if ``mounted`` the joints of
        ``sim/physics/scene.py``. Neither means anything to one that is free.
        """


def drive_law(actuator: str, **settings: Any) -> Term:
    """Return a registered actuator (``pd``, ``voltage``) with its settings."""
    term = bind("actuator", actuator, settings, actuator)[0]
    assert term is not None
    return term


MOUNT_LOAD = 2 * (*(10.0 for _ in MOUNT_SLIDES), *(2.0 for _ in MOUNT_HINGES))
"""Standard deviation of ``Rows.mount``, N and N m (chosen: a leg of 2 kg that swings at 5 m/s2)."""

Key = tuple[str, str]
"""Effect and parameter."""
Theta = dict[Key, np.ndarray]
"""Values by key: (J,) per joint, or (1,) of the robot."""


@dataclass(frozen=True)
class Rows:
    """R simulations to make."""

    window: np.ndarray  # (R,) which window each replays
    values: Mapping[Key, np.ndarray]  # of the effects, (R, J) or (R, 1)
    q: np.ndarray | None = None  # (R, J) added to the initial angles, rad; None for nothing
    qd: np.ndarray | None = None  # (R, J) added to the initial speeds, rad/s
    base: np.ndarray | None = None  # (R, 9) added to a free base's first height, roll and pitch, velocity and rate
    # (R, 10) how far from rest a trunk on a mount begins: by what these forces, N, and torques, N m, along the mount's
    # five directions deflect it, then at the speeds with which it would swing so far
    mount: np.ndarray | None = None

    def part(self, which: np.ndarray) -> Rows:
        """Return some of them."""
        moved = (None if v is None else v[which] for v in (self.q, self.qd, self.base, self.mount))
        return Rows(self.window[which], {k: v[which] for k, v in self.values.items()}, *moved)


def mounted(rows: Rows) -> np.ndarray:
    """Return which rows (R,) need a trunk that can move on a mount: those with an effect on it that is not null."""
    away = np.zeros(len(rows.window), dtype=bool)
    for (effect, name), values in rows.values.items():
        kind = effect_class(effect)
        if kind.mounts and name in {key for _, key in sizes(effect)}:
            away |= (values != declared((effect, name)).null).any(axis=1)
    return away


def on_fixed_base(rows: Rows) -> Rows:
    """Return rows without effects on a mount."""
    return replace(rows, values={key: v for key, v in rows.values.items() if not effect_class(key[0]).mounts})


def null(effect: str, tolerances: Tolerances) -> Theta:
    """Return the null values of an effect as a robot with these tolerances has them, as arrays (1,)."""
    keys = [(effect, p.name) for p in effect_class(effect).params]
    return {key: np.array([tolerances.param(key).null]) for key in keys}


@dataclass(frozen=True)
class Probe:
    """One changed simulation beside the unchanged one."""

    key: Key | str  # parameter that is changed, or None for an initial state
    place: int | None  # which joint of each group; None for a parameter of the robot
    delta: np.ndarray  # (J,) or (1,) by how much, per joint
    also: Theta = field(default_factory=dict)  # other parameters that are set meanwhile (shapes), by key


def variants(
    machine: Machine, theta: Theta, windows: np.ndarray, probes: Sequence[Probe], known: Iterable[Key] = ()
) -> Rows:
    """Return rows, window by window: the model as it is, then each probe."""
    joints, size = len(machine.joints), 1 + len(probes)
    count = len(windows) * size
    groups = np.array(machine.groups)
    full: dict[Key, np.ndarray] = {}
    keys = {*theta, *(p.key for p in probes if isinstance(p.key, tuple)), *(k for p in probes for k in p.also), *known}
    for effect in dict.fromkeys(sorted(name for name, _ in keys)):
        for key, value in null(effect, machine.tolerances).items():
            wide = joints if declared(key).per == "joint" else 1
            full[key] = np.tile(np.broadcast_to(theta.get(key, value), (wide,)), (count, 1))
    q, qd, base = np.zeros((count, joints)), np.zeros((count, joints)), np.zeros((count, len(machine.base_probe)))
    mount = np.zeros((count, len(MOUNT_LOAD)))
    for k, probe in enumerate(probes):
        changed = slice(1 + k, None, size)
        if probe.key == "base":
            base[changed] += probe.delta
            continue
        if probe.key == "mount":
            mount[changed] += probe.delta
            continue
        columns = slice(None) if probe.place is None else groups[:, probe.place]
        if isinstance(probe.key, str):
            (q if probe.key == "q" else qd)[changed, columns] += probe.delta[columns]
            continue
        for key, value in probe.also.items():
            full[key][changed] = value
        full[probe.key][changed, columns] += probe.delta[columns]
    return Rows(np.repeat(windows, size), full, q, qd, base, mount)
