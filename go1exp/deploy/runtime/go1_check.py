"""What a Go1 says before anything is asked of it: ``check=true``, and the same before every walk.

Only packets that ask for no torque are sent (``go1_wire.IDLE``): the robot answers to nobody who is silent.
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
from go1exp.deploy.runtime.packet_delay import delays, spread
from go1exp.deploy.runtime.safety import SafetyConfig, lean
from go1exp.deploy.runtime.udp import Go1Link
from go1exp.robot.go1_fields import PERIOD
from go1exp.robot.messages import LowState

SECONDS = 2.0
"""How long to listen, s."""

TICKS_S = (0.001, 0.000001, 0.002)
"""Units that the robot's tick may have, s: two comments of the SDK, and one tick a packet."""


@dataclass(frozen=True)
class Bounds:
    """What a robot at rest must keep (chosen, but for those of ``SafetyConfig``).

    Attributes:
        rate: least packets per second; a Go1 sends 500.
        gap: longest time between two packets, s.
        refused: largest share of packets that are refused.
        charge: least charge of the battery, percent.
        motor: highest temperature of a motor, degrees Celsius.
        speed: largest speed of a joint at rest, rad/s.
        gravity: largest difference of the accelerometer from 9.81, m/s2.
        lean: largest angle between the trunk's z axis and the vertical, rad.
    """

    rate: float = 400.0
    gap: float = SafetyConfig.stale
    refused: float = 0.01
    charge: int = 20
    motor: int = 65
    speed: float = 1.0
    gravity: float = 1.0
    lean: float = 0.5


@dataclass
class Heard:
    """What was heard.

    Attributes:
        seconds: for how long it was listened, s.
        states: all that came, in order.
        ticks: tick and time of arrival, s, of the last state of each reading of the socket.
        health: of the last packet; None if none came.
    """

    seconds: float = 0.0
    states: list[LowState] = field(default_factory=list)
    ticks: list[tuple[int, float]] = field(default_factory=list)
    health: go1_wire.Health | None = None

    def mean(self, name: str) -> np.ndarray:
        """Return the mean over all states of one of their parts."""
        return np.mean([getattr(state, name) for state in self.states], axis=0)

    @property
    def intervals(self) -> np.ndarray:
        """Times between arrivals, s."""
        return np.diff([state.t for state in self.states])

    @property
    def tick_s(self) -> float:
        """Unit of the robot's tick, s, by the time that passed meanwhile; NaN if it is none of ``TICKS_S``."""
        if len(self.ticks) < 2:
            return math.nan
        (first, begin), (last, end) = self.ticks[0], self.ticks[-1]
        turned = go1_wire.newer(last, first)
        seconds = (end - begin) / turned if turned > 0 else math.nan
        return next((unit for unit in TICKS_S if abs(seconds / unit - 1.0) < 0.1), math.nan)

    @property
    def delays(self) -> np.ndarray:
        """Delays beyond the fastest packet, s, of those in ``ticks``; NaN if the unit of the tick is not known."""
        clock = [go1_wire.newer(tick, self.ticks[0][0]) * self.tick_s for tick, _ in self.ticks]
        return delays([arrived for _, arrived in self.ticks], clock)


def listen(
    link: Go1Link,
    seconds: float,
    now: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> Heard:
    """Listen to a robot; nothing is sent that asks for a torque."""
    heard, begin = Heard(), now()
    while now() - begin < seconds:
        states = link.receive()
        if states:
            heard.states.extend(states)
            heard.ticks.append((link.tick or 0, states[-1].t))
        sleep(PERIOD)
    heard.seconds = now() - begin
    heard.health = link.health
    return heard


@dataclass(frozen=True)
class Report:
    """Findings about a robot.

    Attributes:
        lines: what there is to read.
        problems: why no walk may begin; empty if one may.
        tick_s: unit of its tick, s; NaN if not known.
        counts: (4,) mean of the feet's sensors.
        by_torque: (4,) vertical forces that balance the joints' torques, N.
    """

    lines: tuple[str, ...]
    problems: tuple[str, ...]
    tick_s: float = math.nan
    counts: np.ndarray = field(default_factory=lambda: np.zeros(4))
    by_torque: np.ndarray = field(default_factory=lambda: np.zeros(4))


def judged(
    heard: Heard, link: Go1Link, joints: Sequence[str], stops: np.ndarray, config: FilterConfig, bounds: Bounds
) -> Report:
    """Return the findings.

    Args:
        heard: by ``listen``.
        link: has counted what was refused.
        joints: names, 12.
        stops: (12, 2) hard stops, rad.
        config: has the legs.
        bounds: what must be kept.
    """
    if len(heard.states) < 2 or heard.health is None:
        why = ", ".join(f"{count} x {name}" for name, count in link.traffic.refused_because.items())
        heard_so_far = f"{len(heard.states)} states in {heard.seconds:.1f} s"
        refused = f"; refused: {why}" if why else "; nothing came: is this computer in the robot's network?"
        return Report((), (f"no robot: {heard_so_far}{refused}",))
    lines, problems = [*_packets(heard, link)], [*_packet_problems(heard, link, bounds)]
    for judge in (_battery, _joints, _trunk):
        findings, wrong = judge(heard, joints, stops, bounds)
        lines += findings
        problems += wrong
    up = vertical(heard.mean("imu_quat"))
    counts = heard.mean("foot_force")
    force = forces_by_torque(heard.mean("joint_pos"), heard.mean("joint_torque"), up, kinematics(config))
    spread = np.std([state.foot_force for state in heard.states], axis=0)
    lines.append(
        "feet FR FL RR RL: counts " + " ".join(f"{c:.0f}±{s:.1f}" for c, s in zip(counts, spread, strict=True))
    )
    lines.append("  vertical force by the torques " + " ".join(f"{value:.0f}" for value in force) + " N")
    return Report(tuple(lines), tuple(problems), heard.tick_s, counts, force)


def _packets(heard: Heard, link: Go1Link) -> list[str]:
    gaps, traffic = 1e3 * heard.intervals, link.traffic
    p50, p99 = np.percentile(gaps, [50, 99])
    unit = f"{heard.tick_s:g} s" if math.isfinite(heard.tick_s) else "not known; times of arrival are used"
    refused = ", ".join(f"{count} x {why}" for why, count in traffic.refused_because.items()) or "none"
    counted = f"refused: {refused}; late or doubled {traffic.late}"
    late = spread(heard.delays)
    beyond = "not known" if late is None else ", ".join(f"{name} {1e3 * value:.2f}" for name, value in late.items())
    return [
        f"packets: {_rate(heard):.0f} a second; between two p50 {p50:.2f}, p99 {p99:.2f}, worst {gaps.max():.2f} ms",
        f"  {counted}; unit of the tick: {unit}",
        f"  delay beyond the fastest packet's: {beyond}{'' if late is None else ' ms'}",
    ]


def _rate(heard: Heard) -> float:
    return (len(heard.states) - 1) / max(heard.states[-1].t - heard.states[0].t, 1e-9)


def _packet_problems(heard: Heard, link: Go1Link, bounds: Bounds) -> list[str]:
    problems = []
    if _rate(heard) < bounds.rate:
        problems.append(f"packets: {_rate(heard):.0f} a second; at least {bounds.rate:.0f} are needed")
    if heard.intervals.max() > bounds.gap:
        problems.append(f"packets: {1e3 * heard.intervals.max():.0f} ms without one; {1e3 * bounds.gap:.0f} is a fault")
    share = link.traffic.foreign / (link.traffic.foreign + len(heard.states))
    if share > bounds.refused:
        problems.append(f"packets: {100 * share:.1f} % refused; at most {100 * bounds.refused:.0f} % may be")
    return problems


Judged = tuple[list[str], list[str]]


def _battery(heard: Heard, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Judged:
    health = heard.health
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
            f"temperature: {joints[hottest]} has {health.motor_temperature[hottest]} °C; {bounds.motor} is the most"
        )
    return lines, problems


def _joints(heard: Heard, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Judged:
    q, qd = heard.mean("joint_pos"), np.abs([state.joint_vel for state in heard.states]).mean(axis=0)
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
    for k in map(int, np.flatnonzero(~(qd <= bounds.speed))):
        problems.append(f"joints: {joints[k]} moves at {qd[k]:.2f} rad/s; the robot must be at rest")
    return lines, problems


def _trunk(heard: Heard, joints: Sequence[str], stops: np.ndarray, bounds: Bounds) -> Judged:
    quat, acc = heard.mean("imu_quat"), float(np.linalg.norm(heard.mean("imu_acc")))
    length, angle = float(np.linalg.norm(quat)), lean(quat)
    problems = []
    if not abs(length - 1.0) <= SafetyConfig.quat_error:
        problems.append(f"IMU: the attitude quaternion's length is {length:.3f} instead of 1: has it started?")
    if not abs(acc - 9.81) <= bounds.gravity:
        problems.append(f"IMU: the accelerometer says {acc:.2f} m/s2 at rest instead of 9.81")
    if not angle <= bounds.lean:
        problems.append(
            f"IMU: the trunk leans by {math.degrees(angle):.0f} degrees; {math.degrees(bounds.lean):.0f} at most"
        )
    return [f"IMU: gravity {acc:.2f} m/s2, leans by {math.degrees(angle):.1f} degrees"], problems


def check(
    link: Go1Link,
    joints: Sequence[str],
    stops: np.ndarray,
    config: FilterConfig,
    say: Callable[[str], None],
    bounds: Bounds | None = None,
) -> Report:
    """Listen for ``SECONDS``, say what was heard, and return the findings."""
    report = judged(listen(link, SECONDS), link, joints, stops, config, bounds or Bounds())
    for line in report.lines:
        say(line)
    return report


def calibrate(report: Report, path: Path, say: Callable[[str], None]) -> None:
    """Write into ``path`` what a robot at rest tells about its feet's sensors, beside what the file has already.

    Raises:
        go1exp.deploy.estimation.feet.CalibrationError: if the file is there and is no calibration.
    """
    before = FootCalibration.read(path) if path.exists() else None
    after, learnt = calibrated(report.counts, report.by_torque, before)
    say(f"calibration of the feet: {learnt}")
    if after is not None and after != before:
        after.write(path)
        complete = "" if after.scale else "; check=true while it stands adds the scales"
        say(f"written to {path}{complete}")
