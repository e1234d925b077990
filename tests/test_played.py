"""``go1exp deploy motion=...``: motions of a robot that hangs, and their logs as recordings for ``gap``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from go1exp import robot
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.runtime.log import _attitude
from go1exp.logs.excitations import ExcitationError
from go1exp.logs.record.motions import BLEND_S, GAINS, RATE_HZ, played
from go1exp.logs.recording import joint_channels
from tests.made import low_state

STANCE = robot.NOMINAL_STANCE


def table(path: Path, **changed: np.ndarray) -> Path:
    """Write targets that grow by 0.1 rad within 0.1 s, at 100 Hz, with gains of their own."""
    columns = {"t": np.arange(11) * 0.01 + 3.0}
    columns |= {
        name: q + 0.05 + np.arange(11) * 0.01
        for name, q in zip(joint_channels("q_target", robot.JOINTS), STANCE, strict=True)
    }
    columns |= {name: np.full(11, 30.0 + j) for j, name in enumerate(joint_channels("kp", robot.JOINTS))}
    columns |= {name: np.full(11, 0.75) for name in joint_channels("kd", robot.JOINTS)}
    columns |= changed
    lines = [",".join(columns), *(",".join(f"{v:.6f}" for v in row) for row in np.stack(list(columns.values()), 1))]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_file_is_played_at_its_own_rate_and_gains_from_the_nominal_stance(tmp_path: Path) -> None:
    motion = played(str(table(tmp_path / "next.csv")), None, None, None, 0)
    assert (motion.name, motion.rate) == ("playback", pytest.approx(100.0))
    assert motion.seconds == pytest.approx(BLEND_S + 0.11)
    sent = [motion.step(np.zeros(3), low_state(joint_pos=STANCE - 0.1), np.zeros(3)) for _ in range(215)]
    targets, blend = np.array([command.joint_target for command in sent]), round(100 * BLEND_S)
    np.testing.assert_allclose(targets[0], STANCE, atol=1e-12)  # where standing up has brought it
    np.testing.assert_allclose(np.diff(targets[: blend + 1], axis=0), 0.05 / blend, atol=1e-6)  # at a constant speed
    for row in range(11):
        np.testing.assert_allclose(targets[blend + row], STANCE + 0.05 + 0.01 * row, atol=1e-5)
    np.testing.assert_allclose(targets[-1], STANCE + 0.15, atol=1e-5)  # then it holds
    assert (sent[0].kp.tolist(), sent[0].kd.tolist()) == ([30.0 + j for j in range(12)], [0.75] * 12)


def test_an_excitation_is_played_by_name() -> None:
    motion = played("chirp", 3.0, None, None, 1)
    assert (motion.name, motion.rate, motion.seconds) == ("chirp", RATE_HZ, pytest.approx(BLEND_S + 3.0))
    assert [gain[0] for gain in motion.gains] == list(GAINS)
    assert [gain[0] for gain in played("chirp", 3.0, 200.0, (35.0, 0.6), 1).gains] == [35.0, 0.6]
    blend = [
        motion.step(np.zeros(3), low_state(joint_pos=STANCE), np.zeros(3)) for _ in range(round(RATE_HZ * BLEND_S))
    ]
    moved = np.array(
        [motion.step(np.zeros(3), low_state(joint_pos=STANCE), np.zeros(3)).joint_target for _ in range(1200)]
    )
    assert len(blend)
    assert np.ptp(moved, axis=0).min() > 0.1


@pytest.mark.parametrize(
    ("wish", "problem"),
    [("squat", "squat.*is for a robot on the ground"), ("torque_off", "switches actuators off"), ("chrip", "chrip")],
)
def test_what_a_hung_robot_cannot_do_is_refused(wish: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        played(wish, 20.0, None, None, 0)


def test_files_that_cannot_be_played_are_refused_by_column(tmp_path: Path) -> None:
    with pytest.raises(ExcitationError, match="cannot be read"):
        played(str(tmp_path / "none.csv"), None, None, None, 0)
    with pytest.raises(ConfigError, match="kd_FL_thigh changes"):
        played(str(table(tmp_path / "a.csv", kd_FL_thigh=np.arange(11.0))), None, None, None, 0)
    off = np.ones(11)
    off[5] = 0.0
    with pytest.raises(ConfigError, match="switches actuators off"):
        played(str(table(tmp_path / "b.csv", torque_enable=off)), None, None, None, 0)
    wide = np.linspace(0.0, 5.0, 11)
    with pytest.raises(ExcitationError, match="q_target_FR_calf goes from"):
        played(str(table(tmp_path / "c.csv", q_target_FR_calf=wide)), None, None, None, 0)


def test_the_attitude_of_a_hung_robot_is_the_mean_of_its_imu() -> None:
    half = np.array([0.1, 0.12, 0.08])
    quat = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half])
    quat[:, 1] *= -1.0  # the same attitude
    np.testing.assert_allclose(_attitude(quat), [np.cos(0.1), 0.0, np.sin(0.1), 0.0], atol=1e-4)
