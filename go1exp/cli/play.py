"""``go1exp play``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from go1exp.base import memory
from go1exp.cli import subjects
from go1exp.cli.app import App, parse, spinner
from go1exp.cli.evaluate import writable_file
from go1exp.cli.play_web import PlaySettings, address, first_tile, log, walk
from go1exp.cli.subjects import agent
from go1exp.config.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.sim.env.camera import Picture
    from go1exp.sim.env.core import Go1Core
    from go1exp.sim.terrain import TerrainConfig
    from go1exp.train.policy import Policy


FORMATS = (".mp4", ".gif")  # endings of a clip's file; the picture beside it is a .png


def _task(container: dict[str, object]) -> None:
    engine, container = subjects.split_engine(container)
    other, container = subjects.split_robot(container)
    ground = _ground(container)
    settings = parse(PlaySettings, container)
    where = address(settings.host, settings.port)
    if settings.log is not None:
        _log(settings, where)
        return
    if ground is not None and settings.train_ground:
        raise ConfigError(["train_ground = True and terrain: only one of them says what the ground is"])
    subject = subjects.subject_of(settings, subjects.chosen_controller(settings.controller), "play.mp4")
    out = Path(settings.out or subject.folder)
    if out.is_dir():
        raise ConfigError([f"out = {str(out)!r}: is a folder; name the file, such as out={out / 'play.mp4'}"])
    if out.suffix.lower() not in FORMATS:
        raise ConfigError([f"out = {str(out)!r}: a clip is {' or '.join(FORMATS)}"])
    if settings.viewer == "web":
        walk(subject, other, ground, engine, settings, where)
        return

    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    live = settings.viewer == "live" or (settings.viewer == "auto" and has_display)
    if not live:
        writable_file(out)
    progress = None if live else spinner(1, "recording a video", at_once=True)

    from go1exp.config.schema.settings import subset
    from go1exp.evaluate.rollout import EvalConfig, evaluation_task, require_agreement
    from go1exp.sim.env.core import Go1Core

    drives = agent(subject, other)
    whole = {"episodes": 1, "seconds": settings.seconds, "settle_s": 0.0, "policy_dt": None}
    shown = subset(EvalConfig, settings, commands=(settings.velocity,), engine=engine, **whole)
    shown_task = evaluation_task(drives.task, shown)
    if ground is not None:
        shown_task = dataclasses.replace(shown_task, terrain=ground)
    tile = first_tile(shown_task.terrain, settings.tile)
    require_agreement(shown_task)
    core = Go1Core(shown_task, 1, settings.seed, noise=settings.noise, imu=drives.senses)
    if tile:
        _stand_on(core, *tile)
    _show(core, drives.begin(core, "exact", settings.seed), settings, out, progress)


def _stand_on(core: Go1Core, row: int, column: int, kind: str) -> None:
    """Let episodes begin on a tile, and say on which: the first reset would draw a row, and the column is the first."""
    core.reset()
    core.level.fill_(row)
    core.tile_column.fill_(column)
    towards = " towards its middle, where the robot begins" if kind.endswith(("_up", "_down")) else ""
    print(f"on tile [{row},{column}] of {core.terrain.config.rows} rows: {kind}{towards}", flush=True)


def _ground(container: dict[str, object]) -> TerrainConfig | None:
    """Take out and return the ground that the group ``terrain`` names, None without it; raise ConfigError if none."""
    from go1exp.sim.task import required_parts

    given = container.pop("terrain", None)
    return None if given is None else required_parts({"terrain": given})["terrain"]


def _log(settings: PlaySettings, where: tuple[str, int]) -> None:
    given = {name: getattr(settings, name) for name in ("run", "policy", "bundle", "checkpoint", "out")}
    wrong = [
        f"log = {settings.log!r} and {name} = {value!r}: only one of them" for name, value in given.items() if value
    ]
    if settings.viewer not in ("auto", "web"):
        wrong.append(f"viewer = {settings.viewer!r}: a recording (log=) is shown by viewer=web alone")
    if wrong:
        raise ConfigError(wrong)

    log(Path(str(settings.log)), where)


def _show(
    core: Go1Core, policy: Policy, settings: PlaySettings, out: Path, progress: Callable[[int, int], None] | None
) -> None:
    from go1exp.evaluate import video
    from go1exp.sim.env.camera import RenderingUnavailable, missing_for_mp4

    if progress is None:
        video.live(core, policy)
        return
    count = round(settings.seconds * settings.fps)
    if count < 1:
        raise ConfigError([f"seconds = {settings.seconds:g}: shorter than a picture at fps = {settings.fps}"])
    gif = out.suffix.lower() == ".gif"
    if not gif and (missing := missing_for_mp4()):
        raise ConfigError([f"out = {str(out)!r}: {missing}, or name a GIF: out={out.with_suffix('.gif')}"])
    core.command.value[:] = core.command.value.new_tensor(settings.velocity)
    try:
        frames = video.record(core, policy, settings.seconds, fps=settings.fps, on_frame=progress, footfalls=True)
    except RenderingUnavailable as error:
        video.picture(core, policy, settings.seconds, out.with_suffix(".png"))
        print(f"{error}\nA stick figure instead: {out.with_suffix('.png')}")
        return
    # an .mp4 is written picture by picture
    if gif and (wrong := memory.too_long(settings.seconds, settings.fps * video.GIF_BYTES)):
        raise ConfigError([f"seconds = {settings.seconds:g}: a GIF {wrong}; an .mp4 of any length does"])
    panels: list[Picture] = []
    kept = video.keeping(frames, count, panels)
    (video.write_gif if gif else video.write_mp4)(out, kept, settings.fps)
    video.write_strip(out.with_suffix(".png"), panels)
    print(f"written to {out} and {out.with_suffix('.png')}")


APP = App("play", _task, PlaySettings)
