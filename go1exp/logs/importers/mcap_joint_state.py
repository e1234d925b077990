"""ROS 2 ``sensor_msgs/msg/JointState`` in an MCAP log, from any robot; needs the extra ``logs``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import AliasChoices, Field

import go1exp.logs.importers.bags as bags
from go1exp.config.schema.registry import NonNegative, Positive, importer
from go1exp.logs.importers.source import files, recording
from go1exp.logs.recording import Quaternion, Recording


class _Stamp(bags.Decoded):
    sec: int
    nanosec: int = Field(validation_alias=AliasChoices("nanosec", "nsec"))


class _Header(bags.Decoded):
    stamp: _Stamp
    frame_id: str = ""


class _JointState(bags.Decoded):
    header: _Header | None = None
    name: tuple[str, ...]
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()


def _joints(state: _JointState) -> tuple[int, tuple[Any, ...], tuple[str, ...], Mapping[str, Sequence[float]]]:
    head = state.header
    stamp = head.stamp.sec * 10**9 + head.stamp.nanosec if head else 0
    fields = {"position": state.position, "velocity": state.velocity, "effort": state.effort}
    return stamp, (head.frame_id if head else "",), state.name, fields


JOINT_STATE = bags.Kind(("sensor_msgs/msg/JointState", "sensor_msgs/JointState"), _JointState, _joints)


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
    or JSON. Of several publishers on a topic, the one that has the joints, and moves, is taken; the notes name others.

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
    recordings = []
    for file in files(path, "*.mcap"):
        states, notes = bags.read(file, topics, cut)
        names = joints or bags.joints_of(states[state_topic])
        channels, _ = bags.channels(file, states, state_topic, command_topic, names, drop_repeats, notes)
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
