"""Whether an engine moves the robot that the compiled model describes: what must hold before its numbers count.

The two engines do the same in the air, where there is no contact to differ in, and only what the protocol
``PhysicsBackend`` has is asked of them. A step from rest under one force gives one column of the inverse mass matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.config.schema.registry import Expected
from go1exp.sim.physics.backend import PhysicsBackend

POSES = 20
FALL_S = 0.05
"""Time of the fall, s."""

HIGH = 2.0
"""Height of the trunk, m: nothing touches."""

GAINS = 20.0, 0.5
"""Stiffness N m/rad and damping N m s/rad of the actuators in the fall."""

TOLERANCES: dict[str, tuple[float, str]] = {
    "names and order": (0.0, "names"),
    "link masses": (1e-5, "of each"),
    "joint limits": (1e-5, "rad"),
    "physics step": (1e-6, "of it"),
    "mass matrix": (1e-3, "of sqrt(M_ii M_jj)"),
    "gravity torque": (0.02, "N m"),
    "fall: trunk": (0.1, "m per s of step"),
    "fall: attitude": (0.5, "rad per s of step"),
    "fall: joints": (0.1, "rad per s of step"),
}
"""Largest difference allowed, and its unit.

Masses, limits and steps are single precision at worst. The mass matrix comes from a step of finite length, in which
the robot turns by 1 mrad. A gravity torque of 0.02 N m is a thousandth of a motor's. The fall is the work of two
integrators of first order, which differ in proportion to the step: at 2 ms by up to 0.2 mm, 1 mrad and 0.2 mrad.
PhysX comes within half of the attitude's, since it turns the trunk about the world's axes and MuJoCo about the
trunk's, and within a tenth to a fifth of the others.
"""


@dataclass(frozen=True)
class Built:
    """What an engine was built with, as it says itself.

    Attributes:
        joints: names in the order of the joints' coordinates.
        masses: of the links, by name, kg.
        limits: of the joints (J, 2), rad.
        physics_dt: step, s.
    """

    joints: tuple[str, ...]
    masses: dict[str, float]
    limits: np.ndarray
    physics_dt: float


@dataclass(frozen=True)
class Check:
    """One quantity: its largest difference from the reference."""

    name: str
    worst: float
    tolerance: float
    unit: str

    @property
    def holds(self) -> bool:
        """Whether it is within the tolerance; not a number is not."""
        return bool(self.worst <= self.tolerance)

    def __str__(self) -> str:
        return f"{self.name}: differs by {self.worst:.2g}, allowed are {self.tolerance:g} {self.unit}"


def require(reference: PhysicsBackend, engine: PhysicsBackend, name: str) -> list[Check]:
    """Return the checks of an engine that agrees with the reference.

    Raises:
        Expected: if it does not, with everything that differs in one line.
    """
    checks = compare(reference, engine)
    if failed := [str(check) for check in checks if not check.holds]:
        raise Expected(
            f"engine = {name}: is not the robot of the model, so nothing is evaluated on it: {'; '.join(failed)}"
        )
    return checks


def robots_needed(degrees: int = 6 + robot.NUM_JOINTS) -> int:
    """Return the number of robots that ``compare`` needs: one for each degree of freedom, and one at rest."""
    return degrees + 1


def compare(reference: PhysicsBackend, engine: PhysicsBackend) -> list[Check]:
    """Compare two engines of one compiled model with free trunks, ``robots_needed()`` robots each."""
    made, model = built(engine), built(reference)
    wrong = _unlike(made.joints, model.joints) + _unlike(sorted(made.masses), sorted(model.masses))
    worst = {"names and order": float(wrong)}
    if not wrong:
        masses = [abs(made.masses[name] / mass - 1.0) for name, mass in model.masses.items() if mass > 0.0]
        worst |= {
            "link masses": max(masses),
            "joint limits": _largest(made.limits - model.limits),
            "physics step": abs(made.physics_dt / model.physics_dt - 1.0),
            **_masses_and_gravity(reference, engine),
            **_fall(reference, engine),
        }
    return [Check(name, value, *TOLERANCES[name]) for name, value in worst.items()]


def built(engine: PhysicsBackend) -> Built:
    """Return what an engine was built with; MuJoCo's step the compiled model itself."""
    if hasattr(engine, "built"):
        return engine.built()
    model = engine.model
    hinges = [model.joint(name) for name in robot.JOINTS]
    return Built(
        joints=tuple(model.joint(j).name for j in range(model.njnt - len(hinges), model.njnt)),
        masses={model.body(b).name: float(model.body_mass[b]) for b in range(1, model.nbody)},
        limits=np.stack([joint.range for joint in hinges]),
        physics_dt=float(model.opt.timestep),
    )


def _unlike(names: Sequence[str], others: Sequence[str]) -> int:
    return sum(a != b for a, b in zip_longest(names, others))


def _largest(difference: ArrayLike) -> float:
    """Return the largest absolute value; what is not a number stays so."""
    return float(np.abs(np.asarray(difference)).max())


def _poses(count: int, spread: float, seed: int) -> np.ndarray:
    """Return states (count, 19) high in the air; for ``spread`` = 1 of any attitude and joints all over their range."""
    rng, (low, high) = np.random.default_rng(seed), robot.JOINT_POS_LIMITS.T
    qpos = np.zeros((count, 7 + robot.NUM_JOINTS))
    qpos[:, 2] = HIGH
    qpos[:, 3:7] = Rotation.from_rotvec(spread * rng.uniform(-1.8, 1.8, (count, 3))).as_quat(scalar_first=True)
    anywhere = rng.uniform(0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high, (count, robot.NUM_JOINTS))
    qpos[:, 7:] = robot.NOMINAL_STANCE + spread * (anywhere - robot.NOMINAL_STANCE)
    return qpos


def _put(engine: PhysicsBackend, qpos: np.ndarray, qvel: np.ndarray) -> None:
    like = engine.qpos
    engine.applied().zero_()
    mask = torch.ones(engine.num_envs, dtype=torch.bool, device=like.device)
    engine.reset(mask, *(torch.as_tensor(a, dtype=like.dtype, device=like.device) for a in (qpos, qvel)))


def _host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy().copy()


def _response(engine: PhysicsBackend, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mass matrix (V, V) at a pose, and the generalised force of gravity (V,), from one step."""
    degrees = engine.num_envs - 1
    size = np.array([50.0] * 3 + [1.0] * 3 + [0.5] * (degrees - 6))  # N and N m: each makes a speed far above rounding
    _put(engine, np.tile(pose, (degrees + 1, 1)), np.zeros((degrees + 1, degrees)))
    force = torch.as_tensor(np.vstack([np.zeros(degrees), np.diag(size)]), dtype=engine.qpos.dtype)
    force = force.to(engine.qpos.device)
    engine.applied()[:, :6] = force[:, :6]
    engine.step(force[:, 6:])
    acceleration = _host(engine.qvel) / engine.model.opt.timestep
    inverse = (acceleration[1:] - acceleration[0]).T / size
    mass = np.linalg.inv(inverse)
    return mass, mass @ acceleration[0]


def _masses_and_gravity(reference: PhysicsBackend, engine: PhysicsBackend) -> dict[str, float]:
    """Compare mass matrix and gravity at random poses."""
    mass, gravity = [], []
    for pose in _poses(POSES, 1.0, seed=0):
        (tested, weight), (known, known_weight) = _response(engine, pose), _response(reference, pose)
        scale = np.sqrt(np.diag(known))
        mass.append(_largest((tested - known) / np.outer(scale, scale)))
        gravity.append(_largest((weight - known_weight)[3:]))
    return {"mass matrix": float(np.max(mass)), "gravity torque": float(np.max(gravity))}


def _fall(reference: PhysicsBackend, engine: PhysicsBackend) -> dict[str, float]:
    """Compare robots that fall with a zero action: actuators hold the stance."""
    count, degrees = engine.num_envs, engine.num_envs - 1
    qpos = _poses(count, 0.2, seed=1)
    qvel = np.random.default_rng(2).normal(0.0, 0.3, (count, degrees))
    ends = []
    for each in (engine, reference):
        _put(each, qpos, qvel)
        stance = torch.as_tensor(robot.NOMINAL_STANCE, dtype=each.qpos.dtype, device=each.qpos.device)
        for _ in range(round(FALL_S / each.model.opt.timestep)):
            each.step(GAINS[0] * (stance - each.qpos[:, 7:]) - GAINS[1] * each.qvel[:, 6:])
        ends.append(_host(each.qpos))
    tested, known = ends
    attitude = [Rotation.from_quat(end[:, 3:7], scalar_first=True) for end in ends]
    step = float(reference.model.opt.timestep)
    return {
        "fall: trunk": _largest(tested[:, :3] - known[:, :3]) / step,
        "fall: attitude": _largest((attitude[0] * attitude[1].inv()).magnitude()) / step,
        "fall: joints": _largest(tested[:, 7:] - known[:, 7:]) / step,
    }
