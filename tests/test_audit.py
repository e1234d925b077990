"""The audit names every defect that is put into a sound recording, with its channel and size, and nothing else.

Sound recordings come from a joint model that lives here: twelve inertias with dry friction and gravity under the
PD law, driven through the package's own excitations, and a base that rocks by a closed form.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from go1exp.cli.record import AUDIT
from go1exp.config.schema import registry
from go1exp.logs import excitations
from go1exp.logs.audit import AuditReport, audit, clock_flaws, clock_kinds, signals
from go1exp.logs.audit.copies import copies
from go1exp.logs.audit.impossible import impossible, without
from go1exp.logs.audit.signals import Log
from go1exp.logs.recording import VECTORS, Recording, columns, joint_channels, joint_columns, write
from go1exp.robot import EFFORT_LIMIT, JOINT_POS_LIMITS, JOINTS, NOMINAL_STANCE, per_joint, soft_limits
from tests.made import at, real
from tests.made import meta as made_meta

RATE = 500.0
SECONDS = 6
ROWS = 3000
ENCODER = 3.0e-5  # rad
DRIVE: dict[str, Any] = {"kp": (20.0,) * 12, "kd": (0.5,) * 12, "tau_limit": tuple(per_joint(EFFORT_LIMIT))}
META = made_meta(base="floating", base_quat=None, episode="synthetic", **DRIVE)
STOPS = JOINT_POS_LIMITS
TORQUES = joint_channels("tau_est", JOINTS)


MOTIONS = ("chirp", "multisine", "steps", "slow_ramps", "gait", "torque_off", "squat", "drop")


@cache
def responses(delay: float, rate: float, limit: float) -> dict[str, tuple[excitations.Motion, np.ndarray]]:
    """Motions by name, with joint angles, speeds and torques (3, T, 12) by semi-implicit Euler steps of 1 ms."""
    t, h = np.arange(round(SECONDS * rate)) / rate, 1e-3
    members = registry.members("excitation")
    motions = {m: members[m].target(t, NOMINAL_STANCE, soft_limits(0.9), np.random.default_rng(5)) for m in MOTIONS}
    per = round((t[1] - t[0]) / h)
    row = np.clip(np.searchsorted(t, np.arange(len(t) * per) * h - delay + 1e-9, side="right") - 1, 0, None)
    q = np.stack([m.start for m in motions.values()])
    qd = np.zeros_like(q)
    target, on = (np.stack([getattr(m, k) for m in motions.values()], axis=1) for k in ("target", "torque_enable"))
    most = limit * per_joint(EFFORT_LIMIT)
    out = np.empty((3, len(t), *q.shape))
    for i in range(len(t) * per):
        beyond = q - np.clip(q, STOPS[:, 0], STOPS[:, 1])
        stop = np.where(beyond != 0, 500 * beyond + 5 * qd, 0.0)
        tau = np.clip(20 * (target[row[i]] - q) - 0.5 * qd, -most, most) * on[row[i], :, None]
        if i % per == 0:
            out[:, i // per] = q, qd, tau
        qd = qd + h / 0.03 * (tau - stop - 0.8 * np.sin(q) - 0.1 * np.tanh(qd / 0.05) - 0.01 * qd)
        q = q + h * qd
    return {name: (motion, out[:, :, k]) for k, (name, motion) in enumerate(motions.items())}


def by_joint(**quantities: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of quantities (T, 12)."""
    return {c: v for name, values in quantities.items() for c, v in joint_columns(name, JOINTS, values).items()}


@cache
def made(name: str = "steps", delay: float = 0.0, rate: float = RATE, limit: float = 1.0) -> Recording:
    """A sound, noise-free recording; arrays are shared, so tests copy what they change."""
    t = np.arange(round(SECONDS * rate)) / rate
    motion, (q, qd, tau) = responses(delay, rate, limit)[name]
    channels = {"t": t} | by_joint(q=q, qd=qd, q_target=motion.target, tau_est=tau)
    turn = Rotation.from_euler("ZYX", np.stack([a * np.sin(w * t + p) for a, w, p in ROCKING], axis=1))
    fine = Rotation.from_euler("ZYX", np.stack([a * np.sin(w * (t + 1e-6) + p) for a, w, p in ROCKING], axis=1))
    gyro = (turn.inv() * fine).as_rotvec() / 1e-6
    acc = turn.inv().apply([0, 0, 9.81]) + 0.3 * np.sin(7 * t)[:, None]
    named = {"imu_gyro_{}": gyro, "imu_acc_{}": acc}
    channels |= {k.format(axis): v[:, i] for k, v in named.items() for i, axis in enumerate("xyz")}
    channels |= {f"imu_quat_{part}": v for part, v in zip("wxyz", turn.as_quat(scalar_first=True).T, strict=True)}
    if not motion.torque_enable.all():
        channels["torque_enable"] = motion.torque_enable
    meta = replace(META, rate_hz=rate, excitation=name, tau_limit=tuple(limit * per_joint(EFFORT_LIMIT)))
    return Recording(meta, {k: np.ascontiguousarray(v) for k, v in channels.items()})


ROCKING = ((0.5, 1.1, 0.3), (0.2, 5.1, 0.0), (0.15, 7.3, 1.0))
"""Amplitude (rad), frequency (rad/s) and phase of yaw, pitch and roll."""


def with_(recording: Recording, **changed: np.ndarray) -> Recording:
    return Recording(recording.meta, recording.channels | changed)


def about(recording: Recording, **changes: Any) -> Recording:
    """A recording with other metadata."""
    return replace(recording, meta=replace(recording.meta, **changes))


def rows(recording: Recording, kept: Any) -> Recording:
    return replace(recording, channels={k: v[kept] for k, v in recording.channels.items()})


ARM: dict[str, Any] = {"robot": "arm", "base": "fixed", "base_quat": (1.0, 0.0, 0.0, 0.0)}
ARM |= dict.fromkeys(("kp", "kd", "tau_limit"))


def realistic(recording: Recording, seed: int = 0) -> Recording:
    """Encoder steps, noise of every sensor and a jittering clock, as on a good robot."""
    rng = np.random.default_rng(seed)
    size = {"q_": 3e-4, "qd": 0.05, "ta": 0.1, "im": 0.02}
    dirty = {}
    for name, values in recording.channels.items():
        if name == "t":
            dirty[name] = values + rng.normal(0, 5e-5, len(values))
        elif name.startswith("q_target") or name == "torque_enable":
            dirty[name] = values
        elif name.startswith("imu_quat"):
            dirty[name] = np.round(values, 6)
        else:
            step = ENCODER if name.startswith("q_") else 1e-3
            dirty[name] = step * np.round((values + rng.normal(0, size[name[:2]], len(values))) / step)
    return with_(recording, **dirty)


def flaws(report: AuditReport) -> set[tuple[str, str, str]]:
    return {(f.check, f.channel, f.verdict) for f in report.flaws}


def size(report: AuditReport, check: str, channel: str) -> float:
    (value,) = [f.size for f in report.by_check(check) if f.channel == channel]
    assert value is not None
    return value


# ---------------------------------------------------------------------- no false alarms


RATES = [*((name, RATE) for name in MOTIONS), *product(("multisine", "steps", "gait"), (50.0, 200.0))]


@pytest.mark.parametrize(("name", "rate"), RATES)
def test_clean_simulated_data_are_ok(name: str, rate: float) -> None:
    report = audit(made(name, rate=rate))
    assert report.flaws == []
    assert all(c.verdict == "ok" for c in report.channels)
    assert [c.name for c in report.channels] == list(made(name, rate=rate).channels)


@pytest.mark.parametrize("name", ["chirp", "multisine", "steps", "slow_ramps", "gait", "torque_off"])
def test_good_real_sensors_are_ok(name: str) -> None:
    recording = realistic(made(name))
    report = audit(about(recording, source="measured"))
    assert (report.flaws, report.verdict) == ([], "ok")


def test_a_fixed_base_and_missing_channels_are_no_flaws() -> None:
    kept = {k: v for k, v in made().channels.items() if k == "t" or k.startswith("q_")}
    still = {f"imu_gyro_{axis}": np.zeros(ROWS) for axis in "xyz"}
    for channels in (kept, kept | still):
        assert audit(Recording(replace(META, **ARM), channels)).flaws == []


# ---------------------------------------------------------------------- the clock


def test_another_rate_is_found() -> None:
    report = audit(about(made(), rate_hz=400.0))
    assert flaws(report) == {("rate", "t", "bad")}
    assert size(report, "rate", "t") == pytest.approx(500)
    assert all(text in report.by_check("rate")[0].message for text in ("500 Hz", "rate_hz = 400"))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds")])
def test_a_clock_in_other_units_is_found(factor: float, unit: str) -> None:
    report = audit(with_(made(), t=made().t * factor))
    assert ("rate", "t", "bad") in flaws(report)
    assert unit in report.by_check("rate")[0].message


@pytest.mark.parametrize(
    ("factor", "without", "line"),
    [
        *((f, "imu_", f"it is in {unit}, not in seconds (speeds times these steps are about {f:.0f} times")
          for f, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))),
        *((f, "qd_", f" s (median); a log of joints must step by at most 0.1 s. Is it in {unit}?")
          for f, unit in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))),
        *((f, "qd_", f"must step by at least 5e-05 s. Are its times {1 / f:.0f} times too small, by a wrong unit?")
          for f in (1e-3, 1e-6)),
    ],
)  # fmt: skip
def test_a_clock_in_other_units_is_told_by_its_steps_even_if_the_rate_is_its_own(
    factor: float, without: str, line: str
) -> None:
    sound = made("multisine", rate=200.0)
    channels = {k: v for k, v in sound.channels.items() if not k.startswith((without, "imu_"))}
    slow = Recording(replace(sound.meta, rate_hz=200.0 / factor), channels | {"t": sound.t * factor})
    report = audit(slow)
    assert report.verdict == "bad"
    assert [line in f.message for f in report.by_check("rate")] == [True]


def test_a_slow_log_is_bad_and_not_taken_for_milliseconds_where_speeds_fit() -> None:
    t = np.arange(400) * 0.25
    channels = {"t": t, "q_knee": np.sin(0.5 * t), "qd_knee": 0.5 * np.cos(0.5 * t)}
    slow = Recording(replace(META, **ARM, joints=("knee",), rate_hz=4.0), channels)
    no_speed = replace(slow, channels={k: v for k, v in channels.items() if k != "qd_knee"})
    for recording, question in ((slow, False), (no_speed, True)):
        report = audit(recording)
        (line,) = [f.message for f in report.by_check("rate")]
        assert (report.verdict, "Is it in milliseconds?" in line) == ("bad", question)
        assert line.startswith("steps by 0.25 s (median); a log of joints must step by at most 0.1 s")


def test_jitter_is_found_and_sized() -> None:
    rng = np.random.default_rng(0)
    t = made().t + rng.uniform(-4e-4, 4e-4, ROWS)
    report = audit(with_(made(), t=t))
    assert flaws(report) == {("jitter", "t", "suspect")}
    assert size(report, "jitter", "t") == pytest.approx(0.8 / np.sqrt(12) * np.sqrt(2), rel=0.05)  # ms


def test_missing_samples_are_counted() -> None:
    keep = np.ones(ROWS, dtype=bool)
    keep[[700, 701, 702, 2100, 2800]] = False
    report = audit(rows(made(), keep))
    assert flaws(report) == {("gaps", "t", "suspect")}
    assert size(report, "gaps", "t") == 5
    assert "in 3 gaps, the longest 8 ms at 1.398 s" in report.by_check("gaps")[0].message
    keep[1000:1100] = False
    assert ("gaps", "t", "bad") in flaws(audit(rows(made(), keep)))


@pytest.mark.parametrize("source", ["measured", "simulated"])
def test_a_clock_that_was_counted_is_told_for_measured_data_only(source: str) -> None:
    (jitter,) = audit(about(made(), source=source)).by_check("jitter")
    assert ("was counted" in jitter.message) == (source == "measured")


# ---------------------------------------------------------------------- single channels


def test_duplicated_rows_are_found_and_counted() -> None:
    row = np.arange(ROWS)
    row[1:] -= np.random.default_rng(1).uniform(size=ROWS)[1:] < 0.05
    sound = realistic(made("chirp"))
    report = audit(with_(rows(sound, row), t=sound.t))
    assert flaws(report) == {("duplicates", "all", "suspect")}
    assert size(report, "duplicates", "all") == pytest.approx(0.05, rel=0.25)


@pytest.mark.parametrize("quantised", [False, True])
def test_a_channel_that_repeats_is_named(quantised: bool) -> None:
    sound = realistic(made("gait")) if quantised else made("gait")
    values = sound.channels["q_FL_thigh"].copy()
    again = np.flatnonzero(np.random.default_rng(2).uniform(size=ROWS - 1) < 0.25) + 1
    for i in again:
        values[i] = values[i - 1]
    report = audit(with_(sound, q_FL_thigh=values))
    assert ("repeats", "q_FL_thigh", "bad") in flaws(report)
    assert {f.channel for f in report.flaws} <= {"q_FL_thigh", "qd_FL_thigh"}
    assert size(report, "repeats", "q_FL_thigh") == pytest.approx(0.25, rel=0.3)


def test_a_channel_that_is_read_at_another_rate_is_named() -> None:
    values = np.repeat(made("gait").channels["qd_RR_calf"][::5], 5)
    report = audit(with_(made("gait"), qd_RR_calf=values))
    assert ("repeats", "qd_RR_calf", "bad") in flaws(report)
    assert size(report, "repeats", "qd_RR_calf") == pytest.approx(0.8, abs=0.03)
    (message,) = [f.message for f in report.by_check("repeats")]
    assert float(message.split()[-2]) == pytest.approx(100, rel=0.15)


def test_the_step_of_each_column_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each target is compared with each angle; a step for each pair would take a third of an audit."""
    asked: list[int] = []
    measure = signals.quantum

    def noted(values: np.ndarray) -> float:
        asked.append(len(values))
        return measure(values)

    monkeypatch.setattr(signals, "quantum", noted)
    audit(made("chirp"))
    assert 0 < len(asked) <= len(made("chirp").channels)


@pytest.mark.parametrize("step", [3.028e-5, 3.8147e-4, 1.534e-3, 0.01])
def test_the_step_of_an_encoder_is_found(step: float) -> None:
    offset = 0.12345 * step
    values = step * np.round((made("chirp").channels["q_FR_calf"] - offset) / step) + offset
    report = audit(with_(made("chirp"), q_FR_calf=values))
    assert size(report, "resolution", "q_FR_calf") == pytest.approx(step, rel=1e-3)
    assert next(c.step for c in report.channels if c.name == "q_FR_calf") == pytest.approx(step, rel=1e-3)
    assert ("resolution", "q_FR_calf", "suspect") in flaws(report) or step < 4e-3
    assert len(report.by_check("resolution")) == 1
    assert all(c.step == 0 for c in report.channels if c.step is not None and c.name != "q_FR_calf")


def test_known_encoders_are_called_by_name() -> None:
    for bits, name in ((4096, "XL330"), (32768 * 6.33, "GO-M8010-6"), (16384, "14 bits a turn")):
        step = 2 * np.pi / bits
        values = step * np.round(made("chirp").channels["q_FR_hip"] / step)
        assert name in audit(with_(made("chirp"), q_FR_hip=values)).by_check("resolution")[0].message


def test_steps_survive_decimal_text_and_continuous_values_have_none() -> None:
    rng = np.random.default_rng(3)
    smooth = np.cumsum(rng.normal(0, 1e-3, 5000))
    assert signals.quantum(smooth) == 0
    assert signals.quantum(smooth.astype(np.float32).astype(float)) == 0
    assert signals.quantum(np.round(3.03e-5 * np.round(smooth / 3.03e-5), 6)) == pytest.approx(3.03e-5, rel=1e-3)
    assert signals.quantum(np.repeat([0.1, 0.25, 0.4, 0.1, 0.7], 100)) == pytest.approx(0.15)
    assert signals.quantum(np.zeros(100)) == 0


def times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: factor * values


def noisy(sigma: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda values: values + np.random.default_rng(4).normal(0, sigma, len(values))


DEGREES = times(180 / np.pi)


@pytest.mark.parametrize(
    ("sound", "column", "damage", "finding", "error", "others"),
    [
        ("multisine", "q_RL_hip", noisy(8e-3), ("noise", "suspect", 8e-3), 4e-4, ()),
        ("multisine", "imu_gyro_y", noisy(3.0), ("noise", "bad", 3.0), 0.15, ()),
        ("steps", "q_RR_thigh", lambda v: np.full(ROWS, 1.0), ("dead", "bad", 1.0), 0.0, None),
        ("steps", "qd_FL_calf", times(0.0), ("dead", "bad", 0.0), 0.0, None),
        ("steps", "tau_est_RL_hip", times(0.0), ("dead", "bad", 0.0), 0.0, None),
        ("steps", "qd_RL_thigh", DEGREES, ("units", "bad", 57.3), 0.573, None),
        ("steps", "imu_gyro_y", DEGREES, ("units", "bad", 57.3), 0.573, ()),
        ("steps", "imu_gyro_y", times(1.2), ("scale", "suspect", 1.2), 0.01, ()),
        ("real gait", "qd_FR_thigh", times(1.1), ("scale", "suspect", 1.1), 0.022, ("tau_est_FR_thigh",)),
        ("real steps", "qd_FR_thigh", times(1.17), ("scale", "suspect", 1.17), 0.0234, ("tau_est_FR_thigh",)),
        ("real gait", "qd_FR_thigh", times(1.5), ("scale", "bad", 1.5), 0.03, ("tau_est_FR_thigh",)),
        ("real chirp", "qd_FR_thigh", times(0.7), ("scale", "bad", 0.7), 0.014, ("tau_est_FR_thigh",)),
        ("real steps", "tau_est_RL_thigh", times(0.8), ("scale", "suspect", 0.8), 0.04, ()),
        ("real steps", "tau_est_RL_thigh", times(1.25), ("scale", "suspect", 1.25), 0.0625, ()),
        ("real steps", "tau_est_RL_thigh", times(0.1), ("scale", "bad", 0.1), 0.005, ()),
        ("gait", "qd_FR_thigh", lambda v: np.roll(v, 10), ("lag", "suspect", 20), 2, ("tau_est_FR_thigh",)),
        ("steps", "qd_RR_calf", times(-1), ("sign", "bad", -1), 0.05, ("tau_est_RR_calf",)),
        ("steps", "imu_gyro_x", times(-1), ("sign", "bad", -1), 0.05, ()),
        ("steps", "tau_est_FL_thigh", times(-1), ("sign", "bad", -1), 0.05, ()),
    ],
)
def test_a_wrong_column_is_named_with_what_is_wrong_and_how_much(
    sound: str,
    column: str,
    damage: Callable[[np.ndarray], np.ndarray],
    finding: tuple[str, str, float],
    error: float,
    others: tuple[str, ...] | None,
) -> None:
    """``others`` are columns that may be named beside it; None: any."""
    recording = made(sound.removeprefix("real "))
    recording = realistic(recording) if sound.startswith("real ") else recording
    report = audit(with_(recording, **{column: damage(recording.channels[column])}))
    check, verdict, wrong_by = finding
    assert (check, column, verdict) in flaws(report)
    assert size(report, check, column) == pytest.approx(wrong_by, abs=error)
    assert others is None or {f.channel for f in report.flaws} <= {column, *others}


def test_a_quaternion_that_is_not_of_length_one_is_named() -> None:
    changed = {k: 0.9 * v for k, v in made().channels.items() if k.startswith("imu_quat")}
    report = audit(with_(made(), **changed))
    assert flaws(report) == {("norm", "imu_quat", "bad")}
    assert size(report, "norm", "imu_quat") == pytest.approx(0.1)


def test_noise_floors_are_measured_below_any_threshold() -> None:
    report = audit(realistic(made("slow_ramps")))
    floors = {c.name: c.noise for c in report.channels}
    assert floors["q_FL_hip"] == pytest.approx(3e-4, rel=0.1)
    assert floors["qd_FL_hip"] == pytest.approx(0.05, rel=0.1)


def frozen(recording: Recording, q: np.ndarray) -> list[float | None]:
    """For how long the audit calls the right rear thigh frozen, whose angle is ``q``, s; nothing if it does not."""
    report = audit(with_(recording, q_RR_thigh=q))
    assert all((f.channel, f.verdict) == ("q_RR_thigh", "bad") for f in report.by_check("frozen"))
    return [f.size for f in report.by_check("frozen")]


def held(q: np.ndarray) -> np.ndarray:
    return np.where(np.arange(ROWS) < ROWS // 2, q, q[ROWS // 2])


def test_an_angle_that_stops_being_read_is_frozen_and_one_that_leans_on_its_stop_is_not() -> None:
    recording = made("multisine")
    q = recording.channels["q_RR_thigh"]
    assert frozen(recording, held(q)) == [pytest.approx(recording.t[-1] - recording.t[ROWS // 2], abs=2e-3)]
    assert frozen(recording, q) == frozen(recording, np.clip(q, None, np.quantile(q, 0.3))) == []


def test_an_angle_that_rests_but_once_is_frozen_though_its_target_moves_little() -> None:
    sound = realistic(made("multisine"))
    middle = {name: sound.channels[name].mean() for name in ("q_RR_thigh", "q_target_RR_thigh")}
    recording = with_(sound, **{n: m + 0.3 * (sound.channels[n] - m) for n, m in middle.items()})
    assert 0.15 < np.ptp(recording.channels["q_target_RR_thigh"][ROWS // 2 :]) < 0.5
    q = held(recording.channels["q_RR_thigh"])
    assert frozen(recording, q)
    sticking = np.repeat(q[:: ROWS // 12], ROWS // 12 + 1)[:ROWS]  # as a soft servo with a coarse encoder
    assert frozen(recording, sticking) == []


def test_a_sensor_that_saturates_is_named() -> None:
    report = audit(with_(made(), imu_gyro_y=np.clip(made().channels["imu_gyro_y"], -0.6, 0.6)))
    assert ("saturation", "imu_gyro_y", "bad") in flaws(report)
    assert "0.6" in next(f.message for f in report.by_check("saturation"))
    share = np.mean(np.abs(made().channels["imu_gyro_y"]) > 0.6)
    assert size(report, "saturation", "imu_gyro_y") == pytest.approx(share, rel=0.05)


def test_a_drive_at_its_limit_is_a_fact_and_below_it_a_flaw() -> None:
    report = audit(made(limit=0.3))
    at_limit = [f for f in report.by_check("saturation") if f.verdict == "ok"]
    assert len(at_limit) >= 3
    assert "the actuator's limit" in at_limit[0].message
    assert report.flaws == []
    report = audit(about(made(limit=0.3), tau_limit=META.tau_limit))
    assert {f.check for f in report.flaws} == {"saturation"}
    assert all("sticks at" in f.message and ", but the limit is " in f.message for f in report.flaws)
    assert any("7.11 N m" in f.message and "the limit is 23.7 N m" in f.message for f in report.flaws)


# ---------------------------------------------------------------------- units, limits


@pytest.mark.parametrize("robot", ["go1", "other"])
@pytest.mark.parametrize("name", ["q_FL_calf", "q_target_FL_calf"])
def test_degrees_are_recognised(robot: str, name: str) -> None:
    sound = about(made(), robot=robot)
    report = audit(with_(sound, **{name: np.degrees(sound.channels[name])}))
    assert ("units", name, "bad") in flaws(report)
    assert "degrees" in next(f.message for f in report.by_check("units") if f.channel == name)


@pytest.mark.parametrize("late", [0.016, 1 / 49])
def test_a_speed_that_is_a_sample_late_is_found_on_a_slow_log(late: float) -> None:
    """At 49 Hz a sample is 20 ms: a servo's speed that is that late must not pass as if read at the same time."""
    quick, t = made("gait", rate=1000.0), np.arange(round(49 * (SECONDS - 0.1))) / 49
    channels = {k: np.interp(t, quick.t, v) for k, v in quick.channels.items() if k.startswith(("q_", "qd_"))}
    sound = Recording(replace(META, rate_hz=49.0), {"t": t, **channels})
    assert [f for f in audit(sound).flaws if f.check == "lag"] == []
    speed = np.interp(t - late, quick.t, quick.channels["qd_FR_thigh"])
    report = audit(with_(sound, qd_FR_thigh=speed))
    assert ("lag", "qd_FR_thigh", "suspect") in flaws(report)
    assert size(report, "lag", "qd_FR_thigh") == pytest.approx(1e3 * late, abs=2)


@pytest.mark.parametrize(
    ("matrix", "check", "size", "what"),
    [
        (np.eye(3) / 9.81, "units", 1.0, "it looks like g "),
        (0.8 * np.eye(3), "gravity", 0.8 * 9.81, "gravity is 9.81"),
        (-np.eye(3), "gravity", 180.0, "sign is flipped"),
        (np.eye(3)[::-1], "gravity", 90.0, "axes or quaternion order"),
    ],
    ids=["unit", "scale", "sign", "axes"],
)
def test_the_accelerometers_unit_sign_and_axes_are_checked(
    matrix: np.ndarray, check: str, size: float, what: str
) -> None:
    names = VECTORS["imu_acc"]
    report = audit(with_(made(), **columns(names, made().block(*names) @ matrix)))
    (flaw,) = report.flaws
    assert (flaw.check, flaw.channel, flaw.verdict) == (check, "imu_acc", "bad")
    assert flaw.size == pytest.approx(size, rel=0.02, abs=15 if size > 50 else 0)
    assert what in flaw.message
    assert all(c.verdict == "bad" for c in report.channels if c.name in names)


def test_joints_beyond_their_stops_and_torques_beyond_their_limits_are_found() -> None:
    changed = with_(made(), q_FR_calf=made().channels["q_FR_calf"] + 0.4)
    (flaw,) = audit(changed).by_check("limits")
    assert (flaw.channel, flaw.verdict) == ("q_FR_calf", "suspect")
    assert flaw.size == pytest.approx(changed.channels["q_FR_calf"].max() + 0.888, rel=1e-6)
    assert audit(Recording(replace(META, robot="other"), changed.channels)).by_check("limits") == []
    report = audit(with_(made(), tau_est_FL_hip=10 * made().channels["tau_est_FL_hip"]))
    assert ("limits", "tau_est_FL_hip", "bad") in flaws(report)


# ---------------------------------------------------------------------- sign and order


def test_a_joint_of_wrong_sign_is_named() -> None:
    for name in ("steps", "multisine", "gait"):
        sound = made(name)
        report = audit(with_(sound, q_FL_hip=-sound.channels["q_FL_hip"], qd_FL_hip=-sound.channels["qd_FL_hip"]))
        assert ("sign", "q_FL_hip", "bad") in flaws(report)
        assert {f.channel for f in report.flaws} <= {"q_FL_hip", "qd_FL_hip", "tau_est_FL_hip"}


def test_rows_that_arrive_in_bursts_are_bad_and_no_delay_is_told_from_them() -> None:
    """The grid of delays is as fine as half a step: microseconds of a whole log would fill the memory."""
    sound = made("multisine")
    burst, place = np.divmod(np.arange(len(sound.t)), 3)
    report = audit(replace(sound, channels=sound.channels | {"t": sound.t[3 * burst] + 1e-9 * place}))
    assert [f.verdict for f in report.by_check("rate")] == ["bad"]
    assert report.by_check("delay") == []


@pytest.mark.parametrize(
    ("name", "factor", "verdict"),
    [
        ("q", 1.0, ()),
        ("q", 180 / np.pi, ("bad",)),
        ("q", np.pi / 180, ("suspect",)),
        ("q_target", np.pi / 180, ("bad",)),
    ],
)
def test_an_angle_in_another_unit_than_its_target_is_named(name: str, factor: float, verdict: tuple[str, ...]) -> None:
    sound = made("multisine")
    small = 0.1 if factor > 1.0 else 1.0  # so that no angle is too large for radians
    channels = {
        k: small * (sound.channels[f"{k}_FL_hip"] - sound.channels[f"{k}_FL_hip"][0]) for k in ("q", "q_target")
    }
    channels[name] = factor * channels[name]
    arm = Recording(
        replace(META, **ARM, joints=("hip",)), {"t": sound.t} | {f"{k}_hip": v for k, v in channels.items()}
    )
    assert [(f.channel, f.verdict) for f in audit(arm).by_check("units")] == [("q_hip", v) for v in verdict]


RIGHT, LEFT = (tuple(f"{leg}_{kind}" for kind in ("hip", "thigh", "calf")) for leg in ("FR", "FL"))


@pytest.mark.parametrize(
    ("name", "quantities", "theirs", "named", "message"),
    [
        ("steps", ("q", "qd", "tau_est"), RIGHT + LEFT, LEFT + RIGHT, "FR_thigh and FL_thigh are swapped"),
        ("multisine", ("q", "qd", "tau_est"), RIGHT + LEFT, LEFT + RIGHT, "FR_thigh and FL_thigh are swapped"),
        ("multisine", ("q", "qd"), RIGHT, RIGHT[1:] + RIGHT[:1], "what is called FR_hip is the joint it moves"),
        ("multisine", ("qd",), ("FR_hip", "RL_calf"), ("RL_calf", "FR_hip"), "is the speed of q_RL_calf"),
        ("steps", ("imu_gyro",), ("x", "y"), ("y", "x"), "follows the y axis of imu_quat"),
    ],
    ids=["legs in steps", "legs", "three joints", "speeds", "axes"],
)
def test_columns_by_one_anothers_names_are_named(
    name: str, quantities: tuple[str, ...], theirs: tuple[str, ...], named: tuple[str, ...], message: str
) -> None:
    c = made(name).channels
    pairs = zip(theirs, named, strict=True)
    changed = {f"{q}_{a}": c[f"{q}_{b}"] for a, b in pairs for q in quantities}
    orders = {f.channel: f.message for f in audit(with_(made(name), **changed)).by_check("order")}
    said = "q_target" if quantities[0] == "q" else quantities[0]
    assert set(orders) == {f"{said}_{a}" for a in theirs}
    assert any(message in text for text in orders.values())


def test_a_trunk_that_turns_less_than_its_attitude_is_noisy_says_nothing_of_a_gyroscope() -> None:
    """Noise of what a gyroscope is compared with makes its factor too small: 0.5 in squats that hardly pitch."""
    rng, t = np.random.default_rng(0), made().t
    omega, amplitude, still = 2 * np.pi * 3, 2.6e-3, np.zeros(ROWS)
    pitch = amplitude * np.sin(omega * t)
    quat = dict(zip("wyxz", (np.cos(pitch / 2), np.sin(pitch / 2), still, still), strict=True))
    changed = {f"imu_quat_{k}": v + 5e-4 * rng.standard_normal(ROWS) for k, v in quat.items()}
    changed |= {"imu_gyro_x": still, "imu_gyro_z": still}
    changed["imu_gyro_y"] = amplitude * omega * np.cos(omega * t) + 1e-3 * rng.standard_normal(ROWS)
    assert not audit(with_(made(), **changed)).by_check("scale")


# ---------------------------------------------------------------------- delay


@pytest.mark.parametrize("name", ["steps", "multisine"])
@pytest.mark.parametrize("delay", [0.0, 0.007, 0.020])
def test_the_delay_from_command_to_answer_is_measured(name: str, delay: float) -> None:
    report = audit(realistic(made(name, delay)))
    pairs = {c.name: (c.delay_ms, c.delay_sd_ms) for c in report.channels}
    measured = {c: (ms, sd) for c, (ms, sd) in pairs.items() if ms is not None and sd is not None}
    assert len(measured) >= 10
    assert all(sd < 2 and abs(ms - 1e3 * delay) < min(1.5, 4 * sd) for ms, sd in measured.values())
    late = {f.channel for f in report.by_check("delay") if f.verdict == "suspect"}
    assert late == (set(measured) if delay > 0.01 else set())
    assert not late or all("delay or clock offset" in f.message for f in report.by_check("delay"))
    assert {f.check for f in report.flaws} <= {"delay"}


def test_one_late_joint_is_named() -> None:
    sound, late = made("multisine"), made("multisine", 0.007)
    changed = {k: late.channels[k] for k in ("q_RL_hip", "qd_RL_hip", "tau_est_RL_hip")}
    report = audit(with_(sound, **changed))
    assert flaws(report) == {("delay", "q_RL_hip", "suspect")}
    assert size(report, "delay", "q_RL_hip") == pytest.approx(7, abs=0.5)


def test_an_answer_before_the_command_is_named() -> None:
    sound = made("multisine")
    late = {k: np.roll(v, 10, axis=0) for k, v in sound.channels.items() if k.startswith("q_target")}
    report = audit(with_(sound, **late))
    flaws = [f for f in report.by_check("delay") if f.verdict == "suspect"]
    assert len(flaws) >= 10
    assert all("before it is given" in f.message for f in flaws)
    assert np.median([f.size or 0 for f in flaws]) == pytest.approx(-20, abs=0.5)


def test_where_the_delay_cannot_be_told_none_is_given() -> None:
    report = audit(made("drop"))
    assert all(c.delay_ms is None for c in report.channels)
    assert report.by_check("delay") == []


# ---------------------------------------------------------------------- several recordings together


def late(name: str, rows: int) -> Recording:
    moved = {c: np.roll(v, rows) for c, v in made(name).channels.items() if c.startswith("q_target")}
    return with_(made(name), **moved)


@cache
def report_of_late(name: str, rows: int) -> AuditReport:
    return audit(late(name, rows))


@pytest.mark.parametrize(
    ("rows", "drop", "named", "line"),
    [
        ((0, 0, 0, 0), False, [], ""),
        ((-10, -10), True, [], ""),
        ((), True, [], ""),
        ((), False, [], ""),
        ((0, 0, 10, 0), False, ["e2"], r"joints answer their commands after -2\d.* \(e2\), -?\d.* ms in the others: "),
        ((-20, 0, 15, -8), True, ["e0", "e1", "e2", "e3", "e4"], r".*\(e2\) to.* have clocks of their own$"),
        ((10, 10, 10), False, ["e0", "e1", "e2"], ""),
    ],
    ids=["one clock", "all late", "no delay", "nothing", "one of them apart", "each its own", "after the answer"],
)
def test_recordings_are_named_whose_commands_have_another_clock(
    rows: tuple[int, ...], drop: bool, named: list[str], line: str
) -> None:
    """Of motions in turn whose commands were logged so many rows late, and of one that shows no delay."""
    reports = [report_of_late(("steps", "multisine")[k % 2], n) for k, n in enumerate(rows)]
    reports += [report_of_late("drop", 0)] * drop
    apart = clock_flaws([replace(r, episode=f"e{k}") for k, r in enumerate(reports)])
    assert list(apart) == named
    assert all(re.match(line, text) for text in apart.values())


def test_audit_of_folders_takes_their_clocks_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As gap does; recordings of one name are told apart by their files, and each has its own figure."""
    for k, rows in enumerate((0, 0, 20, 20)):
        recording = about(late(("steps", "multisine")[k % 2], rows), episode="one")
        write(tmp_path / ("day1" if k < 2 else "day2") / f"run_{k}.parquet", recording)
    out = tmp_path / "reports" / "audit.json"
    assert AUDIT.run([f"files=[{tmp_path / 'day1'},{tmp_path / 'day2'}]", f"out={out}"]) == 4
    flawed = [Path(file).stem for file, report in json.loads(out.read_text()).items() if "clocks" in report]
    assert flawed == ["run_0", "run_1", "run_2", "run_3"]
    said = [line for line in capsys.readouterr().out.splitlines() if ": bad beside the others: joints answer" in line]
    assert [re.findall(r"commands after (-?\d+)", line)[0] for line in said] == ["-0", "-0", "-40", "-40"]


def test_logs_of_different_clocks_are_named_with_their_rates() -> None:
    r = made("steps")
    slow = replace(r, channels={name: values[::2] for name, values in r.channels.items()})
    late = with_(r, t=r.t + 1.7e9)
    reports = [replace(audit(x), episode=name) for x, name in ((r, "a"), (slow, "b"), (r, "c"), (late, "d"))]
    said = clock_kinds(reports)
    assert re.match(r"The logs have different clocks: a, c: \S+ Hz, [^;]*; b: \S+ Hz, [^;]*; d: .* since 1970\.$", said)
    assert clock_kinds([reports[0], reports[2]]) == ""


# ---------------------------------------------------------------------- the report


def test_stretches_without_drives_and_at_rest_are_listed() -> None:
    recording = made("torque_off")
    report = audit(recording)
    off = ~recording.channels["torque_enable"]
    assert sum(b - a for a, b in report.torque_off) == pytest.approx(off.sum() / RATE, abs=0.01)
    assert len(report.torque_off) >= 2
    frozen = {k: np.where(np.arange(ROWS) < 1000, v[0], v) for k, v in made("chirp").channels.items() if k[:2] == "q_"}
    (still,) = audit(with_(made("chirp"), **frozen)).still
    assert still[0] == 0
    assert 1.85 < still[1] < 2.05


def test_the_report_reads_well_and_survives_json() -> None:
    report = audit(with_(made(), qd_FR_hip=-made().channels["qd_FR_hip"]))
    text = report.text()
    assert text.startswith("synthetic: bad\n3000 samples, 6.00 s at 500 Hz; ")
    assert "bad      sign        qd_FR_hip: goes against the change of q_FR_hip" in text
    assert len([line for line in text.splitlines() if line.startswith("q_FL_calf ")]) == 1
    assert all(len(line.rstrip()) == len(line) for line in text.splitlines())
    back = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert back["verdict"] == "bad"
    assert len(back["channels"]) == len(report.channels)
    assert back["findings"][0]["channel"] in text


def test_what_breaks_the_format_is_reported_not_raised() -> None:
    report = audit(with_(made(), q_FR_hip=at(made().channels["q_FR_hip"], 7, np.nan)))
    assert (report.verdict, flaws(report)) == ("bad", {("format", "q_FR_hip", "bad")})
    assert ("format", "t", "bad") in flaws(audit(with_(made(), t=at(made().t, 100, made().t[99]))))
    assert "too few" in audit(rows(made(), slice(5))).text()
    for broken in ({}, {"t": np.zeros(0)}, {"t": np.zeros((2, 2))}):
        assert audit(Recording(META, broken)).verdict == "bad"
        assert audit(Recording(META, broken)).text()


@pytest.mark.parametrize("length", [20, 49, 60, 120, 400, 1100, 2000])
@pytest.mark.parametrize("name", ["gait", "slow_ramps", "squat"])
def test_short_recordings_are_no_problem(name: str, length: int) -> None:
    """Little motion must not be taken for a wrong sign, order, scale or delay."""
    report = audit(Recording(META, {k: v[:length] for k, v in realistic(made(name)).channels.items()}))
    assert [f for f in report.flaws if f.check != "still"] == []


# ---------------------------------------------------------------------- real recordings


def imported(importer: str, path: str = "") -> Recording:
    from go1exp.logs.importers import import_recordings

    (recording,) = import_recordings(importer, real(importer) / path, {})
    return recording


def encoder_steps(report: AuditReport, prefix: str) -> list[float]:
    return [c.step for c in report.channels if c.name.startswith(prefix) and c.step]


def test_the_go2_reports_speeds_that_are_too_large() -> None:
    recording = imported("go2_in_air")
    report = audit(recording)
    assert flaws(report) == {("scale", name, "suspect") for name in joint_channels("qd", recording.meta.joints)}
    sizes = [f.size or 0 for f in report.by_check("scale")]
    assert 1.10 < min(sizes) < max(sizes) < 1.18  # its README says 1.11 to 1.17
    for step in encoder_steps(report, "q_"):
        assert step == pytest.approx(2 * np.pi / 32768 / 6.33, rel=2e-3)


def test_scaler_reports_speeds_that_are_too_large_and_late() -> None:
    recording = imported("scaler_walk_mocap", "run_15.npz")
    speed = np.load(real("scaler_walk_mocap/run_15.npz"), allow_pickle=False)["joint_vel"].reshape(-1, 12)
    names = joint_channels("qd", recording.meta.joints)  # left out by the importer, for this very flaw
    report = audit(with_(recording, **dict(zip(names, np.ascontiguousarray(speed.T), strict=True))))
    assert {f.channel for f in report.by_check("scale") if f.verdict == "bad"} == set(names)
    sizes = [f.size or 0 for f in report.by_check("scale")]
    assert 1.5 < min(sizes) < max(sizes) < 1.85  # its README says 1.5 to 1.7
    assert {f.channel for f in report.by_check("lag")} == set(names)
    assert {f.channel for f in report.by_check("repeats")} >= set(joint_channels("q", recording.meta.joints))
    assert report.by_check("order") == []


@pytest.mark.parametrize("design", ["design_A_0", "design_C_0"])
def test_the_ak80s_messages_are_recognised(design: str) -> None:
    recording = imported("ak80_double_pendulum", f"{design}/trajectory_00.npz")
    report = audit(recording)
    np.testing.assert_allclose(encoder_steps(report, "q_"), [3.8147e-4] * 2, rtol=1e-3)
    np.testing.assert_allclose(encoder_steps(report, "tau_est"), [5.8608e-3] * 2, rtol=1e-3)
    assert {"T-Motor" in f.message for f in report.by_check("resolution")} == {True}


def test_a_real_go1_snippet_is_sound() -> None:
    assert audit(imported("go1_walk_snippet")).flaws == []


def trotting(
    order: tuple[int, ...] = tuple(range(12)), flip: int | None = None, against: tuple[int, ...] = (2,)
) -> Recording:
    """Joints of a trot, legs in antiphase, under the PD law and a load that turns some joints against their targets."""
    t = made().t
    phase = np.repeat([0.0, np.pi, np.pi, 0.0], 3)
    target = NOMINAL_STANCE + 0.3 * np.sin(2 * np.pi * 2.0 * t[:, None] + phase)
    q = NOMINAL_STANCE + 0.27 * np.sin(2 * np.pi * 2.0 * (t[:, None] - 0.03) + phase)
    for j in against:
        q[:, j] = NOMINAL_STANCE[j] - 0.24 * np.sin(2 * np.pi * 2.0 * t + phase[j])
    q += 0.03 * np.sin(2 * np.pi * 3.3 * t[:, None] + np.arange(12.0))
    qd = np.gradient(q, t, axis=0)
    tau = 20.0 * (target - q) - 0.5 * qd
    sign = np.where(np.arange(12) == flip, -1.0, 1.0)
    q, qd, tau = (x[:, list(order)] for x in (sign * q, sign * qd, tau))
    return with_(made(), **by_joint(q=q, qd=qd, tau_est=tau, q_target=target))


def test_a_joint_that_load_moves_against_its_target_has_no_flipped_sign() -> None:
    assert audit(trotting()).by_check("sign") == []
    assert {f.channel for f in audit(trotting(flip=5)).by_check("sign")} == {f"q_{JOINTS[5]}"}


def test_two_legs_that_load_moves_against_their_targets_are_not_swapped() -> None:
    assert audit(trotting(against=(1, 4))).by_check("order") == []


def test_another_order_of_legs_in_antiphase_is_an_order_and_no_sign() -> None:
    report = audit(trotting(order=(3, 4, 5, 0, 1, 2, 6, 7, 8, 9, 10, 11)))
    named = {f.channel for f in report.by_check("order")}
    assert {f"q_target_{j}" for j in JOINTS[:2]} <= named
    assert not {f.channel for f in report.by_check("sign")} & {f"q_{j}" for j in (*JOINTS[:2], *JOINTS[3:5])}


def test_the_mean_of_an_accelerometer_in_motion_is_gravity_however_hard_the_feet_land() -> None:
    r = made("steps")
    t = r.t
    shocks = 40.0 * np.sign(np.sin(2 * np.pi * 40.0 * t))
    report = audit(with_(r, imu_acc_z=r.channels["imu_acc_z"] + shocks))
    assert report.by_check("gravity") == []
    assert audit(with_(r, imu_acc_z=1.4 * (r.channels["imu_acc_z"] + shocks))).by_check("gravity")


def test_a_step_of_a_speed_is_not_called_by_the_name_of_a_torques() -> None:
    coarse = {c: np.round(made().channels[c] * 256) / 256 for c in ("qd_FR_hip", "tau_est_FR_hip")}
    messages = {f.channel: f.message for f in audit(with_(made(), **coarse)).by_check("resolution")}
    assert "1/256 N m" in messages["tau_est_FR_hip"]
    assert "N m" not in messages["qd_FR_hip"]


def test_rows_that_their_neighbours_rule_out_are_named_and_left_out() -> None:
    r = realistic(made("steps"))
    lost, early = np.isin(np.arange(ROWS), [300, 900, 901, 1700]), np.arange(ROWS) < 800
    zeros = with_(r, **{c: np.where(lost, 0.0, r.channels[c]) for c in joint_channels("q", JOINTS)})
    single = lost & ((r.t < 1.0) | (r.t > 3.0))
    near = r.channels["q_FR_hip"] - r.channels["q_FR_hip"][single].mean() + 0.02  # rad, nearly zero there
    alone = replace(r.meta, joints=JOINTS[:1], kp=(20.0,), kd=(0.5,), tau_limit=None)
    one = Recording(alone, {"t": r.t, "q_FR_hip": np.where(single, 0.0, near)})
    spiked = with_(r, q_FR_hip=r.channels["q_FR_hip"] + 0.3 * lost)
    wrapped = with_(r, q_FL_calf=r.channels["q_FL_calf"] + np.where(early, 2 * np.pi, 0.0))
    for recording, wrong in ((one, single), (zeros, lost), (spiked, lost), (wrapped, early)):
        np.testing.assert_array_equal(impossible(recording).rows, wrong)
    assert impossible(r).findings == ()
    assert {f.channel for f in impossible(spiked).findings} == {"q_FR_hip"}
    assert len(without(zeros, lost).t) == ROWS - 4
    report = audit(zeros)
    assert report.impossible == (300, 900, 901, 1700)
    assert {f.check for f in report.flaws} == {"impossible"}


@pytest.mark.parametrize(("rate", "spike"), [(100.0, 0.15), (500.0, 0.02)])
def test_zeros_and_spikes_of_one_channel_are_found_and_sound_rows_beside_them_are_kept(
    rate: float, spike: float
) -> None:
    noise, t = np.random.default_rng(3), np.arange(3000) / rate
    q = 0.5 * np.sin(2 * np.pi * 0.7 * t) + 0.2 * np.sin(2 * np.pi * 2.3 * t) + 2e-4 * noise.standard_normal(len(t))
    sound = Recording(made_meta(("knee", "hip"), robot="bench", rate_hz=rate), {"t": t, "q_knee": q, "q_hip": q + 1.0})
    lost = noise.random(len(t)) < 0.01
    assert not impossible(sound).rows.any()
    found = impossible(with_(sound, q_knee=np.where(lost, 0.0, q)))
    assert np.abs(q[lost & ~found.rows]).max(initial=0.0) < 0.01
    assert (found.rows & ~lost).sum() <= 2
    assert "are zeros between values far from zero" in found.findings[0].message
    found = impossible(with_(sound, q_knee=np.where(lost, q + spike, q)))
    assert (found.rows & lost).sum() >= 0.6 * lost.sum()


def _written(r: Recording, wrong: str) -> dict[str, np.ndarray]:
    """Columns of the joint FR_hip as a faulty logger computes them."""
    q, target, qd = (r.channels[f"{kind}_FR_hip"] for kind in ("q", "q_target", "qd"))
    step = np.diff(q) / np.diff(r.t)
    law = 20.0 * (target - q) - 0.5 * qd
    commands = {c.replace("est", "cmd"): r.channels[c].copy() for c in TORQUES}
    return {
        "target": {"q_target_FR_hip": q.copy()},
        "target next": {"q_target_FR_hip": np.append(q[1:], 0.0)},
        "target in degrees": {"q_target_FR_hip": np.degrees(q)},
        "target by half": {"q_target_FR_hip": np.where(np.arange(ROWS) < 1500, q, target)},
        "angle": {"q_FR_hip": r.channels["q_FL_thigh"].copy()},
        "difference": {"qd_FR_hip": np.append(0.0, step)},
        "difference about the row": {"qd_FR_hip": np.gradient(q, r.t)},
        "difference of three": {"qd_FR_hip": np.append(np.zeros(3), 0.5 * (step[1:-1] + step[:-2]))},
        "torque": commands,
        "torque late": {c: np.append(values[1:], 0.0) for c, values in commands.items()},
        "torque of a constant": {c: 1.7 * values for c, values in commands.items()},
        "law": {"tau_est_FR_hip": np.clip(law, *np.quantile(law, (0.05, 0.95)))},
    }[wrong]


@pytest.mark.parametrize(
    ("wrong", "column", "verdict"),
    [
        *((f"target{how}", "q_target_FR_hip", "bad") for how in ("", " next", " in degrees", " by half")),
        ("angle", "q_FR_hip", "bad"),
        *((f"difference{how}", "qd_FR_hip", "suspect") for how in ("", " about the row", " of three")),
        *((wrong, "tau_est_FR_hip", "suspect") for wrong in ("torque", "torque late", "torque of a constant", "law")),
    ],
)
def test_a_column_that_holds_another_quantity_is_named(wrong: str, column: str, verdict: str) -> None:
    sound = realistic(made("gait"))
    found = {f.channel: f for f in copies(Log(with_(sound, **_written(sound, wrong))))}
    assert found[column].verdict == verdict
    assert "%" in found[column].message
    assert "torque" in wrong or set(found) == {column}


@pytest.mark.parametrize(("late", "decimals"), [(0, 3), (1, 3), (2, 3), (2, 9)])
def test_a_target_that_is_a_rounded_or_earlier_angle_is_named(late: int, decimals: int) -> None:
    sound = realistic(made("multisine"))
    target = np.round(np.roll(sound.channels["q_FR_hip"], late), decimals)
    (found,) = copies(Log(with_(sound, q_target_FR_hip=target)))
    assert (found.channel, found.verdict) == ("q_target_FR_hip", "bad")


@pytest.mark.parametrize("behind", [0.0005, 0.002, 0.02])
@pytest.mark.parametrize("rate", [50.0, 500.0])
def test_a_joint_that_follows_a_rounded_target_at_once_is_no_copy(rate: float, behind: float) -> None:
    """Without noise, and half a millisecond to a row behind."""
    sound = bench(rate)
    target, q = (0.5 * np.sin(4.4 * s) + 0.2 * np.sin(14.5 * s) for s in (sound.t, sound.t - behind))
    for decimals in (2, 3, 4):
        assert not list(copies(Log(with_(sound, q_knee=q, q_target_knee=np.round(target, decimals)))))


def test_what_follows_closely_and_what_is_ideal_is_no_copy() -> None:
    """Another sensor of the same quantity has noise of its own; in an ideal simulation columns agree."""
    sound, ideal = realistic(made("gait")), made("gait")
    rng = np.random.default_rng(3)
    follows = {c.replace("est", "cmd"): sound.channels[c] + rng.normal(0.0, 0.03, ROWS) for c in TORQUES}
    assert not list(copies(Log(with_(sound, **follows))))
    equal = {c.replace("est", "cmd"): ideal.channels[c].copy() for c in TORQUES}
    slopes = {c.replace("q_", "qd_"): np.gradient(ideal.channels[c], ideal.t) for c in joint_channels("q", JOINTS)}
    assert all(f.verdict == "ok" for f in copies(Log(with_(ideal, **equal, **slopes))))


def bench(rate: float = 200.0) -> Recording:
    """A joint that follows sines by 20 ms, with noise of all its sensors."""
    rng, t = np.random.default_rng(3), np.arange(round(8 * rate)) / rate
    target, q = (0.5 * np.sin(4.4 * s) + 0.2 * np.sin(14.5 * s) for s in (t, t - 0.02))
    noise = rng.standard_normal((3, len(t)))
    channels = {"t": t, "q_target_knee": target, "q_knee": q + 2e-4 * noise[0]}
    channels |= {"qd_knee": np.gradient(q, t) + 0.02 * noise[1], "tau_est_knee": np.cos(4.4 * t) + 0.1 * noise[2]}
    return Recording(made_meta(("knee",), robot="bench", rate_hz=rate), channels)


def test_spikes_of_a_hundredth_of_the_rows_on_one_side_are_found_in_torques() -> None:
    sound = bench()
    wrong = np.random.default_rng(1).random(len(sound.t)) < 0.009
    spiked = with_(sound, tau_est_knee=sound.channels["tau_est_knee"] + 30.0 * wrong)
    assert not impossible(sound).rows.any()
    assert (impossible(spiked).rows & wrong).sum() >= 0.9 * wrong.sum()
    assert {f.channel for f in impossible(spiked).findings} == {"tau_est_knee"}


@pytest.mark.parametrize(("channel", "whole"), [("q_knee", 0.9), ("q_knee", 2 * np.pi), ("qd_knee", 6.0)])
def test_a_counter_that_wraps_is_called_so_with_its_range_and_no_sign_is_called_flipped(
    channel: str, whole: float
) -> None:
    zero = np.pi if whole > 6.1 else 0.0
    x = bench().channels[channel] + zero
    sound = with_(bench(), **{channel: x, "q_target_knee": bench().channels["q_target_knee"] + zero})
    assert {f.check for f in audit(sound).flaws} == {"delay"}  # of 31 ms
    wrapped = (x + whole / 2) % whole - whole / 2
    turns = np.round((x - wrapped) / whole)
    report = audit(with_(sound, **{channel: wrapped}))
    assert {f.check for f in report.flaws} <= {"impossible", "delay"}
    (found,) = report.by_check("impossible")
    assert found.channel == channel
    assert found.size == pytest.approx(1 - np.unique(turns, return_counts=True)[1].max() / len(x))
    (size,) = re.findall(r"wraps at its range of (\S+) rad", found.message)
    assert float(size) == pytest.approx(whole, rel=0.02)


def test_an_offset_and_readings_that_are_off_by_one_size_are_no_counter_that_wraps() -> None:
    q = bench().channels["q_knee"]
    for wrong in (np.arange(len(q)) < 500, np.isin(np.arange(len(q)), [300, 301, 302, 900, 901])):
        found = impossible(with_(bench(), q_knee=q + 6.0 * wrong)).findings
        assert found
        assert not any("counter" in f.message for f in found)


@pytest.mark.parametrize("held", [1, 10])
def test_targets_that_leave_for_a_row_are_found_where_none_could_be_commanded(held: int) -> None:
    sound = bench(500.0)
    target = np.repeat(sound.channels["q_target_knee"][::held], held)
    wrong = np.random.default_rng(1).random(len(target)) < 0.01
    found = impossible(with_(sound, q_target_knee=target + 0.3 * wrong))
    assert (found.rows & wrong).sum() >= 0.8 * wrong.sum()
    assert not (found.rows & ~wrong).any()
    assert [f.channel for f in found.findings] == ["q_target_knee"]
    # Such commands may be given: then the actuator answers them.
    answer = sound.channels["tau_est_knee"] + 2.0 * np.roll(wrong, 2)
    obeyed = impossible(with_(sound, q_target_knee=target + 0.3 * wrong, tau_est_knee=answer))
    assert not any(f.channel == "q_target_knee" for f in obeyed.findings)


def test_targets_of_a_policy_that_step_at_every_row_are_sound() -> None:
    sound, rng = bench(50.0), np.random.default_rng(0)
    steps = 0.3 * rng.standard_normal(len(sound.t))
    late = np.clip(np.repeat(steps, 10)[: len(bench(500.0).t)], -0.4, 0.4)
    late[1999] = late[2000]  # a command that came a row early
    assert not impossible(with_(sound, q_target_knee=steps)).rows.any()
    assert not impossible(with_(bench(500.0), q_target_knee=late)).rows.any()


def test_a_speed_that_an_impact_turns_within_a_row_is_no_spike_where_the_angle_shows_it() -> None:
    sound = bench(500.0)
    q = sound.channels["q_knee"] + 3e-4 * np.random.default_rng(4).standard_normal(4000)
    qd = sound.channels["qd_knee"].copy()
    for k in range(60, 4000, 100):
        qd[k] += 0.6
        q[k:] += 0.6 * 0.002 / 2
        q[k + 1 :] += 0.6 * 0.002 / 2
    assert not impossible(with_(sound, q_knee=q, qd_knee=qd)).rows.any()
