"""``go1exp fit-actuator``."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli.app import App, spinner
from go1exp.registry import ConfigError

if TYPE_CHECKING:
    import numpy as np

    from go1exp.recording import Recording
    from go1exp.robot import RobotConfig

GO1 = "go1"


def _read(places: str | tuple[str, ...]) -> list[Recording]:
    """Read the recordings of folders and files."""
    from go1exp.recording import read, read_folder

    paths = [Path(p) for p in ([places] if isinstance(places, str) else places)]
    return [r for path in paths for r in (read_folder(path) if path.is_dir() else [read(path)])]


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

    from go1exp import fit

    own = {f.name: getattr(settings, f.name) for f in fields(fit.FitSettings)}
    recordings = _read(settings.recordings)
    bar = spinner(settings.epochs, "fitting")
    stage = [""]

    def progress(what: str, done: int, total: int, train: float, validation: float) -> None:
        if what != stage[0]:
            stage[0] = what
            print(f"fitting {what} ...", flush=True)
        bar(done, total)

    inverse = _inverse_dynamics(parts["robot"], settings.smoothing) if settings.target == "joint_torque" else None
    result = fit.fit(recordings, fit.FitSettings(**own), progress, inverse)
    out = Path(settings.out)
    out.mkdir(parents=True, exist_ok=True)
    result.net.save(out / "net.npz")
    result.net.export_onnx(out / "net.onnx")
    (out / "report.json").write_text(json.dumps(result.report.as_dict(), indent=2) + "\n")
    pictures = fit.plot(result, out) if settings.plots else []
    print(fit.text(result.report))
    print(f"\nwritten to {out}: net.npz, net.onnx, report.json{''.join(f', {p.name}' for p in pictures)}")
    print(f"now: go1exp train actuator=net actuator.file={out / 'net.npz'}")


APP = App("fit-actuator", _task)
