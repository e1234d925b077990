"""Report of a walk: its content as plain data, the lines at its end, and its files."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.files import write_json
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.controller import PHASES
from go1exp.deploy.runtime.log import About, Log, write_cycles
from go1exp.deploy.runtime.udp import MOST_SLIP, delays, slip, spread
from go1exp.deploy.runtime.walk import Outcome, Plan

DONE = "walked to the end"


def report(bundle: Bundle, plan: Plan, outcome: Outcome, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return a walk as plain data; ``extra`` is added."""
    log, fault, timing = outcome.log, outcome.fault, outcome.timing
    start, running = log.first_command, _running()
    end = f"stopped by {outcome.requested_by}" if outcome.requested_by else DONE
    return {
        "bundle": {"file": bundle.source, "sha256": bundle.seal},
        "ended": end if fault is None else fault.name,
        "fault": None if fault is None else asdict(fault),
        "status": outcome.status,
        "walked_s": outcome.walked,
        "phases": log.phases,
        "stand_up": stand_up(log, np.array(bundle.metadata.nominal_stance), bundle.metadata.joints),
        "rate": plan.rate or 1.0 / bundle.metadata.policy_dt,
        "trained_rate": 1.0 / bundle.metadata.policy_dt,
        "timing": {**asdict(timing), "missed_share": timing.missed_share},
        "clamped": dict(zip(bundle.metadata.joints, map(int, outcome.safety.clamped), strict=True)),
        "commands_cut": dict(zip(("x", "y", "yaw"), map(int, outcome.commands.cut), strict=True)),
        "estimator": outcome.estimator,
        "packets": packet_delays(log),
        "first_command_after_s": None if start is None or running is None else running - (time.perf_counter() - start),
        "memory_mb": outcome.memory_mb,
        "log": {"states": log.states.count, "overwritten": log.states.overwritten},
        **extra,
    }


def stand_up(log: Log, stance: np.ndarray, joints: Sequence[str]) -> dict[str, Any] | None:
    """Return how a robot stood up and was handed over; None if it was not.

    Returns:
        ``seconds`` until it stood; ``joint`` furthest from the stance then and ``error``, rad; ``step``, the largest
        change of a target from one cycle to the next in the hand-over, rad.
    """
    phase = log.cycles.part("phase")
    rows = np.flatnonzero(phase == PHASES.index("handing_over"))
    if not len(rows) or not {"standing_up", "handing_over"} <= log.phases.keys():
        return None
    error = np.abs(log.cycles.part("q")[rows[0]] - stance)
    targets = log.cycles.part("q_target")[max(rows[0] - 1, 0) : rows[-1] + 2]
    return {
        "seconds": log.phases["handing_over"] - log.phases["standing_up"],
        "joint": joints[int(error.argmax())],
        "error": float(error.max()),
        "step": float(np.abs(np.diff(targets, axis=0)).max()),
    }


def _running() -> float | None:
    """Return the running time of this process, s, to 10 ms; None where the system does not report it."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return None


def packet_delays(log: Log) -> dict[str, Any] | None:
    """Return delays of packets and ages of the newest state at the cycles, s; None if the robot reports no clock.

    Returns:
        ``delay`` and ``age``, each with p50, p99 and worst, relative to the fastest packet, whose latency is unknown;
        and ``clock_slip``, the share by which the robot's clock runs slow, None if unknown.
    """
    arrived, clock = log.states.part("t"), log.states.part("clock")
    delay, age = spread(delays(arrived, clock)), spread(log.cycles.part("age"))
    if delay is None or age is None:
        return None
    return {"delay": dict(delay), "age": dict(age), "clock_slip": slip(arrived, clock)}


def velocity_errors(log: Log, truth: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """Compare estimate and command with the truth, cycle by cycle while walking; None without truth.

    The truth is interpolated to the time of each cycle, less the latency of the fastest packet.

    Returns:
        ``mean`` true velocity (3,), m/s in the trunk's frame; RMSE of the estimate, ``estimate_rmse`` (3,), None where
        a policy needs none; RMSE of the walk against its command after a second, ``tracking_rmse``: x and y in m/s, yaw
        in rad/s; ``distance``, m.
    """
    arrived, clock = log.states.part("t"), log.states.part("clock")
    known = np.isfinite(clock)
    at = log.cycles.part("t")
    walking = log.cycles.part("phase") == PHASES.index("walking")
    if not known.any() or not walking.any() or not truth:
        return None
    newest = np.searchsorted(arrived[known], at[walking], "right") - 1
    when = np.maximum.accumulate(clock[known])[np.maximum(newest, 0)] + log.cycles.part("age")[walking]
    w, x, y, z = (truth[f"base_quat_{part}"] for part in "wxyz")
    v = np.stack([truth[f"base_lin_vel_{axis}_w"] for axis in "xyz"], axis=1)
    vector = np.stack([x, y, z], axis=1)
    # R' v = v - 2 w (u x v) + 2 u x (u x v), u the vector part
    cross = np.cross(vector, v)
    every = v - 2.0 * w[:, None] * cross + 2.0 * np.cross(vector, cross)

    def then(values: np.ndarray) -> np.ndarray:
        return np.interp(when, truth["clock"], values)

    body = np.stack([then(values) for values in every.T], axis=1)
    true = np.column_stack([body[:, :2], then(truth["base_ang_vel_z_b"])])
    steady = at[walking] - at[walking][0] >= min(1.0, 0.5 * (at[walking][-1] - at[walking][0]))
    off = true[steady] - log.cycles.part("command")[walking][steady]
    errors = log.cycles.part("estimate")[walking] - body
    errors = errors[np.isfinite(errors).all(1)]
    place = np.stack([then(truth["base_pos_x_w"]), then(truth["base_pos_y_w"])], axis=1)
    return {
        "mean": body[steady].mean(axis=0).tolist(),
        "estimate_rmse": np.sqrt(np.mean(errors**2, axis=0)).tolist() if len(errors) else None,
        "tracking_rmse": np.sqrt(np.mean(off**2, axis=0)).tolist(),
        "distance": float(np.linalg.norm(place[-1] - place[0])),
    }


def summary_lines(content: Mapping[str, Any]) -> list[str]:
    """Return lines about the velocity of the walk, delays of packets and the timing of the simulated robot."""
    lines = []
    if stood := content.get("stand_up"):
        lines.append(
            f"stood up in {stood['seconds']:.1f} s, {stood['joint']} {stood['error']:.2f} rad from the stance; "
            f"hand-over: targets changed by at most {stood['step']:.2f} rad a cycle"
        )
    if velocity := content.get("velocity"):
        mean, rmse, off = (
            " ".join(f"{value:+.3f}" if name == "mean" else f"{value:.3f}" for value in velocity[name] or ())
            for name in ("mean", "estimate_rmse", "tracking_rmse")
        )
        estimate = f"; RMSE of the estimate {rmse}" if rmse else ""
        lines.append(f"true velocity {mean} m/s over {velocity['distance']:.1f} m{estimate}")
        lines.append(f"RMSE against the command: x, y {off.rsplit(' ', 1)[0]} m/s, yaw {off.rsplit(' ', 1)[1]} rad/s")
    if cut := {axis: count for axis, count in content.get("commands_cut", {}).items() if count}:
        times = ", ".join(f"{axis} in {count} cycles" for axis, count in cut.items())
        lines.append(f"note: commands beyond the ranges of training were limited: {times}")
    if packets := content.get("packets"):
        delay, age = (
            ", ".join(f"{name} {1e3 * value:.1f}" for name, value in packets[part].items()) for part in ("delay", "age")
        )
        lines.append(f"packets, relative to the fastest: delay {delay} ms; age of the newest state at a cycle {age} ms")
        slow = packets.get("clock_slip")
        if slow is not None and abs(slow) > MOST_SLIP:
            lines.append(f"note: the robot's clock ran at {1.0 - slow:.4f}x real time; delays and ages include that")
    if robot := content.get("simulated_robot"):
        lines.append(
            f"simulated robot: {robot['ticks']} ticks of 2 ms, {1e3 * robot['slipped']:.0f} ms behind real time, "
            f"worst start delay {1e3 * robot['timing']['start_delay_worst']:.1f} ms; "
            f"{robot['lost']} packets lost in the network"
        )
    return lines


def end_line(outcome: Outcome, motion: str | None = None) -> str:
    """Return a line on the end of a walk, or of a ``motion``; a fault with its time since the first cycle."""
    if fault := outcome.fault:
        began = min(outcome.log.phases.values(), default=fault.t)
        hint = "; a busy machine, and a simulated robot? stale=0.2" if fault.name == "stale_state" else ""
        return f"fault: {fault.name} at {fault.t - began:.3f} s after the start: {fault.message}{hint}"
    end = f"stopped by {outcome.requested_by}" if outcome.requested_by else "to the end"
    return f"{f'played {motion}' if motion else 'walked'} for {outcome.walked:.1f} s, {end}"


def save(
    folder: Path,
    about: About,
    log: Log,
    content: dict[str, Any],
    truth: Mapping[str, np.ndarray] | None,
    applied: np.ndarray | None = None,
) -> list[Path]:
    """Write NAME.json, NAME.npz and, if the robot was commanded, NAME.parquet; return the files.

    ``truth`` and ``applied`` are those of a simulated robot (``Log.recording``).

    Raises:
        OSError: if one cannot be written.
        go1exp.logs.recording.RecordingError: if the log makes no valid recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{about.episode}.json", folder / f"{about.episode}.npz"]
    write_json(files[0], content, indent=1, allow_nan=False)  # first: the smallest
    write_cycles(files[1], log)
    recording = log.recording(about, truth, applied)
    if recording is not None:
        from go1exp.logs import recording as format_

        files.append(folder / f"{about.episode}.parquet")
        format_.write(files[-1], recording)
    return files
