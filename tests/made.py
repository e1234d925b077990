"""Metadata, a state, a command and a link with usual values, for tests that care for a few; real recordings."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.logs.recording import Meta
from go1exp.robot.messages import LowCmd, LowState

LEVEL = (1.0, 0.0, 0.0, 0.0)


def meta(joints: Sequence[str] = robot.JOINTS, **about: Any) -> Meta:
    """Return metadata of a simulated Go1 at 500 Hz whose level trunk is held, with changes."""
    usual: dict[str, Any] = {"robot": "go1", "rate_hz": 500.0, "base": "fixed", "base_quat": LEVEL}
    usual |= {"kp": None, "kd": None, "tau_limit": None, "excitation": None, "episode": "one", "repeat_of": None}
    usual |= {"source": "simulated", "tool": "test", "versions": {}, "notes": ""}
    return Meta(joints=tuple(joints), **(usual | about))


def low_state(t: float = 0.0, **changes: Any) -> LowState:
    """Return what a robot reports that stands at rest in the nominal stance, with changes."""
    usual: dict[str, Any] = {"joint_pos": robot.NOMINAL_STANCE.copy(), "joint_vel": np.zeros(12)}
    usual |= {"joint_torque": np.zeros(12), "imu_quat": np.array(LEVEL), "imu_gyro": np.zeros(3)}
    usual |= {"imu_acc": np.array([0.0, 0.0, 9.81]), "foot_force": np.full(4, 30.0)}
    return LowState(t, **(usual | changes))


def shaking_state(seed: int, t: float, **changes: Any) -> LowState:
    """Return what a robot reports that shakes about the nominal stance, with changes."""
    rng = np.random.default_rng(seed)
    noisy = {"joint_pos": robot.NOMINAL_STANCE + 0.01 * rng.normal(size=12), "joint_vel": rng.normal(size=12)}
    noisy |= {"joint_torque": rng.normal(size=12), "imu_gyro": 0.1 * rng.normal(size=3)}
    return low_state(t, **(noisy | changes))


def low_cmd(**changes: Any) -> LowCmd:
    """Return a command that holds the nominal stance, with changes."""
    return dataclasses.replace(LowCmd(robot.NOMINAL_STANCE.copy(), np.full(12, 20.0), np.full(12, 0.5)), **changes)


class FakeLink:
    """Gives the states of a script, one list each cycle, and keeps what is sent."""

    sent_at = math.nan

    def __init__(self, script: Callable[[int], Sequence[LowState]]) -> None:
        self.script, self.cycle = script, -1
        self.sent: list[LowCmd] = []

    def receive(self) -> Sequence[LowState]:
        self.cycle += 1
        return self.script(self.cycle)

    def send(self, command: LowCmd) -> None:
        self.sent.append(command)

    def repeat(self) -> None:
        pass

    def rehearse(self, command: LowCmd) -> None:
        pass

    def close(self) -> None:
        pass


def at(values: np.ndarray, k: int, value: float) -> np.ndarray:
    """Return values of which the one at ``k`` is another."""
    changed = np.array(values, dtype=float)
    changed[k] = value
    return changed


def real(name: str) -> Path:
    """Return the file or folder of recordings of real robots, or skip the test where there is none."""
    place = Path(os.environ.get("GO1EXP_DATA", data_root().parent / "shared/data")) / name
    if not place.exists():
        pytest.skip(f"the recordings of {name} are not here; GO1EXP_DATA names their folder")
    return place
