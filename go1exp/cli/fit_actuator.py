"""``go1exp fit-actuator``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from go1exp.cli.app import App, spinner
from go1exp.files import write_json
from go1exp.schema.registry import ConfigError, explain

if TYPE_CHECKING:
    import numpy as np

    from go1exp.recording import Recording
    from go1exp.robot import RobotConfig

GO1 = "go1"


def _inverse_dynamics(config: RobotConfig, smoothing: float | None) -> Callable[[Recording], np.ndarray]:
    """Return the function from a recording of a hung Go1 to the torques (T, 12) at its joints, N m."""
    from go1exp.fit import FitError, smooth_motion
    from go1exp.fit.smoothing import WINDOW
    from go1exp.physics.inverse import joint_torques

    def joint_torque(recording: Recording) -> np.ndarray:
        base = recording.meta.base_quat
        if recording.meta.robot != GO1 or base is None:
            raise FitError(f"{recording.meta.episode}: target=joint_torque needs a Go1 whose trunk is held")
        motion = smooth_motion(recording, smoothing or WINDOW)
        return joint_torques(config, base, motion.q, motion.qd, motion.qdd)

    return joint_torque


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.settings import FitActuatorSettings, parse
    from go1exp.config import parse_parts

    parts, problems = parse_parts(container, ("robot",))
    try:
        settings = parse(FitActuatorSettings, {k: v for k, v in container.items() if k != "robot"})
    except ConfigError as error:
        raise ConfigError([*problems, *error.problems]) from None
    if problems:
        raise ConfigError(problems)

    from pydantic import ValidationError

    from go1exp import fit
    from go1exp.cli.logs import read_all, writable

    own = {f.name: getattr(settings, f.name) for f in fields(fit.FitSettings)}
    try:
        how = fit.FitSettings(**own)
    except ValidationError as error:
        raise ConfigError(explain(error, "", own)) from None
    out = writable(settings.out)
    recordings = read_all(settings.recordings)
    bar = spinner(settings.epochs, "fitting")
    stage = [""]

    def progress(what: str, done: int, total: int, train: float, validation: float) -> None:
        if what != stage[0]:
            stage[0] = what
            print(f"fitting {what} ...", flush=True)
        bar(done, total)

    if settings.target == "joint_torque" and settings.smoothing is None:
        print("note: smoothing=0.02 usually serves target=joint_torque better (docs/actuators.md)")
    inverse = _inverse_dynamics(parts["robot"], settings.smoothing) if settings.target == "joint_torque" else None
    result = fit.fit(recordings, how, progress, inverse)
    result.net.save(out / "net.npz")
    result.net.export_onnx(out / "net.onnx")
    write_json(out / "report.json", result.report.as_dict())
    pictures = fit.plot(result, out) if settings.plots else []
    print(fit.text(result.report))
    print(f"\nwritten to {out}: net.npz, net.onnx, report.json{''.join(f', {p.name}' for p in pictures)}")
    print(f"now: go1exp train actuator=net actuator.file={out / 'net.npz'}")


APP = App("fit-actuator", _task)
