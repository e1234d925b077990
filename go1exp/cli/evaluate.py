"""``go1exp eval``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from go1exp.cli import other_robot
from go1exp.cli.app import App, spinner
from go1exp.files import write_json
from go1exp.schema.registry import ConfigError, Term, bind_list


def _measures(given: Any) -> list[Term]:
    """Resolve the measures, all of them for None; raise ConfigError with every problem of them."""
    from go1exp.measures import every_measure

    if given is None:
        return every_measure()
    if not isinstance(given, list):
        raise ConfigError([f"measures = {given!r}: must be a list, such as [stride_rate], or null for all of them"])
    return bind_list("measure", given, "measures")


def _protocols(settings: Any, protocols: list[Any], other: dict[str, Any]) -> None:
    """Play what is not the grid."""
    from go1exp.cli.protocols import play
    from go1exp.cli.subjects import named

    subject = named(settings.run, settings.policy, settings.bundle, settings.checkpoint, "protocols")
    folder = Path(settings.folder or subject.folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError([f"folder = {str(folder)!r}: is a file"])
    from go1exp.protocol.playing import Rates

    play(protocols, subject, folder, other, Rates(settings.seed, settings.policy_dt, settings.physics_dt))


def _task(container: dict[str, Any]) -> None:
    from go1exp.choices import config_folder, load
    from go1exp.cli.protocols import chosen as protocols_chosen
    from go1exp.cli.settings import EvalSettings, parse

    other, container = other_robot.split(container)
    choice = {"protocol": container.pop("protocol")}
    settings = parse(EvalSettings, container)
    protocols, grid_too = protocols_chosen({**container, **choice}, load(config_folder() / "eval.yaml"))
    measures = _measures(settings.measures)
    if not protocols and settings.folder is not None:
        raise ConfigError([f"folder = {settings.folder!r}: is of other protocols; the file of protocol=grid is out="])
    files = _files_of_grid(settings) if grid_too else None
    if protocols:
        _protocols(settings, protocols, other)
    if files:
        _grid(settings, measures, other, *files)


def _files_of_grid(settings: Any) -> tuple[Path, Path | None, Path]:
    """Return run, checkpoint and report of the grid; raise ConfigError if they are not there, or if it is none."""
    from go1exp.cli.runs import checkpoint_file, trained

    if settings.bundle is not None:
        raise ConfigError([f"bundle = {settings.bundle!r}: protocol=grid takes run or policy; choose another protocol"])
    run, out = trained(settings.run, settings.policy, "eval.json", settings.out)
    checkpoint = checkpoint_file(run, settings.checkpoint)
    grid_is_empty = not all((settings.grid.x, settings.grid.y, settings.grid.yaw))
    if settings.grid.cross and grid_is_empty:
        raise ConfigError(["grid: with cross=true every axis needs at least one value, such as grid.yaw=[0.0]"])
    return run, checkpoint, out


def _grid(
    settings: Any, measures: list[Term], other: dict[str, Any], run: Path, checkpoint: Path | None, out: Path
) -> None:
    """Play the grid of constant commands."""
    from go1exp.evaluate import table
    from go1exp.evaluate.bars import judged
    from go1exp.evaluate.delay_margin import delay_margin
    from go1exp.evaluate.policy import load_run
    from go1exp.evaluate.rollout import EvalConfig, evaluate, grid

    of_run, policy, about = load_run(run, checkpoint)
    commands = grid(settings.grid.x, settings.grid.y, settings.grid.yaw, settings.grid.cross)
    config = EvalConfig.from_settings(settings, commands=commands)
    task = other_robot.replaced(of_run.task, other)
    report = {
        "policy": about,
        "robot": other_robot.described(other),
        **evaluate(task, policy, config, spinner(1, "evaluating"), measures),
    }
    if settings.delay_margin:
        falls = report["distinct_falls"]
        report["delay_margin"] = delay_margin(task, policy, config, falls, spinner(1, "with a delay"))
    report["bars"] = [dataclasses.asdict(verdict) for verdict in judged(report)]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, report)
    print(table.text(report))
    print(f"\nwritten to {out}")


APP = App("eval", _task)
