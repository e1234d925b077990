"""``python -m go1exp.deploy FILE ...``: ``go1exp deploy`` without Hydra, for the robot's own computer."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import get_args

from go1exp.base.errors import REFUSED, Expected, end
from go1exp.base.signals import handled, interrupt
from go1exp.base.wording import Start


def positive(text: str) -> float:
    """Read a number greater than 0; raise argparse's error otherwise."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be greater than 0")
    return value


def not_negative(text: str) -> float:
    """Read a number of at least 0; raise argparse's error otherwise."""
    return 0.0 if float(text) == 0.0 else positive(text)


def three(text: str) -> tuple[float, ...]:
    """Read x,y,yaw; raise argparse's error otherwise."""
    values = tuple(map(float, text.split(",")))
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"{text}: must be three numbers, such as 1,0.3,0.8")
    return values


TIMES = (
    ("stand_up", not_negative, "s from the first pose to the nominal stance"),
    ("hand_over", not_negative, "s from the gains of standing up to the policy's"),
    ("lie_down", not_negative, "s for lying down at the end of a walk; 0: brake at once"),
    ("brake", not_negative, "s for which the motors brake at the end"),
    ("keep", positive, "newest seconds that the log holds"),
    ("stale", positive, "s without a state after which the robot is lost"),
    ("spin", not_negative, "s before each cycle for which the core is kept busy"),
)
"""Settings of the plan in seconds: name, type and meaning."""


def arguments(given: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    from go1exp.deploy.runtime.walk import Plan

    parser = argparse.ArgumentParser("python -m go1exp.deploy", description="Run a bundle's policy on a robot.")
    parser.add_argument("bundle", help="file that go1exp export wrote")
    parser.add_argument("--robot", default="sim", help="sim, go1, or the port where a simulated robot listens")
    parser.add_argument("--address", help="HOST:PORT of go1; 192.168.123.10:8007 if left out")
    parser.add_argument("--check", action="store_true", help="with go1: check the robot; no torque is commanded")
    parser.add_argument("--feet", help="calibration of raw foot sensors, by --check (OUT/feet.json)")
    parser.add_argument("--rate", type=positive, help="Hz of policy and commands; that of training if left out")
    parser.add_argument("--seconds", type=positive, help="s under the policy; until it is stopped if left out")
    parser.add_argument(
        "--command", default="0,0,0", help="x,y,yaw (m/s, rad/s), FILE.csv, sinusoid, keyboard, gamepad"
    )
    parser.add_argument("--amplitude", type=three, default=(1.0, 0.3, 0.8), help="of the sinusoid, as x,y,yaw")
    parser.add_argument("--period", type=positive, default=10.0, help="of the sinusoid, s")
    for name, kind, meaning in TIMES:
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=getattr(Plan, name), help=meaning)
    parser.add_argument("--out", default="runs/deploy", help="folder of the logs")
    sim = parser.add_argument_group("with --robot sim")
    sim.add_argument("--start", choices=get_args(Start), default="standing")
    sim.add_argument("--noise", type=float, default=1.0, help="relative to the paper's Table II")
    sim.add_argument("--delay", type=float, default=0.0, help="of packets, each way, s")
    sim.add_argument("--jitter", type=float, default=0.0, help="largest additional delay of each packet, s")
    sim.add_argument("--loss", type=float, default=0.0, help="share of packets that are lost, each way")
    sim.add_argument("--foot-sensors", choices=("newton", "raw"), default="newton", help="raw: counts, as on a robot")
    sim.add_argument("--seed", type=int, default=0)
    sim.add_argument("--truth", action="store_true", help="also write the true motion into the recording")
    return parser.parse_args(given)


def main(given: Sequence[str]) -> int:
    """Walk by the command line; return the exit status."""
    try:
        with handled(interrupt):
            return _walk(arguments(given))
    except (Exception, KeyboardInterrupt) as error:
        return end(error, "go1exp.deploy")


def _walk(options: argparse.Namespace) -> int:
    from go1exp.deploy.runtime.commands import CommandConfig, parsed
    from go1exp.deploy.runtime.job import Job, run_job
    from go1exp.deploy.runtime.walk import Plan

    command = CommandConfig(parsed(options.command), options.amplitude, options.period)
    times = {name: getattr(options, name) for name, _, _ in TIMES}
    plan = Plan(rate=options.rate, seconds=options.seconds, command=command, **times)
    sim = {name: getattr(options, name) for name in ("start", "noise", "delay", "jitter", "loss", "seed")}
    sim |= {"feet": options.foot_sensors}
    if options.check:
        return _check(options)
    where = options.bundle, options.robot, plan, options.out, sim
    job = Job(*where, truth=options.truth, address=options.address, feet=options.feet)
    return run_job(job, partial(print, flush=True))


def _check(options: argparse.Namespace) -> int:
    from pathlib import Path

    import numpy as np

    from go1exp.deploy.runtime.bundle import load
    from go1exp.deploy.runtime.job import run_check

    if options.robot != "go1":
        raise Expected(f"--check with --robot {options.robot}: is for --robot go1", status=REFUSED)
    about = load(options.bundle).metadata
    feet = Path(options.feet or Path(options.out) / "feet.json")
    return run_check(about.joints, np.array(about.joint_limits), feet, options.address, partial(print, flush=True))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
