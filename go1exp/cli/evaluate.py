"""``go1exp eval``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli import controllers, engine, other_robot
from go1exp.cli.app import App, spinner
from go1exp.config.schema.registry import ConfigError, Term, bind_list

if TYPE_CHECKING:
    from go1exp.config.schema.backends import BackendConfig
    from go1exp.evaluate.controller.settings import MpcSettings


def _measures(given: Any) -> list[Term]:
    """Resolve the measures, all of them for None; raise ConfigError with every problem of them."""
    from go1exp.mdp.measures import every_measure

    if given is None:
        return every_measure()
    if not isinstance(given, list):
        raise ConfigError([f"measures = {given!r}: must be a list, such as [stride_rate], or null for all of them"])
    return bind_list("measure", given, "measures")


@dataclass(frozen=True)
class _Judged:
    """What an evaluation is of, beside its policy: the robot's parts that differ, the engine, another controller."""

    other: dict[str, Any]
    engine: BackendConfig
    controller: MpcSettings | None


def _protocols(settings: Any, protocols: list[Any], judged: _Judged) -> None:
    """Play what is not the grid."""
    from go1exp.cli.protocols import play, refuse_rates
    from go1exp.cli.subjects import driven, named

    refuse_rates(protocols, judged.controller.name if judged.controller else None, settings.policy_dt)
    if judged.controller is None:
        subject = named(settings.run, settings.policy, settings.bundle, settings.checkpoint, "protocols")
    else:
        subject = driven(judged.controller, settings.run, settings.policy, settings.bundle, "protocols")
    folder = Path(settings.folder or subject.folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError([f"folder = {str(folder)!r}: is a file"])
    from go1exp.evaluate.protocol.playing import Rates

    rates = Rates(settings.seed, settings.policy_dt, settings.physics_dt, judged.engine)
    play(protocols, subject, folder, judged.other, rates)


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.protocols import chosen as protocols_chosen
    from go1exp.cli.protocols import writable_file
    from go1exp.cli.settings import EvalSettings, parse
    from go1exp.config.choices import config_folder, load

    judge, container = engine.split(container)
    other, container = other_robot.split(container)
    choice = {"protocol": container.pop("protocol")}
    settings = parse(EvalSettings, container)
    protocols, grid_too = protocols_chosen({**container, **choice}, load(config_folder() / "eval.yaml"))
    judged = _Judged(other, judge, controllers.chosen(settings.controller))
    measures = _measures(settings.measures)
    if judged.controller is not None and settings.checkpoint:
        raise ConfigError([f"checkpoint = {settings.checkpoint!r}: is of a policy; controller=mpc has none"])
    if not protocols and settings.folder is not None:
        raise ConfigError([f"folder = {settings.folder!r}: is of other protocols; the file of protocol=grid is out="])
    if grid_too:
        _check_grid(settings)
    subject = _of_grid(settings, judged.controller) if grid_too else None
    if subject:
        writable_file(subject[2])
    if protocols:
        _protocols(settings, protocols, judged)
    if subject:
        _grid(settings, measures, judged, subject)


def _check_grid(settings: Any) -> None:
    """Refuse what the grid cannot play."""
    if settings.bundle is not None:
        raise ConfigError([f"bundle = {settings.bundle!r}: protocol=grid takes run or policy; choose another protocol"])
    grid_is_empty = not all((settings.grid.x, settings.grid.y, settings.grid.yaw))
    if settings.grid.cross and grid_is_empty:
        raise ConfigError(["grid: with cross=true every axis needs at least one value, such as grid.yaw=[0.0]"])


def _of_grid(settings: Any, controller: MpcSettings | None) -> tuple[Path | None, Path | None, Path]:
    """Return run (None for another controller), checkpoint and report; raise ConfigError if they are not there."""
    from go1exp.cli.runs import checkpoint_file, trained

    if controller is not None:
        return None, None, controllers.conditions(settings.run, settings.policy, "eval.json", settings.out)[1]
    run, out = trained(settings.run, settings.policy, "eval.json", settings.out)
    return run, checkpoint_file(run, settings.checkpoint), out


def _grid(settings: Any, measures: list[Term], judged: _Judged, subject: tuple[Path | None, Path | None, Path]) -> None:
    """Play the grid of constant commands."""
    from go1exp.evaluate import criteria, rows, table
    from go1exp.evaluate.rollout import EvalConfig, delay_margin, evaluate, grid
    from go1exp.train.policy import load_run

    run, checkpoint, out = subject
    policy, make = None, None
    if run is not None:
        of_run, policy, about = load_run(run, checkpoint)
        task = of_run.task
    else:
        assert judged.controller is not None
        task, _ = controllers.conditions(settings.run, settings.policy, "eval.json", settings.out)
        make, about = controllers.maker(judged.controller, task), {"controller": dataclasses.asdict(judged.controller)}
    commands = grid(settings.grid.x, settings.grid.y, settings.grid.yaw, settings.grid.cross)
    config = EvalConfig.from_settings(settings, commands=commands, engine=judged.engine)
    task = other_robot.replaced(task, judged.other)
    report = {
        "policy": about,
        "robot": other_robot.described(judged.other),
        **evaluate(task, policy, config, spinner(1, "evaluating"), measures, make),
    }
    if settings.delay_margin:
        falls = report["distinct_falls"]
        report["delay_margin"] = delay_margin(task, policy, config, falls, spinner(1, "with a delay"), make)
    report["criteria"] = [dataclasses.asdict(verdict) for verdict in criteria.evaluated(report)]
    rows.write(report, out)
    print(table.text(report))
    print(f"\nwritten to {out}")


APP = App("eval", _task)
