"""Effects that the solver's library does not have, near misses among them. One class each; sizes are in ``SIZES``.

A class overrides what it changes. Arrays are (N, J); ``t`` is the time in the episode, s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.gap.laws import Late
from go1exp import robot


@dataclass
class Scene:
    """What an outside effect may know: number of robots, step (s), joints it acts on (J,), and random numbers."""

    n: int
    dt: float
    on: np.ndarray
    rng: np.random.Generator


class Outside:
    """Base: changes nothing."""

    def __init__(self, scene: Scene, **values: float) -> None:
        """Keep the scene and the parameters."""
        self.scene, self.values = scene, values

    def reset(self) -> None:
        """Begin the episode."""

    def position(self, t: float, target: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the position error that the drive acts on."""
        return target - q

    def motor(self, t: float, torque: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the torque that the motor makes."""
        return torque

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return a further torque on the joint."""
        return 0.0

    def calves(self, t: float) -> np.ndarray | None:
        """Return forces (N, 4, 3) on the calves' centres of mass, world frame, N; None for none."""
        return None


class DelayedError(Outside):
    """The drive's position error is late, its damping is not (what the published Go1 actuator net does)."""

    def __init__(self, scene: Scene, **values: float) -> None:
        """Allocate the past of the error."""
        super().__init__(scene, **values)
        self._late = Late(scene.on * values["delay"], scene.dt, scene.n)

    def position(self, t: float, target: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the error of a while ago."""
        return self._late.step(target - q)


class Temperature(Outside):
    """Copper loss heats the winding, and a warm motor is weaker: strength = 1 - loss heat, heat' = tau^2 - heat / T."""

    def reset(self) -> None:
        """Begin cold."""
        self._heat = np.zeros((self.scene.n, robot.NUM_JOINTS))

    def motor(self, t: float, torque: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the weakened torque."""
        self._heat += self.scene.dt * (torque**2 - self._heat / self.values["time"])
        return torque * np.maximum(1.0 - self.scene.on * self.values["loss"] * self._heat, 0.3)


class Ripple(Outside):
    """A torque that is periodic in time, as from a supply or a control loop that oscillates."""

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the ripple."""
        return (
            self.scene.on * self.values["amplitude"] * np.sin(2 * np.pi * self.values["hz"] * t + 0.7 * np.arange(12))
        )


class Wind(Outside):
    """Gusts on the legs: a mean force and slow random changes, different in every episode."""

    def reset(self) -> None:
        """Begin with the mean."""
        n = self.scene.n
        self._gust = self.scene.rng.standard_normal((n, 4, 3)) * self.values["gust"]
        self._mean = self.scene.rng.standard_normal((n, 1, 3)) * self.values["mean"]

    def calves(self, t: float) -> np.ndarray | None:
        """Return the force now."""
        keep = np.exp(-self.scene.dt / self.values["time"])
        noise = self.scene.rng.standard_normal(self._gust.shape)
        self._gust = keep * self._gust + self.values["gust"] * np.sqrt(1 - keep**2) * noise
        blown = self.scene.on.reshape(4, 3).max(axis=1)
        return (self._mean + self._gust) * blown[None, :, None]


class CreepingSpring(Outside):
    """A cable that creeps: a spring in series with a damper, beside the drive."""

    def reset(self) -> None:
        """Begin relaxed."""
        self._rest: np.ndarray | None = None

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the spring's torque, and let it creep."""
        if self._rest is None:
            self._rest = q.copy()
        self._rest += (q - self._rest) * self.scene.dt / self.values["time"]
        return -self.scene.on * self.values["stiffness"] * (q - self._rest)


class CubicSpring(Outside):
    """A cover that resists large angles: torque grows with the cube of the excursion (near parallel stiffness)."""

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the spring's torque."""
        return -self.scene.on * self.values["stiffness"] * (q - robot.NOMINAL_STANCE) ** 3


class CoupledJoints(Outside):
    """The knee's rod passes the thigh: a share of the calf's torque also acts on the thigh."""

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the torque on the thighs."""
        coupled = np.zeros_like(torque)
        coupled[:, 1::3] = self.values["share"] * torque[:, 2::3]
        return coupled * self.scene.on


class PatchyFriction(Outside):
    """Friction that depends on the angle: a bad spot in the gears (smooth, so that it needs no bristles)."""

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the friction."""
        spot = np.exp(-0.5 * ((q - robot.NOMINAL_STANCE) / self.values["width"]) ** 2)
        return -self.scene.on * self.values["amplitude"] * spot * np.tanh(v / 0.05)


class SoftSaturation(Outside):
    """Torque that bends towards its peak long before it (near a torque limit and a weaker motor)."""

    def motor(self, t: float, torque: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the bent torque."""
        knee = self.values["knee"] * robot.per_joint(robot.EFFORT_LIMIT)
        return np.where(self.scene.on > 0, knee * np.tanh(torque / knee), torque)


class DeadZone(Outside):
    """The drive ignores small position errors."""

    def position(self, t: float, target: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the error beyond the dead zone."""
        error, width = target - q, self.scene.on * self.values["width"]
        return error - np.clip(error, -width, width)


class LostCommands(Outside):
    """The bus drops out now and then: the drive goes on with its last target for a while."""

    def reset(self) -> None:
        """Begin connected."""
        self._until = np.zeros((self.scene.n, 1))
        self._held: np.ndarray | None = None

    def position(self, t: float, target: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the error to the target that got through."""
        gone = self.scene.rng.random(self._until.shape) < self.values["rate"] * self.scene.dt
        self._until = np.where(gone, t + self.values["time"], self._until)
        last = target if self._held is None else self._held
        self._held = np.where((t < self._until) & (self.scene.on > 0), last, target)
        return self._held - q


class FadingFriction(Outside):
    """Grease warms up: a viscous friction that fades in the course of an episode (near a drift of strength)."""

    def joint(self, t: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray | float:
        """Return the friction."""
        return -self.scene.on * self.values["damping"] * np.exp(-max(t, 0.0) / self.values["time"]) * v


EFFECTS: dict[str, type[Outside]] = {
    "delayed_error": DelayedError,
    "temperature": Temperature,
    "ripple": Ripple,
    "wind": Wind,
    "creeping_spring": CreepingSpring,
    "cubic_spring": CubicSpring,
    "coupled_joints": CoupledJoints,
    "patchy_friction": PatchyFriction,
    "soft_saturation": SoftSaturation,
    "dead_zone": DeadZone,
    "lost_commands": LostCommands,
    "fading_friction": FadingFriction,
}

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "delayed_error": {"delay": (0.006, 0.02)},
    "temperature": {"loss": (0.004, 0.012), "time": (3.0, 8.0)},
    "ripple": {"amplitude": (0.2, 0.8), "hz": (3.0, 20.0)},
    "wind": {"gust": (0.5, 2.0), "mean": (0.5, 2.0), "time": (0.2, 0.6)},
    "creeping_spring": {"stiffness": (1.0, 4.0), "time": (0.3, 1.0)},
    "cubic_spring": {"stiffness": (6.0, 20.0)},
    "coupled_joints": {"share": (0.1, 0.3)},
    "patchy_friction": {"amplitude": (0.3, 0.8), "width": (0.08, 0.15)},
    "soft_saturation": {"knee": (0.25, 0.45)},
    "dead_zone": {"width": (0.008, 0.025)},
    "lost_commands": {"rate": (1.5, 4.0), "time": (0.03, 0.08)},
    "fading_friction": {"damping": (0.15, 0.4), "time": (1.0, 3.0)},
}
"""Range of each parameter, SI units; chosen so that the angles change by many times the noise (``generate.signal``)."""
