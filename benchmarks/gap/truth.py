"""The hidden robot of a case: every number in which it may differ from the nominal one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from go1exp import robot

J = robot.NUM_JOINTS
CENTRE = {"along": (2, -1.0), "forward": (0, 1.0), "left": (1, 1.0)}
"""Ways in which a link's centre of mass is shifted: axis of the link's frame, and sign."""


def _zeros() -> np.ndarray:
    return np.zeros(J)


def _ones() -> np.ndarray:
    return np.ones(J)


@dataclass
class Truth:
    """One robot; arrays ``(J,)`` are in the order of ``robot.JOINTS``, and a link belongs to the joint that moves it.

    Attributes:
        mass: factor on each link's mass and inertia.
        inertia: factor on each link's inertia beyond that.
        stop: time constant of the stops, s.
        stop_shift: shift of the lower and the upper stop (J, 2), rad.
        com: shift of each link's centre of mass (J, 3), m, link frame.
        carried: point mass on each link, kg.
        carried_at: its place (J, 3), m, link frame.
        armature: reflected rotor inertia, kg m2.
        tilt: roll and pitch of the trunk beyond what the log says, rad.
        payload: mass on the trunk, kg (a trunk that is held does not feel it).
        forward: dry friction while the angle grows, N m.
        backward: dry friction while the angle falls, N m.
        stribeck: further friction near rest, N m.
        stribeck_speed: speed at which exp(-1) of it is left, rad/s.
        load: friction per torque of the motor.
        bristle: stiffness of LuGre's bristles, N m/rad.
        viscous: N m s/rad.
        drag: N m s2/rad2.
        stiffness: of a spring beside the drive, N m/rad.
        rest: its angle without torque, rad.
        cogging: N m.
        slots: its periods per turn.
        phase: rad.
        kp: factor on the position gain.
        kd: factor on the speed gain.
        band: error that the drive leaves alone, rad.
        offset: reading of the encoder at true zero, rad.
        command_delay: s.
        torque_delay: s.
        lag: time constant, s.
        strength: torque made over torque asked for.
        drift: strength lost per time, 1/s.
        peak: peak torque over the robot's own.
        droop: top speed over the speed at which the torque line ends.
        compliance: of the gears, rad/(N m).
        gap: of the gears, rad.
        gear_damping: damping ratio of the rotor on the gears' spring.
        outside: effects beyond the library (``outside.py``), by name with their parameters.
    """

    mass: np.ndarray = field(default_factory=_ones)
    inertia: np.ndarray = field(default_factory=_ones)
    stop: np.ndarray = field(default_factory=lambda: np.full(J, 0.02))
    stop_shift: np.ndarray = field(default_factory=lambda: np.zeros((J, 2)))
    com: np.ndarray = field(default_factory=lambda: np.zeros((J, 3)))
    carried: np.ndarray = field(default_factory=_zeros)
    carried_at: np.ndarray = field(default_factory=lambda: np.zeros((J, 3)))
    armature: np.ndarray = field(default_factory=lambda: robot.per_joint(robot.ROTOR_ARMATURE))
    tilt: np.ndarray = field(default_factory=lambda: np.zeros(2))
    payload: float = 0.0
    forward: np.ndarray = field(default_factory=_zeros)
    backward: np.ndarray = field(default_factory=_zeros)
    stribeck: np.ndarray = field(default_factory=_zeros)
    stribeck_speed: np.ndarray = field(default_factory=lambda: np.full(J, 0.2))
    load: np.ndarray = field(default_factory=_zeros)
    bristle: float = 1500.0
    viscous: np.ndarray = field(default_factory=_zeros)
    drag: np.ndarray = field(default_factory=_zeros)
    stiffness: np.ndarray = field(default_factory=_zeros)
    rest: np.ndarray = field(default_factory=_zeros)
    cogging: np.ndarray = field(default_factory=_zeros)
    slots: np.ndarray = field(default_factory=lambda: np.full(J, 38.0))
    phase: np.ndarray = field(default_factory=_zeros)
    kp: np.ndarray = field(default_factory=_ones)
    kd: np.ndarray = field(default_factory=_ones)
    band: np.ndarray = field(default_factory=_zeros)
    offset: np.ndarray = field(default_factory=_zeros)
    command_delay: np.ndarray = field(default_factory=_zeros)
    torque_delay: np.ndarray = field(default_factory=_zeros)
    lag: np.ndarray = field(default_factory=_zeros)
    strength: np.ndarray = field(default_factory=_ones)
    drift: np.ndarray = field(default_factory=_zeros)
    peak: np.ndarray = field(default_factory=_ones)
    droop: np.ndarray = field(default_factory=_zeros)
    compliance: np.ndarray = field(default_factory=_zeros)
    gap: np.ndarray = field(default_factory=_zeros)
    gear_damping: float = 0.05
    outside: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def yielding(self) -> np.ndarray:
        """Which joints have gears that yield (J,), bool."""
        return (self.compliance > 0) | (self.gap > 0)


def apply(truth: Truth, effect: str, values: Mapping[str, np.ndarray | float], joints: np.ndarray) -> None:
    """Add an effect to a robot, in place.

    Args:
        truth: the robot; what it has already stays.
        effect: a name of ``known.LIBRARY``.
        values: parameter -> value, or values of ``joints`` one by one.
        joints: indices of the joints (or of their links).

    Raises:
        KeyError: if there is no such effect.
    """
    added: dict[str, dict[str, tuple[str, ...]]] = {
        "coulomb": {"bound": ("forward", "backward")},
        "asymmetric_friction": {"forward": ("forward",), "backward": ("backward",)},
        "viscous": {"damping": ("viscous",)},
        "quadratic_drag": {"drag": ("drag",)},
        "stribeck": {"strength": ("stribeck",)},
        "load_friction": {"coefficient": ("load",)},
        "parallel_stiffness": {"stiffness": ("stiffness",)},
        "cogging": {"amplitude": ("cogging",)},
        "encoder_offset": {"offset": ("offset",)},
        "dead_band": {"band": ("band",)},
        "armature": {"added": ("armature",)},
        "command_delay": {"delay": ("command_delay",)},
        "torque_delay": {"delay": ("torque_delay",)},
        "lag": {"time": ("lag",)},
        "strength_drift": {"rate": ("drift",)},
        "flexibility": {"compliance": ("compliance",)},
        "backlash": {"gap": ("gap",)},
        "torque_speed_limit": {"droop": ("droop",)},
    }
    scaled: dict[str, str] = {
        "strength": "strength",
        "kp_scale": "kp",
        "kd_scale": "kd",
        "link_mass": "mass",
        "link_inertia": "inertia",
    }
    written = {"speed": "stribeck_speed", "rest": "rest", "count": "slots", "phase": "phase", "peak": "peak"}
    if effect == "base_tilt":
        truth.tilt += np.array([values["roll"], values["pitch"]])
    elif effect == "payload":
        truth.payload += float(values["mass"])
    elif effect == "link_com":
        for name, (axis, sign) in CENTRE.items():
            truth.com[joints, axis] += sign * values.get(name, 0.0)
    elif effect == "point_load":
        truth.carried[joints] = values["mass"]
        truth.carried_at[joints] = np.stack([values[axis] for axis in "xyz"], axis=-1)
    elif effect == "joint_stop":
        truth.stop[joints] = values.get("time_constant", truth.stop[joints])
        for end, name in enumerate(("lower", "upper")):
            truth.stop_shift[joints, end] += values.get(name, 0.0)
    elif effect in scaled:
        getattr(truth, scaled[effect])[joints] *= values["scale"]
    else:
        for name, value in values.items():
            if name in written:
                getattr(truth, written[name])[joints] = value
                continue
            for attribute in added[effect][name]:
                getattr(truth, attribute)[joints] += value


def differences(truth: Truth, effect: str, joints: np.ndarray) -> dict[str, np.ndarray | float]:
    """Return what an effect's parameters are in all, where the background adds to them; an estimate sees only the sum.

    Args:
        truth: the robot, with all its effects and its background.
        effect: a name of ``known.LIBRARY``.
        joints: indices of the joints at which the effect was added.
    """
    if effect == "base_tilt":
        return {"roll": float(truth.tilt[0]), "pitch": float(truth.tilt[1])}
    by_parameter = {
        "coulomb": {"bound": np.minimum(truth.forward, truth.backward)},
        "asymmetric_friction": {"forward": truth.forward, "backward": truth.backward},
        "viscous": {"damping": truth.viscous},
        "armature": {"added": truth.armature - robot.per_joint(robot.ROTOR_ARMATURE)},
        "encoder_offset": {"offset": truth.offset},
        "strength": {"scale": truth.strength},
        "link_mass": {"scale": truth.mass},
        "link_com": {name: sign * truth.com[:, axis] for name, (axis, sign) in CENTRE.items()},
    }.get(effect, {})
    return {name: values[joints] for name, values in by_parameter.items()}
