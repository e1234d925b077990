"""Check of a Go1 at rest: ``check=true``, and the same before every walk.

Only packets without torque are sent (``go1_wire.IDLE``): the robot answers only to a client that sends.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from go1exp.deploy.estimation import FilterConfig
from go1exp.deploy.estimation.feet import FootCalibration, calibrated, forces_by_torque, kinematics, vertical
from go1exp.deploy.runtime import go1_wire
from go1exp.deploy.runtime.safety import SafetyConfig, tilt_angle
from go1exp.deploy.runtime.udp import Go1Link, delays, spread
from go1exp.robot.go1_fields import PERIOD
from go1exp.robot.messages import LowState

SECONDS = 2.0
"""Duration, s."""

TICKS_S = (0.001, 0.000001, 0.002)
"""Possible units of the robot's tick, s: two comments of the SDK, and one tick a packet."""


@dataclass(frozen=True)
class Bounds:
    """Limits for a robot at rest (chosen, except those of ``SafetyConfig``).

    Attributes:
        rate: least packets per second; a Go1 sends 500.
        gap: longest time between two packets, s.
        refused: largest share of rejected packets.
        charge: least charge of the battery, percent.
        motor: highest temperature of a motor, degrees Celsius.
        velocity: largest joint velocity, rad/s.
        gravity: largest difference of the accelerometer from 9.81, m/s2.
        tilt: largest tilt of the trunk, rad.
    """

    rate: float = 400.0
    gap: float = SafetyConfig.stale
    refused: float = 0.01
    charge: int = 20
    motor: int = 65
    velocity: float = 1.0
    gravity: float = 1.0
    tilt: float = 0.5


@dataclass
class Observed:
    """States of a robot at rest.

    Attributes:
        seconds: duration, s.
        states: in the order of arrival.
        ticks: tick and time of arrival, s, of the last state of each reading of the socket.
        health: of the last packet; None without any.
    """

    seconds: float = 0.0
    states: list[LowState] = field(default_factory=list)
    ticks: list[tuple[int, float]] = field(default_factory=list)
    health: go1_wire.Health | None = None

    def mean(self, name: str) -> np.ndarray:
        """Return the mean of a field over all states."""
        return np.mean([getattr(state, name) for state in self.states], axis=0)

    @property
    def intervals(self) -> np.ndarray:
        """Times between arrivals, s."""
        return np.diff([state.t for state in self.states])

    @property
    def tick_s(self) -> float:
        """Measured unit of the robot's tick, s; NaN if it is none of ``TICKS_S``."""
        if len(self.ticks) < 2:
            return math.nan
        (first, begin), (last, end) = self.ticks[0], self.ticks[-1]
        ticks = go1_wire.newer(last, first)
        seconds = (end - begin) / ticks if ticks > 0 else math.nan
        return next((unit for unit in TICKS_S if abs(seconds / unit - 1.0) < 0.1), math.nan)

    @property
    def delays(self) -> np.ndarray:
        """Delays of the packets in ``ticks`` relative to the fastest, s; NaN if the unit of the tick is unknown."""
        clock = [go1_wire.newer(tick, self.ticks[0][0]) * self.tick_s for tick, _ in self.ticks]
        return delays([arrived for _, arrived in self.ticks], clock)


def listen(link: Go1Link, seconds: float) -> Observed:
    """Receive states for ``seconds`` s; no torque is commanded."""
    observed, begin = Observed(), time.perf_counter()
    while time.perf_counter() - begin < seconds:
        states = link.receive()
        if states:
            observed.states.extend(states)
            observed.ticks.append((link.tick or 0, states[-1].t))
        time.sleep(PERIOD)
    observed.seconds = time.perf_counter() - begin
    observed.health = link.health
    return observed


@dataclass(frozen=True)
class Findings:
    """Findings about a robot.

    Attributes:
        lines: for the terminal.
        problems: reasons against a walk; empty if one may begin.
        tick_s: unit of its tick, s; NaN if unknown.
        counts: (4,) mean of the feet's sensors.
        by_torque: (4,) vertical forces that balance the joints' torques, N.
    """

    lines: tuple[str, ...]
    problems: tuple[str, ...]
    tick_s: float = math.nan
    counts: np.ndarray = field(default_factory=lambda: np.zeros(4))
    by_torque: np.ndarray = field(default_factory=lambda: np.zeros(4))


def evaluated(
    observed: Observed, link: Go1Link, joints: Sequence[str], stops: np.ndarray, config: FilterConfig, bounds: Bounds
) -> Findings:
    """Return the findings.

    Args:
        observed: states, by ``listen``.
        link: counts the rejected packets.
        joints: names, 12.
        stops: (12, 2) hard stops, rad.
        config: has the legs.
        bounds: limits.
    """
    if len(observed.states) < 2 or observed.health is None:
        why = ", ".join(f"{count} x {name}" for name, count in link.traffic.refused_because.items())
        received = f"{len(observed.states)} states in {observed.seconds:.1f} s"
        refused = f"; rejected: {why}" if why else "; nothing arrived: is this computer in the robot's network?"
        return Findings((), (f"no robot: {received}{refused}",))
    lines, problems = [*_packets(observed, link)], [*_packet_problems(observed, link, bounds)]
    for evaluate in (_battery, _joints, _trunk):
        findings, wrong = evaluate(observed, joints, stops, bounds)
        lines += findings
        problems += wrong
    up = vertical(observed.mean("imu_quat"))
    counts = observed.mean("foot_force")
    force = forces_by_torque(observed.mean("joint_pos"), observed.mean("joint_torque"), up, kinematics(config))
    spread = np.std([state.foot_force for state in observed.states], axis=0)
    lines.append(
        "feet FR FL RR RL: counts " + " ".join(f"{c:.0f}±{s:.1f}" for c, s in zip(counts, spread, strict=True))
    )
    lines.append("  vertical force from the torques " + " ".join(f"{value:.0f}" for value in force) + " N")
    return Findings(tuple(lines), tuple(problems), observed.tick_s, counts, force)


def _packets(observed: Observed, link: Go1Link) -> list[str]:
    gaps, traffic = 1e3 * observed.intervals, link.traffic
    p50, p99 = np.percentile(gaps, [50, 99])
    unit = f"{observed.tick_s:g} s" if math.isfinite(observed.tick_s) else "unknown; times of arrival are used"
    refused = ", ".join(f"{count} x {why}" for why, count in traffic.refused_because.items()) or "none"
    counted = f"rejected: {refused}; late or duplicate: {traffic.late}"
    delay = spread(observed.delays)
    relative = "unknown" if delay is None else ", ".join(f"{name} {1e3 * v:.2f}" for name, v in delay.items()) + " ms"
    return [
        f"packets: {_rate(observed):.0f} per second; interval p50 {p50:.2f}, p99 {p99:.2f}, worst {gaps.max():.2f} ms",
        f"  {counted}; unit of the tick: {unit}",
        f"  delay relative to the fastest packet: {relative}",
    ]


def _rate(observed: Observed) -> float:
    return (len(observed.states) - 1) / max(observed.states[-1].t - observed.states[0].t, 1e-9)


def _packet_problems(observed: Observed, link: Go1Link, bounds: Bounds) -> list[str]:
    problems = []
    if _rate(observed) < bounds.rate:
        problems.append(f"packets: {_rate(observed):.0f} per second; at least {bounds.rate:.0f} are needed")
    if observed.intervals.max() > bounds.gap:
        problems.append(
            f"packets: {1e3 * observed.intervals.max():.0f} ms without one; {1e3 * bounds.gap:.0f} is a fault"
        )
    share = link.traffic.foreign / (link.traffic.foreign + len(observed.states))
    if share > bounds.refused:
        problems.append(f"packets: {100 * share:.1f} % rejected; at most {100 * bounds.refused:.0f} % are allowed")
    return problems


Evaluated = tuple[list[str], list[str]]


def _battery(observed: Observed, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Evaluated:
    health = observed.health
    assert health is not None
    volts = [value for value in health.cell_voltage if value > 0.0] or [math.nan]
    hottest = int(np.argmax(health.motor_temperature))
    lines = [
        f"battery: {health.charge} %, {health.current:+.2f} A, cells {min(volts):.2f} to {max(volts):.2f} V",
        f"temperature: motors {min(health.motor_temperature)} to {health.motor_temperature[hottest]} °C "
        f"({joints[hottest]}), IMU {health.imu_temperature} °C",
    ]
    problems = []
    if health.charge < bounds.charge:
        problems.append(f"battery: {health.charge} %; at least {bounds.charge} % are needed")
    if health.motor_temperature[hottest] > bounds.motor:
        problems.append(
            f"temperature: {joints[hottest]} has {health.motor_temperature[hottest]} °C; the limit is {bounds.motor} °C"
        )
    return lines, problems


def _joints(observed: Observed, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Evaluated:
    q, qd = observed.mean("joint_pos"), np.abs([state.joint_vel for state in observed.states]).mean(axis=0)
    beyond = np.maximum(stops[:, 0] - q, q - stops[:, 1])
    lines, problems = ["joints, rad (range of the model):"], []
    for k in range(0, len(joints), 3):
        parts = (
            f"{joints[j]} {q[j]:+.3f} ({stops[j, 0]:+.2f} {stops[j, 1]:+.2f})"
            for j in range(k, min(k + 3, len(joints)))
        )
        lines.append("  " + "  ".join(parts))
    for k in map(int, np.flatnonzero(~(beyond <= SafetyConfig.beyond_stop))):
        problems.append(f"joints: {joints[k]} is at {q[k]:.3f} rad; its range is {stops[k, 0]} to {stops[k, 1]}")
    for k in map(int, np.flatnonzero(~(qd <= bounds.velocity))):
        problems.append(f"joints: {joints[k]} moves at {qd[k]:.2f} rad/s; the robot must be at rest")
    return lines, problems


def _trunk(observed: Observed, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Evaluated:
    quat, acc = observed.mean("imu_quat"), float(np.linalg.norm(observed.mean("imu_acc")))
    length, angle = float(np.linalg.norm(quat)), tilt_angle(quat)
    problems = []
    if not abs(length - 1.0) <= SafetyConfig.quat_error:
        problems.append(f"IMU: the attitude quaternion's length is {length:.3f} instead of 1; has the IMU started?")
    if not abs(acc - 9.81) <= bounds.gravity:
        problems.append(f"IMU: the accelerometer reports {acc:.2f} m/s2 at rest instead of 9.81")
    if not angle <= bounds.tilt:
        problems.append(f"IMU: tilt {math.degrees(angle):.0f} deg; the limit is {math.degrees(bounds.tilt):.0f} deg")
    return [f"IMU: gravity {acc:.2f} m/s2, tilt {math.degrees(angle):.1f} deg"], problems


def check(
    link: Go1Link,
    joints: Sequence[str],
    stops: np.ndarray,
    config: FilterConfig,
    say: Callable[[str], None],
    bounds: Bounds | None = None,
) -> Findings:
    """Receive states for ``SECONDS``, print the findings, and return them."""
    findings = evaluated(listen(link, SECONDS), link, joints, stops, config, bounds or Bounds())
    for line in findings.lines:
        say(line)
    return findings


def calibrate(findings: Findings, path: Path, say: Callable[[str], None]) -> None:
    """Write the calibration of a robot at rest into ``path``, completing that of the file.

    Raises:
        go1exp.deploy.estimation.feet.CalibrationError: if the file exists and is no calibration.
    """
    before = FootCalibration.read(path) if path.exists() else None
    after, result = calibrated(findings.counts, findings.by_torque, before)
    say(f"calibration of the foot sensors: {result}")
    if after is not None and after != before:
        after.write(path)
        complete = "" if after.scale else "; check=true while it stands adds the scales"
        say(f"written to {path}{complete}")
