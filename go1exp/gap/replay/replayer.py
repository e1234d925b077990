"""The model run through windows of recordings, many variants side by side, on the plant that training uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

import go1exp.sim.effects  # noqa: F401  (registers every effect)
from go1exp.config.schema.registry import bind
from go1exp.gap.data.windows import PAST_S, Windows, averaged, held
from go1exp.gap.replay.rows import Machine, Rows, mounted, on_fixed_base
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Measured
from go1exp.sim.env.plant import FRICTION, Plant
from go1exp.sim.physics.backend import PhysicsBackend

LEVEL = (1.0, 0.0, 0.0, 0.0)  # attitude of a trunk that is held level, w-x-y-z


@dataclass
class Replayer:
    """Runs the model through windows, ``max_rows`` at once; a held base has attitudes ``quats`` (W, 4), w-x-y-z."""

    machine: Machine
    windows: Windows
    quats: np.ndarray
    max_rows: int
    threads: int
    made: int = 0
    _backends: dict[tuple[int, float, bool], tuple[PhysicsBackend, ActuatorSetup, set[str]]] = field(
        default_factory=dict
    )
    _inputs: dict[float, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def run(self, rows: Rows, dt: float) -> np.ndarray:
        """Return what sensors would measure (R, n, C, J) at the windows' sample times."""
        w = self.windows
        y = np.empty((len(rows.window), w.t.shape[1], len(w.quantities), len(w.joints)))
        soft = mounted(rows)
        for softly in np.unique(soft):
            members = np.flatnonzero(soft == softly)
            part = rows if softly else on_fixed_base(rows)
            pieces = int(np.ceil(len(members) / self.max_rows))
            for piece in np.array_split(members, pieces):
                size = min(padded(len(piece)), self.max_rows)
                full = np.concatenate([piece, np.repeat(piece[-1:], size - len(piece))])
                y[piece] = self._batch(part.part(full), dt, bool(softly))[: len(piece)]
        return y

    def _plant(self, rows: Rows, dt: float, softly: bool) -> Plant:
        """Return a plant whose effects are exactly those of ``rows``, on a backend that may be an old one."""
        key = len(rows.window), dt, softly
        if key not in self._backends:
            self._backends[key] = (*self.machine.build(len(rows.window), dt, LEVEL, self.threads, softly), set())
        backend, setup, touched = self._backends[key]
        for name in touched:
            backend.field(name).copy_(backend.compiled(name))
        if touched:
            backend.derive_constants(torch.ones(len(rows.window), dtype=torch.bool))
        if not setup.floating:
            hold(backend, self.quats[rows.window])
        names = list(dict.fromkeys(effect for effect, _ in rows.values))
        terms = [bind("effect", name, {}, name)[0] for name in names]
        plant = Plant(backend, setup, self.machine.drive(), [term for term in terms if term is not None])
        touched |= set(plant.effects.fields) | {FRICTION, "dof_armature"}
        for (effect, parameter), value in rows.values.items():
            live = getattr(plant.effects.effects[effect], parameter)
            live.copy_(torch.as_tensor(value))
        kp, kd = (torch.as_tensor(v[rows.window]) for v in (self.windows.kp, self.windows.kd))
        plant.set_gains(kp, kd)
        plant.refresh()
        return plant

    def _begin(self, plant: Plant, rows: Rows, past: Tensor, dt: float) -> None:
        """Put the robots into their windows' initial states, as the encoders see them."""
        w = self.windows
        q, qd = torch.as_tensor(w.q[rows.window]), torch.as_tensor(w.qd[rows.window])
        if rows.q is not None and rows.qd is not None:
            q, qd = q + torch.as_tensor(rows.q), qd + torch.as_tensor(rows.qd)
        everyone = torch.ones(len(q), dtype=torch.bool)
        effects, backend = plant.effects, plant.backend
        plant.enabled = None
        backend.reset(everyone, *self._state(plant, rows, q, qd))
        plant.reset(everyone, past[0])
        encoder, _ = effects.on_encoder(q, qd)
        true = q - (encoder - q)
        if effects.rotors:  # the twist under the torque that the drive makes at this pose
            torque = plant.actuator.torque(past[-1], q, qd)
            gears = effects.gears()
            twist = gears.compliance * torque + 0.5 * gears.gap * torque.sign()
            true = true - twist
        half = 0.5 * dt * torch.as_tensor(w.qdd[rows.window])  # the engine's speeds are half a step old
        backend.reset(everyone, *self._state(plant, rows, true, qd - 3.0 * half))
        plant.reset(everyone, past[-1])
        plant.qd.copy_(qd - half)
        if effects.rotors:
            effects.rotors.twist.copy_(twist)
        for target in past:  # what a delayed command remembers
            effects.through("on_target", target)
        for effect in effects.effects.values():
            effect.elapse(torch.as_tensor(w.elapsed[rows.window]))

    def _state(self, plant: Plant, rows: Rows, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coordinates and speeds of robots whose joints are at ``q`` (R, J) and ``qd``."""
        backend = plant.backend
        mount = backend.qpos.shape[1] - q.shape[1]
        if not mount:
            return q, qd
        # The trunk rests where the mount bears the legs as they are.
        still = torch.zeros(len(q), mount, dtype=q.dtype)
        everyone, bias = torch.ones(len(q), dtype=torch.bool), backend.bias()
        backend.reset(everyone, torch.cat([still, q], dim=1), torch.cat([still, torch.zeros_like(qd)], dim=1))
        stiffness = backend.field("jnt_stiffness")[:, :mount]
        inertia = backend.field("dof_M0")[:, :mount]
        load = torch.zeros(len(q), 2 * mount, dtype=q.dtype) if rows.mount is None else torch.as_tensor(rows.mount)
        place = backend.field("qpos_spring")[:, :mount] + (load[:, :mount] - bias[:, :mount]) / stiffness
        speed = load[:, mount:] / torch.sqrt(stiffness * inertia)
        place, speed = (v.where(stiffness > 0.0, still) for v in (place, speed))
        return torch.cat([place, q], dim=1), torch.cat([speed, qd], dim=1)

    def observing(self, windows: Windows) -> Replayer:
        """Return a replayer of the same windows with other quantities (``Windows.observable``): with torques."""
        return Replayer(self.machine, windows, self.quats, self.max_rows, self.threads)

    def _recorder(self, steps: int, rows: int) -> Any:
        """Return what records more than the joints, or None."""
        return None

    def _carrier(self, plant: Plant, rows: Rows, dt: float, steps: int) -> Callable[[int], None] | None:
        """Return what is called before each step to move a base that is neither held nor free, or None."""
        return None

    def _signals(self, dt: float) -> tuple[Tensor, Tensor]:
        """Return targets (K, W, J) and whether drives are on (K, W) at every step, the past included."""
        if dt not in self._inputs:
            w = self.windows
            steps = np.arange(-round(PAST_S / dt), int(np.ceil(w.length / dt)) + 1) * dt
            targets = np.stack([averaged(changes, steps) for changes in w.edges], axis=1)
            enabled = np.stack([held(changes, steps) for changes in w.switches], axis=1)
            self._inputs[dt] = torch.as_tensor(targets), torch.as_tensor(enabled)
        return self._inputs[dt]

    def _batch(self, rows: Rows, dt: float, softly: bool) -> np.ndarray:
        w = self.windows
        plant = self._plant(rows, dt, softly)
        index = torch.as_tensor(rows.window)
        targets, enabled = self._signals(dt)
        past = round(PAST_S / dt)
        self._begin(plant, rows, targets[:past, index], dt)
        targets, enabled = targets[past:], enabled[past:]
        always = bool(enabled.all())
        steps = len(targets)
        first = max(int(np.floor(w.t[:, 0].min() / dt)) - 1, 0)
        kept = steps - first
        shape = (kept, len(index), len(w.joints))
        q, qd, torque = np.empty(shape), np.empty(shape), np.empty(shape) if "tau_est" in w.quantities else None
        senses = plant.effects.senses
        recorder = self._recorder(kept, len(index))
        carry = self._carrier(plant, rows, dt, steps)
        for k in range(steps):
            if k >= first:
                sensed = Measured(plant.q, plant.speed())
                if senses:
                    sensed = plant.effects.measure(sensed)
                q[k - first], qd[k - first] = sensed.joint_pos.numpy(), sensed.joint_vel.numpy()
                if recorder is not None:
                    recorder.record(k - first, plant)
            if not always:
                plant.enabled = enabled[k, index]
            if carry is not None:
                carry(k)
            plant.step(targets[k, index])
            if torque is not None and k >= first:
                torque[k - first] = plant.reported_torque().numpy()
        self.made += len(index) * steps
        at = w.t[rows.window] / dt - first
        y = _sampled(q, qd, torque, at, dt)
        return y if recorder is None else recorder.joined(y, at, plant, dt)


def hold(backend: PhysicsBackend, quats: np.ndarray) -> None:
    """Hold the trunks of robots that are not free at attitudes of their own (R, 4), w-x-y-z, base to world."""
    attitude = backend.compiled("body_quat").repeat(len(quats), 1, 1)
    (trunk,) = backend.ids("body", ("trunk",))
    attitude[:, trunk] = torch.as_tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    backend.rebase({"body_quat": attitude})


def padded(rows: int) -> int:
    """Return how many simulations to make for ``rows``: at most a quarter, or 7, more, so that few sizes are built."""
    step = min(max(8, 1 << max(rows.bit_length() - 3, 0)), 64)  # whole vectors of eight: same bits wherever a row is
    return -(-rows // step) * step


def _sampled(q: np.ndarray, qd: np.ndarray, torque: np.ndarray | None, at: np.ndarray, dt: float) -> np.ndarray:
    """Interpolate (K, R, J) to the times ``at`` (R, n), in steps: angles by cubics, the rest by lines."""
    signals = [q, qd] if torque is None else [q, qd, torque]
    y = np.empty((*at.shape, len(signals), q.shape[2]))
    for rows in np.array_split(np.arange(len(at)), -(-len(at) // 16)):  # few enough to stay in the cache
        low = np.clip(np.floor(at[rows] + 1e-6).astype(int), 0, len(q) - 2)
        share = np.maximum(at[rows] - low, 0.0)[..., None]
        first, second = ([signal[low + k, rows[:, None]] for signal in signals] for k in (0, 1))
        for c, (before, after) in enumerate(zip(first, second, strict=True)):
            y[rows, :, c] = before + share * (after - before)
        (a, va), (b, vb) = first[:2], second[:2]
        s2, s3 = share**2, share**3
        y[rows, :, 0] = a + share * dt * va + s2 * (3 * (b - a) - dt * (2 * va + vb))
        y[rows, :, 0] += s3 * (2 * (a - b) + dt * (va + vb))
    return y
