"""MCAP logs of ROS 2: JointState of any robot, LowState of a Unitree Go1 or Go2; needs the extra ``logs``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, Field

import go1exp.logs.importers.bags as bags
from go1exp.config.schema.registry import NonNegative, Positive, importer
from go1exp.logs.importers.source import files, recording
from go1exp.logs.recording import FOOT_FORCE, VECTORS, Quaternion, Recording, RecordingError, columns
from go1exp.robot import JOINTS, LEGS

PACKAGES = ("unitree_go", "ros2_unitree_legged_msgs", "unitree_legged_msgs")
"""Packages of ROS 2 that have Unitree's messages, of the Go2 first."""

STOP = 1e6  # rad; the value by which a command says that it has no target, 2.146e9, lies above it

Joints = tuple[int, tuple[int | str, ...], tuple[str, ...], Mapping[str, Sequence[float]]]
"""Stamp, ns, source, names and values of a message, as ``bags.Kind`` has them."""

Vector = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]


def _either(snake: str, camel: str) -> Any:
    return Field(validation_alias=AliasChoices(snake, camel))


# ---------------------------------------- sensor_msgs/msg/JointState


class _Stamp(bags.Decoded):
    sec: int
    nanosec: int = _either("nanosec", "nsec")


class _Header(bags.Decoded):
    stamp: _Stamp
    frame_id: str = ""


class _JointState(bags.Decoded):
    header: _Header | None = None
    name: tuple[str, ...]
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


def _joints(state: _JointState) -> Joints:
    head = state.header
    stamp = head.stamp.sec * 10**9 + head.stamp.nanosec if head else 0
    fields = {"position": state.position, "velocity": state.velocity, "effort": state.effort}
    return stamp, (head.frame_id if head else "",), state.name, fields


LOWSTATE = {f"{package}/msg/LowState": "; import it with unitree_lowstate_go1 or _go2" for package in PACKAGES}

JOINT_STATE = bags.Kind(("sensor_msgs/msg/JointState", "sensor_msgs/JointState"), _JointState, _joints, LOWSTATE)


@importer("mcap_joint_state")
def mcap_joint_state(
    path: Path,
    *,
    robot: str = "go1",
    state_topic: str = "/joint_states",
    command_topic: str | None = None,
    joints: tuple[str, ...] | None = None,
    base: Literal["fixed", "floating"] = "floating",
    base_quat: Quaternion | None = None,
    kp: tuple[NonNegative, ...] | None = None,
    kd: tuple[NonNegative, ...] | None = None,
    tau_limit: tuple[Positive, ...] | None = None,
    excitation: str | None = None,
    drop_repeats: bool = False,
    cut: bool = False,
) -> list[Recording]:
    """Joint states, and commands if there are any, from the MCAP log of any ROS 2 robot.

    State ``position``, ``velocity``, ``effort`` become ``q``, ``qd``, ``tau_est``; command ``position`` and ``effort``
    become ``q_target`` and ``tau_cmd``, held from one command to the next; rows before the first command are left out.
    A velocity or effort that is zero or NaN throughout is taken as not measured and has no column. Messages may be CDR
    or JSON. Of several publishers on a topic, the one that has the joints, is commanded and moves is
    taken; the notes name others.

    Args:
        path: a ``.mcap``, or a folder of them.
        robot: name of the robot.
        state_topic: topic of the measured joint states.
        command_topic: topic of the commands, also JointState; None if there is none.
        joints: which joints, in which order; by default those of the source that is taken (a Go1's in our order).
        base: whether the base was ``fixed`` or ``floating``.
        base_quat: attitude of a fixed base, w-x-y-z.
        kp: position gains, N m/rad, in the order of ``joints``.
        kd: velocity gains, N m s/rad.
        tau_limit: torque limits, N m.
        excitation: name of the motion.
        drop_repeats: leave out messages with the time of the one before; the notes have their number.
        cut: import the readable part of a damaged log.

    Raises:
        RecordingError: if the extra is not installed, the log is damaged, or a topic or joint is missing.
    """
    topics = {topic: JOINT_STATE for topic in (state_topic, command_topic) if topic is not None}
    about: dict[str, Any] = {"robot": robot, "base": base, "base_quat": base_quat, "excitation": excitation}
    about |= {"kp": kp, "kd": kd, "tau_limit": tau_limit}
    recordings = []
    for file in files(path, "*.mcap"):
        states, notes = bags.read(file, topics, cut)
        names = joints or bags.joints_of(states[state_topic], states.get(command_topic or "", ()))
        channels, _ = bags.channels(file, states, state_topic, command_topic, names, drop_repeats, notes)
        about |= {"joints": names, "notes": " ".join(notes)}
        recordings.append(recording(file, "mcap_joint_state", channels, **about))
    return recordings


# ---------------------------------------- LowState and LowCmd


class _Motor(bags.Decoded):
    q: float
    dq: float
    tau_est: float = _either("tau_est", "tauEst")


class _Imu(bags.Decoded):
    quaternion: Quaternion
    gyroscope: Vector
    accelerometer: Vector


class _LowState(bags.Decoded):
    motor_state: tuple[_Motor, ...] = _either("motor_state", "motorState")
    imu_state: _Imu | None = Field(None, validation_alias=AliasChoices("imu_state", "imu"))
    foot_force: tuple[float, ...] = Field((), validation_alias=AliasChoices("foot_force", "footForce"))
    tick: int = 0


class _MotorCommand(bags.Decoded):
    q: float
    kp: float = _either("kp", "Kp")
    kd: float = _either("kd", "Kd")


class _LowCmd(bags.Decoded):
    motor_cmd: tuple[_MotorCommand, ...] = _either("motor_cmd", "motorCmd")


def _state(message: _LowState) -> Joints:
    motors = message.motor_state[: len(JOINTS)]  # the others are not used
    values = {"position": "q", "velocity": "dq", "effort": "tau_est"}
    return 0, (), JOINTS[: len(motors)], {k: [getattr(m, name) for m in motors] for k, name in values.items()}


def _command(message: _LowCmd) -> Joints:
    motors = message.motor_cmd[: len(JOINTS)]
    return 0, (), JOINTS[: len(motors)], {"position": [m.q for m in motors]}


STATE = bags.Kind(tuple(f"{package}/msg/LowState" for package in PACKAGES), _LowState, _state)
COMMAND = bags.Kind(tuple(f"{package}/msg/LowCmd" for package in PACKAGES), _LowCmd, _command)


_LOWSTATE = """

Motors 0 to 11 are FR, FL, RR, RL x hip, thigh, calf: our order and names. Commands are held from one to the next; their
gains are those of the recording if they never change. t is the time of logging, as the message has no stamp.

Args:
    path: a ``.mcap``, or a folder of them.
    state_topic: topic of LowState.
    command_topic: topic of LowCmd, such as /lowcmd; None if there is none.
    base: whether the base was ``fixed`` or ``floating``.
    base_quat: attitude of a fixed base, w-x-y-z.
    foot_newton: force of one count of ``foot_force``, N; null leaves the feet out, as counts have no unit.
    foot_zero: counts of each unloaded foot, FR, FL, RR, RL.
    excitation: name of the motion.
    drop_repeats: leave out messages with the time of the one before; the notes have their number.
    cut: import the readable part of a damaged log.

Raises:
    RecordingError: if the extra is not installed, the log is damaged, or a topic or motor is missing.
"""


def _importer_of(*, robot: str, topic: str) -> Callable[[Callable[[], None]], Callable[..., list[Recording]]]:
    """Decorator: in place of an empty function comes the importer of a robot that sends LowState on ``topic``."""

    def unitree_lowstate(
        path: Path,
        *,
        state_topic: str = topic,
        command_topic: str | None = None,
        base: Literal["fixed", "floating"] = "floating",
        base_quat: Quaternion | None = None,
        foot_newton: Positive | None = None,
        foot_zero: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        excitation: str | None = None,
        drop_repeats: bool = False,
        cut: bool = False,
    ) -> list[Recording]:
        about = {"robot": robot, "base": base, "base_quat": base_quat, "excitation": excitation}
        foot = (foot_newton, foot_zero)
        logs = files(path, "*.mcap")
        return [_lowstate(file, state_topic, command_topic, foot, drop_repeats, cut, about) for file in logs]

    def documented(empty: Callable[[], None]) -> Callable[..., list[Recording]]:
        unitree_lowstate.__doc__ = f"{empty.__doc__}{_LOWSTATE}"
        return unitree_lowstate

    return documented


@importer("unitree_lowstate_go1")
@_importer_of(robot="go1", topic="/low_state")
def unitree_lowstate_go1() -> None:
    """LowState, and LowCmd if there is any, of a Unitree Go1 from the MCAP log of a ROS 2 node."""


@importer("unitree_lowstate_go2")
@_importer_of(robot="go2", topic="/lowstate")
def unitree_lowstate_go2() -> None:
    """LowState, and any LowCmd, of a Unitree Go2 from an MCAP log: ``ros2 bag record -s mcap /lowstate``."""


def _lowstate(
    path: Path,
    state_topic: str,
    command_topic: str | None,
    foot: tuple[float | None, Sequence[float]],
    drop_repeats: bool,
    cut: bool,
    about: Mapping[str, Any],
) -> Recording:
    topics = {state_topic: STATE} | ({command_topic: COMMAND} if command_topic else {})
    states, notes = bags.read(path, topics, cut)
    for topic, group in states.items():
        motors = min(len(state.names) for state in group)
        if motors < len(JOINTS):
            raise RecordingError(
                f"{path}: {topic}: a message has {motors} motors; a {about['robot']} has {len(JOINTS)}"
            )
    gains: dict[str, tuple[float, ...]] = {}
    if command_topic:
        states[command_topic] = _with_targets(path, command_topic, states[command_topic], notes)
        gains = _gains(command_topic, states[command_topic], notes)
    channels, kept = bags.channels(path, states, state_topic, command_topic, JOINTS, drop_repeats, notes)
    messages = [state.message for state in kept]
    channels |= _imu_columns(messages, notes) | _foot_columns(messages, *foot, notes)
    notes.append(_ticks(np.array([message.tick for message in messages]), channels["t"]))
    return recording(
        path, f"unitree_lowstate_{about['robot']}", channels, joints=JOINTS, notes=" ".join(notes), **gains, **about
    )


def _with_targets(path: Path, topic: str, states: Sequence[bags.State], notes: list[str]) -> list[bags.State]:
    """Return the commands that have a target of every angle; append to the notes; RecordingError if there is none."""
    commands = [state for state in states if max(map(abs, state.fields["position"])) < STOP]
    if left := len(states) - len(commands):
        notes.append(f"{left} commands of {topic} have no target of the angle (2.146e9) and are left out.")
    if not commands:
        raise RecordingError(f"{path}: {topic}: no command has a target of every angle")
    return commands


def _gains(topic: str, commands: Sequence[bags.State], notes: list[str]) -> dict[str, tuple[float, ...]]:
    """Return those of ``kp`` and ``kd``, (J,) each, that never change; append to the notes."""
    gains = {}
    for name in ("kp", "kd"):
        used = {tuple(getattr(m, name) for m in s.message.motor_cmd[: len(JOINTS)]) for s in commands}
        if len(used) == 1:
            gains[name] = tuple(float(f"{value:.7g}") for value in used.pop())  # float32 of the message
        else:
            notes.append(f"{name} of {topic} changes, so that the recording has none.")
    return gains


def _imu_columns(messages: Sequence[_LowState], notes: list[str]) -> dict[str, np.ndarray]:
    """Return the columns of the IMU (T,) that are not zero throughout; append to the notes."""
    channels: dict[str, np.ndarray] = {}
    if any(message.imu_state is None for message in messages):
        return channels
    for quantity, field in (("imu_quat", "quaternion"), ("imu_gyro", "gyroscope"), ("imu_acc", "accelerometer")):
        block = np.array([getattr(message.imu_state, field) for message in messages], np.float64)
        if block.any():
            channels |= columns(VECTORS[quantity], block)
        else:
            notes.append(f"{field} is zero throughout and is left out.")
    return channels


def _foot_columns(
    messages: Sequence[_LowState], newton: float | None, zero: Sequence[float], notes: list[str]
) -> dict[str, np.ndarray]:
    """Return the forces of the feet (T,), N, if a count has a unit; append to the notes."""
    counts = [message.foot_force for message in messages]
    if newton is not None and all(len(each) == len(LEGS) for each in counts):
        notes.append(f"foot_force = {newton:g} N (counts - {list(zero)}).")
        return columns((FOOT_FORCE + leg for leg in LEGS), newton * (np.array(counts) - zero))
    if any(any(each) for each in counts):
        notes.append("foot_force is in counts without a unit and is left out; foot_newton and foot_zero calibrate it.")
    return {}


def _ticks(tick: np.ndarray, t: np.ndarray) -> str:
    """Return what the robot's own counter (T,) says of the times of logging (T,), s."""
    steps = np.diff(tick)
    if not steps.any() or t[-1] <= t[0]:
        return "The message has no tick that counts."
    if (steps < 0).any():
        return "Its tick begins anew within the log."
    rate = (tick[-1] - tick[0]) / (t[-1] - t[0])
    return f"Its tick counts {rate:.4g} a second by these times; {int((steps == 0).sum())} messages repeat a tick."
