"""ROS 2 ``sensor_msgs/msg/JointState`` in an MCAP log, from any robot; needs the extra ``logs``."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from go1exp.config.schema.registry import NonNegative, Positive, explain, importer
from go1exp.logs.importers.source import files, joint_columns, recording
from go1exp.logs.recording import Quaternion, Recording, RecordingError
from go1exp.robot import JOINTS

TYPES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")

Fields = Literal["position", "velocity", "effort"]


class _Stamp(BaseModel):
    model_config = ConfigDict(from_attributes=True)

    sec: int
    nanosec: int = Field(validation_alias=AliasChoices("nanosec", "nsec"))


class _Header(BaseModel):
    model_config = ConfigDict(from_attributes=True)

    stamp: _Stamp


class _JointState(BaseModel):
    model_config = ConfigDict(from_attributes=True)

    header: _Header | None = None
    name: tuple[str, ...]
    position: list[float] = []
    velocity: list[float] = []
    effort: list[float] = []


@dataclass(frozen=True)
class _Message:
    log_ns: int
    stamp_ns: int
    state: _JointState


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
) -> list[Recording]:
    """Joint states, and commands if there are any, from the MCAP log of any ROS 2 robot.

    State ``position``, ``velocity``, ``effort`` become ``q``, ``qd``, ``tau_est``; command ``position`` and ``effort``
    become ``q_target`` and ``tau_cmd``, held from one command to the next; rows before the first command are left out.
    A velocity or effort that is zero or NaN throughout is taken as not measured and has no column. Messages may be CDR
    or JSON.

    Args:
        path: a ``.mcap``, or a folder of them.
        robot: name of the robot.
        state_topic: topic of the measured joint states.
        command_topic: topic of the commands, also JointState; None if there is none.
        joints: which joints, in which order; by default those of the first message (a Go1's in our order).
        base: whether the base was ``fixed`` or ``floating``.
        base_quat: attitude of a fixed base, w-x-y-z.
        kp: position gains, N m/rad, in the order of ``joints``.
        kd: velocity gains, N m s/rad.
        tau_limit: torque limits, N m.
        excitation: name of the motion.

    Raises:
        RecordingError: if the extra is not installed, the log is damaged, or a topic or joint is missing.
    """
    topics = [state_topic] if command_topic is None else [state_topic, command_topic]
    recordings = []
    for file in files(path, "*.mcap"):
        messages = _read(file, topics)
        names = joints or messages[state_topic][0].state.name
        names = JOINTS if joints is None and set(names) == set(JOINTS) else names
        channels, notes = _channels(file, state_topic, command_topic, messages, names)
        recordings.append(
            recording(
                file,
                "mcap_joint_state",
                channels,
                robot=robot,
                joints=names,
                base=base,
                base_quat=base_quat,
                kp=kp,
                kd=kd,
                tau_limit=tau_limit,
                excitation=excitation,
                notes=" ".join(notes),
            )
        )
    return recordings


def _channels(
    path: Path,
    state_topic: str,
    command_topic: str | None,
    messages: dict[str, list[_Message]],
    joints: tuple[str, ...],
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the columns, in the order of ``joints``, and the notes."""
    everything = [m for topic in messages.values() for m in topic]
    # Header stamps are when the state was measured, log times when it was written. One kind for all messages.
    stamped = all(m.stamp_ns > 0 for m in everything)
    clock = {k: np.array([m.stamp_ns if stamped else m.log_ns for m in v], np.int64) for k, v in messages.items()}
    now = clock[state_topic]
    notes = [f"t = 0 is {now[0]} ns of {'the header stamps' if stamped else 'the log'}."]
    if not stamped:
        notes.append("Some messages have no header stamp, so t is the time of logging.")
    channels = {"t": (now - now[0]) / 1e9}  # from integers: float64 cannot hold ns since 1970
    states: dict[str, Fields] = {"q": "position", "qd": "velocity", "tau_est": "effort"}
    for quantity, key in states.items():
        channels |= _quantity(path, state_topic, messages[state_topic], joints, quantity, key, notes)
    if f"q_{joints[0]}" not in channels:
        raise RecordingError(f"{path}: {state_topic}: its messages hold no position")
    if command_topic is None:
        return channels, notes
    if (np.diff(clock[command_topic]) < 0).any():
        raise RecordingError(f"{path}: {command_topic}: time runs backwards")
    # index of the command in force at each state; -1 before the first
    held = np.searchsorted(clock[command_topic], now, side="right") - 1
    kept = held >= 0
    if not kept.any():
        raise RecordingError(f"{path}: {command_topic}: its first command comes after the last state")
    commands: dict[str, Fields] = {"q_target": "position", "tau_cmd": "effort"}
    for quantity, key in commands.items():
        columns = _quantity(path, command_topic, messages[command_topic], joints, quantity, key, notes)
        channels |= {name: values[held] for name, values in columns.items()}
    if not kept.all():
        notes.append(f"The {int((~kept).sum())} states before the first command are left out.")
    return {name: values[kept] for name, values in channels.items()}, notes


def _quantity(
    path: Path,
    topic: str,
    messages: list[_Message],
    joints: tuple[str, ...],
    quantity: str,
    key: Fields,
    notes: list[str],
) -> dict[str, np.ndarray]:
    """Return the columns of one field by name; none if the field is empty, or zero or NaN, in every message."""
    if not any(getattr(m.state, key) for m in messages):
        return {}
    rows, orders = [], {}
    for i, message in enumerate(messages):
        names, values = message.state.name, getattr(message.state, key)
        if len(values) != len(names):
            raise RecordingError(f"{path}: {topic}: message {i} has {len(names)} names, but {len(values)} of {key}")
        if names not in orders:  # messages may list joints in different orders
            missing = [joint for joint in joints if joint not in names]
            if missing:
                raise RecordingError(f"{path}: {topic}: message {i} lacks joint {', '.join(missing)}; has {names}")
            orders[names] = [names.index(joint) for joint in joints]
        rows.append([values[j] for j in orders[names]])
    block = np.array(rows, dtype=np.float64)
    if key != "position" and (np.isnan(block) | (block == 0)).all():
        notes.append(f"{key} of {topic} is zero or NaN throughout and is left out.")
        return {}
    return joint_columns(quantity, joints, block)


# ---------------------------------------------------------------------- the file


def _read(path: Path, topics: list[str]) -> dict[str, list[_Message]]:
    """Decode the messages of ``topics``, each in the order of logging; every topic has at least one."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise RecordingError(f'{path}: to read MCAP, pip install "go1exp[logs]" ({error})') from error
    messages: dict[str, list[_Message]] = {topic: [] for topic in topics}
    topics_in_file: set[str] = set()
    factory = DecoderFactory()
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            topics_in_file = {channel.topic for channel in summary.channels.values()} if summary else set()
            for schema, channel, message in reader.iter_messages(topics=topics):
                where = f"{path}: {channel.topic}"
                decode = _decoder(where, factory, schema, channel.message_encoding)
                state = _checked(f"{where}: message {len(messages[channel.topic])}", decode(message.data))
                stamp = state.header.stamp.sec * 10**9 + state.header.stamp.nanosec if state.header else 0
                messages[channel.topic].append(_Message(message.log_time, stamp, state))
    except RecordingError:
        raise
    except Exception as error:  # the reader and its decompressors share no base class of errors
        raise RecordingError(f"{path}: not a whole MCAP file ({error or type(error).__name__})") from error
    for topic in topics:
        if not messages[topic]:
            raise RecordingError(
                f"{path}: no message on topic {topic!r}; it has {', '.join(sorted(topics_in_file)) or 'none'}"
            )
    return messages


def _decoder(where: str, factory: Any, schema: Any, encoding: str) -> Callable[[bytes], Any]:
    if encoding == "json":
        return json.loads
    if schema is None or schema.name not in TYPES:
        raise RecordingError(f"{where}: must be {TYPES[0]}, not {schema.name if schema else 'without a type'}")
    decode: Callable[[bytes], Any] | None = factory.decoder_for(encoding, schema)
    if decode is None:
        raise RecordingError(f"{where}: {encoding} with a {schema.encoding} schema; cdr with ros2msg, or json, is read")
    return decode


def _checked(where: str, message: Any) -> _JointState:
    try:
        return _JointState.model_validate(message)
    except ValidationError as error:
        raise RecordingError("\n".join(f"{where}: {line}" for line in explain(error, "", ()))) from error
