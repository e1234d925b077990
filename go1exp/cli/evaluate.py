"""``go1exp eval``."""

from __future__ import annotations

import dataclasses
from typing import Any

from go1exp.cli import controllers, engine, other_robot
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


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.runs import checkpoint_file, trained
    from go1exp.cli.settings import EvalSettings, parse

    judge, container = engine.split(container)
    other, container = other_robot.split(container)
    settings = parse(EvalSettings, container)
    controller = controllers.chosen(settings.controller)
    measures = _measures(settings.measures)
    if controller is None:
        run, out = trained(settings.run, settings.policy, "eval.json", settings.out)
        checkpoint = checkpoint_file(run, settings.checkpoint)
    elif settings.checkpoint:
        raise ConfigError([f"checkpoint = {settings.checkpoint!r}: is of a policy; controller=mpc has none"])

    grid_is_empty = not all((settings.grid.x, settings.grid.y, settings.grid.yaw))
    if settings.grid.cross and grid_is_empty:
        raise ConfigError(["grid: with cross=true every axis needs at least one value, such as grid.yaw=[0.0]"])

    from go1exp.evaluate import table
    from go1exp.evaluate.bars import judged
    from go1exp.evaluate.delay_margin import delay_margin
    from go1exp.evaluate.policy import load_run
    from go1exp.evaluate.rollout import EvalConfig, evaluate, grid

    policy, make = None, None
    if controller is None:
        of_run, policy, about = load_run(run, checkpoint)
        trained_on = of_run.task
    else:
        trained_on, out = controllers.conditions(settings.run, settings.policy, "eval.json", settings.out)
        make, about = controllers.maker(controller, trained_on), {"controller": dataclasses.asdict(controller)}
    commands = grid(settings.grid.x, settings.grid.y, settings.grid.yaw, settings.grid.cross)
    config = EvalConfig.from_settings(settings, commands=commands, engine=judge)
    task = other_robot.replaced(trained_on, other)
    report = {
        "policy": about,
        "robot": other_robot.described(other),
        **evaluate(task, policy, config, spinner(1, "evaluating"), measures, make),
    }
    if settings.delay_margin:
        falls = report["distinct_falls"]
        report["delay_margin"] = delay_margin(task, policy, config, falls, spinner(1, "with a delay"), make)
    report["bars"] = [dataclasses.asdict(verdict) for verdict in judged(report)]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, report)
    print(table.text(report))
    print(f"\nwritten to {out}")


APP = App("eval", _task)
