"""``go1exp deploy``."""

from __future__ import annotations

import dataclasses
from typing import Any

from go1exp.cli.app import App
from go1exp.cli.other_robot import CHOICES
from go1exp.schema.registry import ConfigError


def _task(container: dict[str, Any]) -> int:
    from go1exp.cli.settings import DeploySettings, parse

    other = {name: container[name] for name in CHOICES if container.get(name) is not None}
    settings = parse(DeploySettings, {name: value for name, value in container.items() if name not in CHOICES})
    if settings.link == "go1" and other:
        raise ConfigError([f"{', '.join(other)}: the real robot has its own; they are for robot=sim"])

    from go1exp.cli.logs import writable
    from go1exp.deploy.commands import Wish
    from go1exp.deploy.job import Job, run_job
    from go1exp.deploy.launch import RefusedError
    from go1exp.deploy.walk import Plan

    writable(settings.out)
    given = dataclasses.asdict(settings)
    wish = Wish(settings.commands, settings.sinusoid.amplitude, settings.sinusoid.period)
    plan = Plan(wish=wish, **{f.name: given[f.name] for f in dataclasses.fields(Plan) if f.name != "wish"})
    job = Job(settings.bundle, settings.link, plan, settings.out, given["sim"], other, settings.truth)
    try:
        return run_job(job, lambda line: print(line, flush=True))
    except RefusedError as error:
        raise ConfigError(error.problems) from None


APP = App("deploy", _task)
