"""``go1exp sim``."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import Any

from go1exp.cli.app import App, parse_with_groups
from go1exp.cli.play_web import address, sim
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.settings import subset
from go1exp.deploy.sim_robot.settings import SimConfig, SimSettings

BODY = ("robot", "actuator", "effect", "contact", "terrain")
"""Groups of the configuration that describe the robot and its ground."""


def _task(container: dict[str, Any]) -> int:
    from go1exp import robot
    from go1exp.deploy.runtime.udp import parsed_address
    from go1exp.deploy.sim_robot.machine import Body, Robot
    from go1exp.sim.effects.rules import actuator_problems

    settings, parts = parse_with_groups(SimSettings, container, BODY)
    if problems := actuator_problems(parts["actuator"], parts["effect"], robot.JOINTS):
        raise ConfigError(problems)
    where, page = parsed_address(settings.address, HERE), address(settings.host, settings.port)
    body, config = Body(**parts, tile=settings.tile), subset(SimConfig, settings)
    if settings.viewer == "web":
        groups = {name: container[name] for name in BODY}
        sim(body, groups, config, where, settings.seconds, page)
        return 0

    import torch

    from go1exp.deploy.sim_robot.alone import greeting, serve
    from go1exp.deploy.sim_robot.server import Server

    torch.set_num_threads(1)
    server = Server(Robot(body, config), config, where[1], where[0])
    print(greeting(settings.start, server.address), flush=True)
    try:
        with suppress(KeyboardInterrupt):  # its usual end
            serve(server, lambda: True, partial(print, flush=True), settings.seconds)
    finally:
        server.close()
    return 0


HERE = ("127.0.0.1", 8007)
"""Default address; it cannot be reached from the network."""

APP = App("sim", _task, SimSettings)
