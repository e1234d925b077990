"""``go1exp play``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli import controllers, engine, other_robot
from go1exp.cli.app import App, spinner
from go1exp.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.cli.settings import PlaySettings
    from go1exp.env.core import Go1Core
    from go1exp.evaluate.policy import Policy

FORMATS = (".mp4", ".gif")
"""Endings of a clip's file; the picture beside it is a .png."""


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.runs import checkpoint_file, trained
    from go1exp.cli.settings import PlaySettings, parse

    judge, container = engine.split(container)
    other, container = other_robot.split(container)
    settings = parse(PlaySettings, container)
    controller = controllers.chosen(settings.controller)
    names = (settings.run, settings.policy, "play.mp4", settings.out)
    if controller is None:
        run, out = trained(*names)
        checkpoint = checkpoint_file(run, settings.checkpoint)
    else:
        trained_on, out = controllers.conditions(*names)
    if out.suffix.lower() not in FORMATS:
        raise ConfigError([f"out = {str(out)!r}: a clip is {' or '.join(FORMATS)}"])

    from go1exp.controller.batch import Driven
    from go1exp.env.core import Go1Core
    from go1exp.evaluate.engine import require_agreement
    from go1exp.evaluate.policy import load_run
    from go1exp.evaluate.rollout import EvalConfig, evaluation_task

    policy: Policy
    if controller is None:
        of_run, policy, _ = load_run(run, checkpoint)
        trained_on = of_run.task
    whole = {"episodes": 1, "duration_s": settings.seconds, "settle_s": 0.0, "policy_dt": None}
    shown = EvalConfig.from_settings(settings, commands=(settings.velocity,), engine=judge, **whole)
    task = other_robot.replaced(trained_on, other)
    shown_task = evaluation_task(task, shown)
    require_agreement(shown_task)
    core = Go1Core(shown_task, 1, settings.seed, noise=settings.noise, imu=controller is not None)
    if controller is not None:
        policy = Driven(core, controllers.maker(controller, task), noise=settings.noise, seed=settings.seed)
    _show(core, policy, settings, out)


def _show(core: Go1Core, policy: Policy, settings: PlaySettings, out: Path) -> None:
    """Open the live viewer, or write clip and picture."""
    from go1exp.evaluate import video
    from go1exp.evaluate.camera import RenderingUnavailable
    from go1exp.evaluate.stick import picture

    if settings.viewer == "live" or (settings.viewer == "auto" and _has_display()):
        video.live(core, policy)
        return
    core.command.value[:] = core.command.value.new_tensor(settings.velocity)
    progress = spinner(1, "filming")
    try:
        frames = list(video.record(core, policy, settings.seconds, fps=settings.fps, on_frame=progress, footfalls=True))
    except RenderingUnavailable as error:
        picture(core, policy, settings.seconds, out.with_suffix(".png"))
        print(f"{error}\nA stick figure instead: {out.with_suffix('.png')}")
        return
    write = video.write_gif if out.suffix.lower() == ".gif" else video.write_mp4
    write(out, frames, settings.fps)
    video.write_strip(out.with_suffix(".png"), frames)
    print(f"written to {out} and {out.with_suffix('.png')}")


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


APP = App("play", _task)
