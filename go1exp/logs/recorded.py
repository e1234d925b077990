"""A trace from a recording of a real robot, or of any other."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.logs.recording import FOOT_FORCE, VECTORS, Recording, RecordingError
from go1exp.mdp.measures.trace import Array, Trace, find_runs


def trace_of(
    recording: Recording,
    *,
    contact_on: float = 20.0,
    contact_off: float = 10.0,
    command: tuple[float, float, float] | None = None,
    mass: float | None = None,
) -> Trace:
    """Return one robot's trace; every row of the recording is a step.

    Args:
        recording: of a Go1 with foot forces.
        contact_on: a foot is on the ground from this force on, N.
        contact_off: and until its force falls below this, N.
        command: the commanded velocity, if known.
        mass: of the robot, kg, if known.

    Raises:
        RecordingError: if it is of another robot or has no forces on the feet.
        ValueError: if contact_off exceeds contact_on.
    """
    if contact_off > contact_on:
        raise ValueError(f"contact_off = {contact_off:g}: must not exceed contact_on = {contact_on:g}")
    joints = recording.meta.joints
    if set(joints) != set(robot.JOINTS):
        raise RecordingError(f"{recording.meta.episode}: measures are of a Go1, with the joints {robot.JOINTS[0]} ...")
    force = recording.block(*(FOOT_FORCE + leg for leg in robot.LEGS))
    order = [joints.index(name) for name in robot.JOINTS]
    rows = len(recording.t)

    def joint(quantity: str) -> Array | None:
        return recording.joint(quantity)[:, None, order] if recording.has(quantity) else None

    def vector(name: str) -> Array | None:
        return recording.block(*VECTORS[name]) if set(VECTORS[name]) <= set(recording.channels) else None

    quat, velocity = vector("base_quat"), vector("base_lin_vel")
    attitude = quat if quat is not None else vector("imu_quat")
    gravity = None if attitude is None else _into_body(attitude, np.array([0.0, 0.0, -1.0]))[:, None]
    in_body = None if velocity is None or quat is None else _into_body(quat, velocity)[:, None]
    commanded = None if command is None else np.broadcast_to(np.array(command), (rows, 1, 3))
    return Trace(
        contact=hysteresis(force, contact_on, contact_off)[:, None],
        contact_dt=float(np.median(np.diff(recording.t))) if rows > 1 else 1.0 / recording.meta.rate_hz,
        counts=recording.channels.get("torque_enable", np.ones(rows, bool))[:, None],
        mass=None if mass is None else np.array([mass]),
        command=commanded,
        base_lin_vel_b=in_body,
        projected_gravity_b=gravity,
        joint_vel=joint("qd"),
        joint_torque=joint("tau_est"),
        joint_target=joint("q_target"),
        foot_force=force[:, None],
        foot_peak_force=force[:, None],
    )


def hysteresis(force: Array, on: float, off: float) -> np.ndarray:
    """Return whether each foot touches (T, L): from a force (T, L) of ``on`` until one below ``off``, N."""
    states = np.where(force >= on, 1, np.where(force < off, 0, -1)).astype(np.int8).T
    runs = find_runs(np.ascontiguousarray(states))
    value = runs.value.copy()
    undecided = np.flatnonzero(value == -1)
    before = value[np.maximum(undecided - 1, 0)]  # what it was before it came between the thresholds
    value[undecided] = np.where(runs.start[undecided] > 0, before, 0)
    return np.repeat(value, runs.length).reshape(states.shape).T == 1


def _into_body(quat: Array, vector: Array) -> Array:
    """Rotate world vectors (T, 3) or (3,) into the frame whose attitudes are ``quat`` (T, 4), w-x-y-z."""
    w, axis = quat[:, :1], -quat[:, 1:]
    vector = np.broadcast_to(vector, axis.shape)
    twice = 2.0 * np.cross(axis, vector)
    return vector + w * twice + np.cross(axis, twice)
