"""The simulated robot's process: ``python -m go1exp.deploy.sim_robot``, which ``go1exp deploy`` starts.

Its settings come as one line of JSON on standard input. It ends when that input ends, so that it never runs longer than
the process that started it. It writes one line of JSON when it listens, and one with its report at the end.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError

from go1exp.base.errors import Expected
from go1exp.config.schema.registry import ConfigError, as_json, explain
from go1exp.config.schema.settings import adapter
from go1exp.deploy.runtime.bundle import CONFIG, MEMBERS, unpack
from go1exp.deploy.sim_robot import SimConfig
from go1exp.deploy.sim_robot.machine import Robot
from go1exp.deploy.sim_robot.server import KEPT_S, TRUTH, Server
from go1exp.robot import JOINTS
from go1exp.sim.effects.rules import actuator_problems
from go1exp.sim.task import TaskConfig, parse_parts, parse_train

WITHOUT_POLICY = {
    **{group: {} for group in ("reward", "rand", "event", "termination", "curriculum", "schedule")},
    "observation": {"joint_position": {}},
    "command": {"term": "fixed_velocity"},
    "plugins": [],
}
"""What the robot does not need of a bundle: it may name terms of a plugin, which a bundle does not carry."""


def bundle_task(bundle: str, other: dict[str, Any]) -> TaskConfig:
    """Return the task that a bundle's policy was trained in, with other choices of actuator and effects if given.

    Raises:
        BundleError: if the file is no bundle.
        ConfigError: if its configuration or the choices are refused.
    """
    members = unpack(Path(bundle).read_bytes(), MEMBERS, bundle)
    task = parse_train({**json.loads(members[CONFIG]), **WITHOUT_POLICY}).task
    chosen = {name: value for name, value in other.items() if value is not None}
    parts, problems = parse_parts(chosen, tuple(chosen))
    if not problems:
        task = replace(task, **parts)
        problems = actuator_problems(task.actuator, task.effect, JOINTS)
    if problems:
        raise ConfigError(problems)
    return task


def sim_config(given: dict[str, Any]) -> SimConfig:
    """Check the settings of the simulated robot; raise ConfigError with every problem."""
    try:
        return adapter(SimConfig).validate_json(as_json(given))
    except ValidationError as error:
        raise ConfigError(explain(error, "sim", SimConfig.__dataclass_fields__)) from None


def _say(what: str, **content: object) -> None:
    sys.stdout.write(json.dumps({"what": what, **content}) + "\n")
    sys.stdout.flush()


def main() -> int:
    """Serve until standard input ends or SIGTERM comes; return the exit status."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the runtime, which then ends this process
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: ended.append(number))
    torch.set_num_threads(1)
    # Unbuffered: a buffered reader could take more than the line, which ``select`` would not see.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as unbuffered:
        given = json.loads(unbuffered.readline())
    try:
        config = sim_config(given.get("sim", {}))
        task = bundle_task(given["bundle"], given.get("robot", {}))
        server = Server(Robot(task, config), config, kept=given.get("kept", KEPT_S))
    except (ConfigError, Expected, OSError) as error:
        lines = error.problems if isinstance(error, ConfigError) else []
        _say("refused", message=str(error), problems=lines)
        return 1
    _say("listening", port=server.port, pid=os.getpid())

    def going() -> bool:
        return not ended and not select.select([sys.stdin], [], [], 0)[0]

    server.serve(going)
    if given.get("truth"):
        rows, applied = np.array(server.truth), np.array(server.applied)
        np.savez(given["truth"], rows=rows, columns=np.array(["clock", *TRUTH]), applied=applied)
    _say("ended", **asdict(server.counts))
    server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
