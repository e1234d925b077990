"""``go1exp deploy``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from go1exp.cli.app import App
from go1exp.cli.other_robot import CHOICES
from go1exp.schema.registry import ConfigError


def _task(container: dict[str, Any]) -> int:
    from go1exp.cli.settings import DeploySettings, parse
    from go1exp.schema.settings import subset

    other = {name: container[name] for name in CHOICES if container.get(name) is not None}
    settings = parse(DeploySettings, {name: value for name, value in container.items() if name not in CHOICES})
    if settings.robot == "go1" and other:
        raise ConfigError([f"{', '.join(other)}: the real robot has its own; they are for robot=sim"])

    from go1exp.cli.logs import remove_empty, writable
    from go1exp.deploy.commands import Wish
    from go1exp.deploy.job import Job, run_job
    from go1exp.deploy.launch import RefusedError
    from go1exp.deploy.walk import Plan

    existed = Path(settings.out).exists()
    writable(settings.out)
    plan = subset(Plan, settings, wish=Wish(settings.command, settings.sinusoid.amplitude, settings.sinusoid.period))
    sim = dataclasses.asdict(settings.sim)
    job = Job(settings.bundle, settings.robot, plan, settings.out, sim, other, settings.truth)
    try:
        return run_job(job, lambda line: print(line, flush=True))
    except RefusedError as error:
        raise ConfigError(error.problems) from None
    finally:
        if not existed:
            remove_empty(Path(settings.out))


APP = App("deploy", _task)
