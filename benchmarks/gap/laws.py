"""How friction, drives and gears of the hidden robot work, in NumPy; arrays are ``(N, J)`` unless said.

The library that the solver uses has laws of its own. These are others where physics allows it: dry friction is LuGre's
bristles and no constraint, gears are two masses integrated on their own.
"""

from __future__ import annotations

import numpy as np

MICRO_DAMPING = 0.6
"""Damping ratio of a joint of 0.02 kg m2 that rocks on its bristles (chosen; LuGre's sigma 1)."""


class LuGre:
    """Dry friction as the bending of bristles (Canudas de Wit et al., 1995): dz/dt = v - stiffness |v| z / g.

    Torque is stiffness z + damping dz/dt; at a steady speed just g, the friction level. The equation is solved exactly
    for constant v over a step, so that no step is too long however stiff the bristles.

    Attributes:
        z: bending of the bristles, rad.
    """

    def __init__(self, shape: tuple[int, ...], stiffness: float) -> None:
        """Begin unbent; ``stiffness`` in N m/rad."""
        self.z = np.zeros(shape)
        self._stiffness = stiffness
        self._damping = 2.0 * MICRO_DAMPING * np.sqrt(stiffness * 0.02)

    def step(self, v: np.ndarray, level: np.ndarray, dt: float) -> np.ndarray:
        """Return the torque that opposes the motion.

        Args:
            v: speed, rad/s.
            level: friction at this speed and direction, N m; none where it is zero.
            dt: s.
        """
        decay = np.abs(v) * self._stiffness / np.maximum(level, 1e-9)
        share = -np.expm1(-decay * dt)
        steady = np.sign(v) * level / self._stiffness
        end = np.where(decay * dt > 1e-6, self.z + (steady - self.z) * share, self.z + v * dt)
        rate = (end - self.z) / dt
        self.z = end
        return np.where(level > 0, self._stiffness * end + self._damping * rate, 0.0)


class Late:
    """A signal as it was a while ago, between two steps by linear interpolation.

    The mean over a step is then that of a staircase which was shifted by exactly the delay.
    """

    def __init__(self, delay: np.ndarray, dt: float, n: int) -> None:
        """Keep the past of ``n`` robots; ``delay`` (J,) in s."""
        steps = delay / dt
        whole = np.floor(steps + 1e-9).astype(int)
        self._part = np.clip(steps - whole, 0.0, 1.0)
        self._whole = whole
        self._joint = np.arange(len(delay))
        self._past = np.zeros((int(whole.max()) + 2, n, len(delay)))
        self._now = -1

    def step(self, x: np.ndarray) -> np.ndarray:
        """Take the newest value and return that of ``delay`` ago; the first stands for all before it."""
        if self._now < 0:
            self._past[:] = x
        self._now = (self._now + 1) % len(self._past)
        self._past[self._now] = x
        first = self._past[(self._now - self._whole) % len(self._past), :, self._joint].T
        second = self._past[(self._now - self._whole - 1) % len(self._past), :, self._joint].T
        return first + self._part * (second - first)


class Lag:
    """First-order lag; solved exactly for a demand that is constant over a step."""

    def __init__(self, time: np.ndarray, dt: float) -> None:
        """``time`` (J,): time constants, s."""
        steps = dt / np.maximum(time, 1e-9)
        self._share = np.where(time > 0, -np.expm1(-steps), 1.0)
        self._mean = np.where(time > 0, self._share / steps, 0.0)  # of what is missing, over the step
        self._made: np.ndarray | None = None

    def step(self, demand: np.ndarray) -> np.ndarray:
        """Return the mean of the torque made in this step."""
        if self._made is None:
            self._made = demand.copy()
        missing = self._made - demand
        self._made = self._made - self._share * missing
        return demand + self._mean * missing


class Gears:
    """Rotors behind a spring with play; the joint's side is the engine's, the rotor's side is integrated here."""

    def __init__(
        self, rotor: np.ndarray, compliance: np.ndarray, gap: np.ndarray, damping: float, yielding: np.ndarray
    ) -> None:
        """All (J,): inertia kg m2, rad/(N m), rad; ``damping`` is a ratio; ``yielding`` bool."""
        self._rotor, self._half, self._yielding = rotor, 0.5 * gap, yielding
        self._stiffness = 1.0 / np.where(compliance > 0, compliance, FLANK)
        self._damping = 2.0 * damping * np.sqrt(self._stiffness * rotor)
        self.angle: np.ndarray | None = None
        self.speed: np.ndarray | None = None

    def step(self, torque: np.ndarray, q: np.ndarray, v: np.ndarray, dt: float) -> np.ndarray:
        """Turn the rotors under the motors' ``torque`` and return the torque that reaches the joints at q, v."""
        angle, speed = self.at(q, v)
        twist = angle - q
        stretch = twist - np.clip(twist, -self._half, self._half)
        pushed = self._stiffness * stretch + self._damping * (speed - v)
        flank = np.where(stretch > 0, np.maximum(pushed, 0.0), np.where(stretch < 0, np.minimum(pushed, 0.0), 0.0))
        through = np.where(self._half > 0, flank, pushed)  # teeth do not pull
        self.speed = speed + dt * (torque - through) / self._rotor
        self.angle = angle + dt * self.speed
        return np.where(self._yielding, through, torque)

    def at(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what encoders on the rotors read, given the joints' q and v."""
        if self.angle is None or self.speed is None:
            self.angle, self.speed = q.copy(), v.copy()
        return np.where(self._yielding, self.angle, q), np.where(self._yielding, self.speed, v)


FLANK = 1e-4
"""Compliance of teeth that only have play, rad/(N m); a fifth of flexibility's tolerance."""


def limit(torque: np.ndarray, v: np.ndarray, effort: np.ndarray, top: np.ndarray, droop: np.ndarray) -> np.ndarray:
    """Clip at the peak ``effort`` and at a line that falls from it at rest to zero at speed ``top / droop``."""
    falling = droop * v / top
    return np.clip(torque, effort * np.maximum(-1.0, -(1.0 + falling)), effort * np.minimum(1.0, 1.0 - falling))
