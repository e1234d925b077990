"""``go1exp fit-actuator``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from go1exp.base.files import write_json
from go1exp.cli.app import App, announce, parse_with_groups, spinner
from go1exp.cli.places import read_all, remove_empty, writable
from go1exp.cli.verbs import command
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import ConfigError, NonNegative
from go1exp.config.schema.settings import subset
from go1exp.gap.actuator_net.settings import FitSettings

if TYPE_CHECKING:
    import numpy as np

    from go1exp.logs.recording import Recording
    from go1exp.robot.config import RobotConfig


@schema.settings
class FitActuatorSettings(FitSettings):
    """``conf/fit-actuator.yaml`` without the group.

    Attributes:
        recordings: folder of recordings, or a list of folders and files.
        gains: take only recordings made with these, as [kp N m/rad, kd N m s/rad]; null takes all, which must agree.
        plots: draw torque over time, measured and predicted.
        out: folder for net.npz, net.onnx, report.json and the plots.
    """

    recordings: str | tuple[str, ...]
    gains: tuple[NonNegative, NonNegative] | None
    plots: bool
    out: str


def _inverse_dynamics(config: RobotConfig, smoothing: float | None) -> Callable[[Recording], np.ndarray]:
    """Return the function from a recording of a suspended Go1 to the torques (T, 12) at its joints, N m."""
    from go1exp.gap.actuator_net.dataset import WINDOW, smooth_motion
    from go1exp.gap.actuator_net.settings import FitError
    from go1exp.sim.physics.dynamics import joint_torques

    def joint_torque(recording: Recording) -> np.ndarray:
        base = recording.meta.base_quat
        if recording.meta.robot != "go1" or base is None:
            raise FitError(f"{recording.meta.episode}: target=joint_torque needs a Go1 whose trunk is held")
        motion = smooth_motion(recording, smoothing or WINDOW)
        return joint_torques(config, base, motion.q, motion.qd, motion.qdd)

    return joint_torque


def _with_gains(recordings: list[Recording], gains: tuple[float, float] | None) -> list[Recording]:
    """Return recordings of these gains, N m/rad and N m s/rad, or all for None; raise ConfigError if there is none."""
    if gains is None:
        return recordings
    kp, kd = gains
    chosen = [r for r in recordings if {*(r.meta.kp or ())} == {kp} and {*(r.meta.kd or ())} == {kd}]
    if not chosen:
        sets = {(max(r.meta.kp), max(r.meta.kd)) for r in recordings if r.meta.kp and r.meta.kd}
        existing = ", ".join(f"[{p:g},{d:g}]" for p, d in sorted(sets)) or "none that are known"
        raise ConfigError([f"gains = [{kp:g},{kd:g}]: no recording was made with these; there are {existing}"])
    return chosen


def _task(container: dict[str, object]) -> None:
    settings, parts = parse_with_groups(FitActuatorSettings, container, ("robot",))

    recordings = _with_gains(read_all(settings.recordings), settings.gains)
    existed = Path(settings.out).exists()
    out = writable(settings.out)
    announce("fitting")

    from go1exp.gap.actuator_net import fitting, report

    bar = spinner(settings.epochs, "fitting")
    stage = [""]

    def progress(what: str, done: int, total: int, train: float, validation: float) -> None:
        if what != stage[0]:
            stage[0] = what
            print(f"fitting {what} ...", flush=True)
        bar(done, total)

    if settings.target == "joint_torque" and settings.smoothing is None:
        print("note: smoothing=0.02 usually serves target=joint_torque better (docs/actuator_nets.md)")
    inverse = _inverse_dynamics(parts["robot"], settings.smoothing) if settings.target == "joint_torque" else None
    try:
        result = fitting.fit(recordings, subset(FitSettings, settings), progress, inverse)
    except BaseException:  # refused, or stopped: what was made here and holds nothing goes
        if not existed:
            remove_empty(out)
        raise
    result.net.save(out / "net.npz")
    result.net.export_onnx(out / "net.onnx")
    write_json(out / "report.json", asdict(result.report))
    pictures = fitting.plot(result, out) if settings.plots else []
    print(report.text(result.report))
    print(f"\nwritten to {out}: net.npz, net.onnx, report.json{''.join(f', {p.name}' for p in pictures)}")
    if wrong := report.useless(result.report):
        print(f"bad: the net is {'; '.join(wrong)}: do not train a policy with it")
        return
    print("good: on the held-out episodes the net is better than zero and every simple model")
    print(f"now: {command('train', 'actuator=net', settings={'actuator.file': out / 'net.npz'})}")


APP = App("fit-actuator", _task, FitActuatorSettings)
