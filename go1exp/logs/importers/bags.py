"""MCAP logs of ROS 2: reading their messages, choosing one source of a topic, and columns of what joints report."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from go1exp.base.wording import counted
from go1exp.config.schema.registry import explain
from go1exp.logs.importers.series import between, one_motion, taking_turns
from go1exp.logs.importers.source import beginning, kind, without_repeats
from go1exp.logs.recording import RecordingError, joint_columns
from go1exp.robot import JOINTS

EXTRA = 'pip install "go1exp[logs]"'

MOSTLY = 0.98  # share of the messages that must have a field for those without it to be left out; more are bad gaps


class Decoded(BaseModel):
    """A message, read by the names of its fields, whether it came as an object or as JSON."""

    model_config = ConfigDict(from_attributes=True)


@dataclass(frozen=True)
class State:
    """What one message says of joints."""

    log_ns: int  # time of logging, ns
    stamp_ns: int  # time of its header, ns; 0 if it has none
    source: tuple[int | str, ...]  # what tells publishers of one topic apart
    names: tuple[str, ...]  # joints
    # ``position``, ``velocity`` and ``effort``, one value for each joint, or none
    fields: Mapping[str, Sequence[float]]
    message: Any  # all of it


@dataclass(frozen=True)
class Kind:
    """A type of message: its names, its fields, and the stamp, source, names and values that it says of joints."""

    types: tuple[str, ...]
    model: type[Decoded]
    joints: Callable[[Any], tuple[int, tuple[int | str, ...], tuple[str, ...], Mapping[str, Sequence[float]]]]
    others: Mapping[str, str] = field(default_factory=dict)  # other types -> how to import them, after "; "


# ---------------------------------------------------------------------- the file


def read(path: Path, topics: Mapping[str, Kind], cut: bool) -> tuple[dict[str, list[State]], list[str]]:
    """Return the messages of topics, each in the order of logging and at least one, and notes.

    Args:
        path: the log.
        topics: topic -> type of its messages.
        cut: whether the readable part of a damaged log will do.

    Raises:
        RecordingError: if the extra is not installed, the log is damaged or of another kind, or a topic is missing.
    """
    try:
        from mcap.exceptions import UnsupportedCompressionError
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise RecordingError(f"{path}: to read MCAP, {EXTRA} ({error})") from error
    start = beginning(path)
    if not start.startswith(b"\x89MCAP0") and (what := kind(start)):
        raise RecordingError(f"{path}: is {what}")
    states: dict[str, list[State]] = {topic: [] for topic in topics}
    present: set[str] = set()
    notes: list[str] = []
    factory, decoders = DecoderFactory(), {}

    def add(schema: Any, channel: Any, message: Any) -> None:
        known, where = states[channel.topic], f"{path}: {channel.topic}"
        if channel.id not in decoders:
            decoders[channel.id] = _decoder(where, factory, schema, channel.message_encoding, topics[channel.topic])
        content = _checked(f"{where}: message {len(known)}", topics[channel.topic], decoders[channel.id], message.data)
        stamp, source, names, fields = topics[channel.topic].joints(content)
        known.append(State(message.log_time, stamp, (channel.id, *source), names, fields, content))

    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            present = {channel.topic for channel in summary.channels.values()} if summary else set()
            for each in reader.iter_messages(topics=list(topics)):
                add(*each)
    except RecordingError:
        raise
    except UnsupportedCompressionError as error:
        raise RecordingError(f"{path}: its chunks are compressed; to read them, pip install {error}") from error
    except Exception as error:  # the reader and its decompressors share no base class of errors
        for messages in states.values():
            messages.clear()
        present = _topics_until_the_cut(path, topics, add)
        for messages in states.values():
            messages.sort(key=lambda state: state.log_ns)
        if not cut or not any(states.values()):
            why = f"{path}: not a whole MCAP file ({'it is empty' if not start else error or type(error).__name__})"
            raise RecordingError(f"{why}; {_readable(path, states)}") from error
        notes.append("The log is cut or damaged; this is its readable part.")
    for topic, messages in states.items():
        if not messages:
            raise RecordingError(
                f"{path}: no message on topic {topic!r}; it has {', '.join(sorted(present)) or 'none'}"
            )
    return states, notes


def _readable(path: Path, states: Mapping[str, Sequence[State]]) -> str:
    """Return what of a damaged log can be read, and how to get it."""
    readable = [f"{len(m)} of {topic}" for topic, m in states.items() if m]
    if not readable:
        return f"no message of {' or '.join(states)} is readable"
    last = max(m[-1].log_ns for m in states.values() if m)
    seconds = (last - min(m[0].log_ns for m in states.values() if m)) / 1e9
    return (
        f"its first {seconds:.3g} s are readable (messages: {', '.join(readable)}): import them by "
        f"cut: true, or recover the file: mcap recover {path.name} -o whole.mcap (of the mcap tool)"
    )


def _topics_until_the_cut(path: Path, topics: Container[str], add: Callable[[Any, Any, Any], None]) -> set[str]:
    """Return all topics up to where a log cannot be read any further, and ``add`` the messages of ``topics``."""
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    present: set[str] = set()
    with path.open("rb") as file:
        records = StreamReader(file, validate_crcs=True).records
        while True:
            try:
                record = next(records)
            except Exception:  # (the end, or whatever a reader or decompressor meets in a damaged file)
                return present
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and record.channel_id in channels:
                channel = channels[record.channel_id]
                present.add(channel.topic)
                if channel.topic in topics:
                    add(schemas.get(channel.schema_id), channel, record)


def _decoder(where: str, factory: Any, schema: Any, encoding: str, wanted: Kind) -> Callable[[bytes], object]:
    if encoding == "json":
        return json.loads
    if encoding == "ros1":
        raise RecordingError(
            f"{where}: has messages of ROS 1; make a bag of ROS 2: rosbags-convert of the package rosbags"
        )
    if schema is None or schema.name not in wanted.types:
        name = schema.name if schema else "without a type"
        raise RecordingError(f"{where}: must be {wanted.types[0]}, not {name}{wanted.others.get(name, '')}")
    decode: Callable[[bytes], object] | None = factory.decoder_for(encoding, schema)
    if decode is None:
        raise RecordingError(f"{where}: {encoding} with a {schema.encoding} schema; cdr with ros2msg, or json, is read")
    return decode


def _checked(where: str, wanted: Kind, decode: Callable[[bytes], object], data: bytes) -> Decoded:
    if data[:4] == b"\x28\xb5\x2f\xfd":  # ros2 bag record --compression-mode message
        import zstandard

        data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    try:
        return wanted.model.model_validate(decode(data))
    except ValidationError as error:
        raise RecordingError("\n".join(f"{where}: {line}" for line in explain(error, "", ()))) from error


# ---------------------------------------------------------------------- one source


def joints_of(states: Sequence[State], commands: Sequence[State] = ()) -> tuple[str, ...]:
    """Return the joints of the source that is commanded, moves, and has the most messages; a Go1's in our order."""
    groups: dict[tuple[str, ...], list[State]] = {}
    for state in states:
        if state.fields["position"]:
            groups.setdefault(state.names, []).append(state)
    commanded = [set(names) for names in {state.names for state in commands}]

    def rank(names: tuple[str, ...]) -> tuple[bool, bool, int]:
        return any(set(names) <= joints for joints in commanded), *_rank(groups[names])

    names = max(groups, key=rank, default=states[0].names)
    return JOINTS if set(names) == set(JOINTS) else names


def _rank(states: Sequence[State]) -> tuple[bool, int]:
    return any(s.fields["position"] != states[0].fields["position"] for s in states), len(states)


def one_source(
    path: Path, topic: str, states: Sequence[State], joints: Sequence[str], notes: list[str], *, measured: bool
) -> list[State]:
    """Return the messages of one source that has the joints, and note what is left out.

    Messages may list joints in another order, or lack a field, now and then. Where they come between regular ones, in
    place of none, they are another publisher's. RecordingError if no message has all joints, or one has a wrong number
    of values.
    """
    where, groups = f"{path}: {topic}", dict[tuple[Any, ...], list[State]]()
    for i, state in enumerate(states):
        for quantity, values in state.fields.items():
            if len(values) not in (0, len(state.names)):
                lengths = f"{len(state.names)} names, but {len(values)} of {quantity}"
                raise RecordingError(f"{where}: message {i} has {lengths}")
        filled = tuple(bool(values) for values in state.fields.values())
        zero = measured and not any(state.fields["position"])
        groups.setdefault((state.names, state.source, filled, zero), []).append(state)
    able = {key: group for key, group in groups.items() if set(joints) <= set(key[0]) and (key[2][0] or not measured)}
    if not able and any(set(joints) <= set(key[0]) for key in groups):
        raise RecordingError(f"{where}: its messages hold no position")
    if not able:
        number = Counter(state.names for state in states)
        present = "; ".join(f"{counted(n, 'message')} of ({', '.join(names)})" for names, n in number.items())
        known = {name for key in groups for name in key[0]}
        lacking = [joint for joint in joints if joint not in known]
        why = f"lacks joint {', '.join(lacking)}" if lacking else "has all of the joints in no single message"
        raise RecordingError(f"{where}: {why}; it has {present}")
    main = max(able, key=lambda key: _rank(able[key]))
    clock, q = _motion(able[main], joints)
    taken, left = list(able[main]), Counter[str]()
    for key, group in groups.items():
        if key == main:
            continue
        times, other = _motion(group, joints) if key in able else (clock, q)
        same = measured and key[1] == main[1] and one_motion(clock, q, times, other)
        if key in able and (same or not between(clock, times)):
            taken += group
        else:
            what = "all of them zero, " if key in able and key[3] else ""
            source = "a second source of these joints" if key in able else "another source"
            left[f"{source} ({what}{', '.join(key[0])})"] += len(group)
    notes += [f"{topic}: {counted(n, 'message')} of {source} left out." for source, n in left.items()]
    order = {id(state): i for i, state in enumerate(states)}
    taken.sort(key=lambda state: order[id(state)])
    clock, q = _motion(taken, joints)
    read = q.any(axis=1) if measured else np.zeros(len(q), dtype=bool)  # lost readings are no publisher
    share, joint, jump = taking_turns((clock[read] - clock[0]) / 1e9, q[read])
    if share:
        raise RecordingError(
            f"{where}: has several publishers of these joints: in {share:.0%} of its messages angles jump and are back "
            f"in the next one ({joints[joint]} by {jump:.3g} rad); record one, or give each a frame_id"
        )
    return taken


def _motion(states: Sequence[State], joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return times of logging (N,), ns, and positions (N, J), zeros where there are none."""
    orders = {names: [names.index(joint) for joint in joints] for names in {s.names for s in states}}
    empty = [0.0] * max(map(len, orders))
    rows = [[(s.fields["position"] or empty)[j] for j in orders[s.names]] for s in states]
    return np.array([s.log_ns for s in states], np.int64), np.array(rows, np.float64)


# ---------------------------------------------------------------------- columns


def channels(
    path: Path,
    states: Mapping[str, Sequence[State]],
    state_topic: str,
    command_topic: str | None,
    joints: tuple[str, ...],
    drop_repeats: bool,
    notes: list[str],
) -> tuple[dict[str, np.ndarray], list[State]]:
    """Return columns in the order of ``joints``, commands held from the first on, and rows' messages; append notes."""
    chosen = {
        topic: one_source(path, topic, group, joints, notes, measured=topic == state_topic)
        for topic, group in states.items()
    }
    blocks = {topic: _blocks(topic, group, joints, notes) for topic, group in chosen.items()}
    chosen = {topic: list(whole) for topic, (whole, _) in blocks.items()}
    clock = _clock(chosen, state_topic, notes)
    rows = _rows(f"{path}: {state_topic}", clock[state_topic], drop_repeats, notes)
    now = clock[state_topic][rows]
    columns = {"t": (now - now[0]) / 1e9}  # from integers: float64 cannot hold ns since 1970
    for quantity, key in (("q", "position"), ("qd", "velocity"), ("tau_est", "effort")):
        if key in blocks[state_topic][1]:
            columns |= joint_columns(quantity, joints, blocks[state_topic][1][key][rows])
    kept = [chosen[state_topic][k] for k in rows]
    if command_topic is None:
        return columns, kept
    if (np.diff(clock[command_topic]) < 0).any():
        raise RecordingError(f"{path}: {command_topic}: time runs backwards")
    # index of the command in force at each state; -1 before the first
    held = np.searchsorted(clock[command_topic], now, side="right") - 1
    use = held >= 0
    if not use.any():
        raise RecordingError(f"{path}: {command_topic}: its first command comes after the last state")
    for quantity, key in (("q_target", "position"), ("tau_cmd", "effort")):
        if key in blocks[command_topic][1]:
            columns |= joint_columns(quantity, joints, blocks[command_topic][1][key][held])
    if not use.all():
        notes.append(f"The {int((~use).sum())} states before the first command are left out.")
    return {k: v[use] for k, v in columns.items()}, [s for s, u in zip(kept, use, strict=True) if u]


def _clock(chosen: Mapping[str, Sequence[State]], state_topic: str, notes: list[str]) -> dict[str, np.ndarray]:
    """Return the times of each topic's messages, ns since 1970; append to the notes."""
    # Header stamps are when the state was measured, log times when it was written. One kind for all messages.
    stamped = all(s.stamp_ns > 0 for group in chosen.values() for s in group)
    clock = {k: np.array([s.stamp_ns if stamped else s.log_ns for s in group], np.int64) for k, group in chosen.items()}
    notes.insert(0, f"t = 0 is {clock[state_topic][0]} ns of {'the header stamps' if stamped else 'the log'}.")
    if not stamped and any(s.stamp_ns for group in chosen.values() for s in group):
        notes.append("Some messages have no header stamp, so t is the time of logging.")
    return clock


def _rows(where: str, now: np.ndarray, drop_repeats: bool, notes: list[str]) -> np.ndarray:
    """Return rows of times ``now`` (T,) to use; append to the notes; RecordingError for repeats that are to stay."""
    fresh, rows = without_repeats(now), np.arange(len(now))
    if len(fresh) == len(now):
        return rows
    twice = counted(len(now) - len(fresh), "message")
    if drop_repeats:
        notes.append(f"{twice} with the time of the one before: left out.")
        return rows[fresh]
    if (np.diff(now) >= 0).all():
        first = int(np.flatnonzero(np.diff(now) == 0)[0]) + 1
        raise RecordingError(
            f"{where}: t: must increase strictly, but row {first} has the time of the one before ({twice}); "
            "leave such out by drop_repeats: true, unless they are another publisher's"
        )
    return rows


def _blocks(
    topic: str, states: Sequence[State], joints: Sequence[str], notes: list[str]
) -> tuple[Sequence[State], dict[str, np.ndarray]]:
    """Return messages with all used fields, and field -> (T, J): positions, and others in most, not all 0 or NaN."""
    used = []
    for key in states[0].fields:
        filled = sum(bool(s.fields[key]) for s in states)
        if filled >= MOSTLY * len(states):
            used.append(key)
        elif filled:
            share = f"{filled} of {len(states)} messages ({filled / len(states):.0%})"
            notes.append(f"{key} of {topic} is in {share} only and is left out; the rows of all messages are kept.")
    whole = [s for s in states if all(s.fields[key] for key in used)]
    if len(whole) < len(states):
        notes.append(
            f"{counted(len(states) - len(whole), 'message')} of {topic} without {' or '.join(used)}: left out."
        )
    orders = {names: [names.index(joint) for joint in joints] for names in {s.names for s in whole}}
    blocks = {}
    for key in used:
        block = np.array([[s.fields[key][j] for j in orders[s.names]] for s in whole], np.float64)
        if key != "position" and (np.isnan(block) | (block == 0)).all():
            notes.append(f"{key} of {topic} is zero or NaN throughout and is left out.")
        else:
            blocks[key] = block
    return whole, blocks
