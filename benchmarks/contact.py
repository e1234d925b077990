"""What the contact of the feet does to a walk: ``python -m benchmarks.contact [policy=paper] [robots=10]``.

A shipped policy walks on contacts of several time constants, cones and physics steps: how deep its feet sink, how much
of the loaded time they slip, how hard they land. ``fine=true`` adds physics of 0.25 ms, the reference. Then the speed
of the environment on the CPU, each contact twice, in turns.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence

import torch

from go1exp import robot
from go1exp.cli.places import shipped_policies
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import bind_list
from go1exp.evaluate.rollout import EvalConfig, evaluate
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig
from go1exp.train.policy import Policy, load_run

COMMANDS = ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0))

CONTACTS = (
    (ContactConfig(0.02, "pyramidal", 1.0), 0.002),
    (ContactConfig(0.01, "pyramidal", 1.0), 0.002),
    (ContactConfig(0.005, "pyramidal", 1.0), 0.002),
    (ContactConfig(0.005, "elliptic", 1.0), 0.002),
    (ContactConfig(0.005, "elliptic", 10.0), 0.002),
    (ContactConfig(0.004, "elliptic", 10.0), 0.002),
)
"""Contact, and the physics step, s."""

FINE = (
    (ContactConfig(0.02, "pyramidal", 1.0), 0.00025),
    (ContactConfig(0.005, "pyramidal", 1.0), 0.00025),
    (ContactConfig(0.005, "elliptic", 10.0), 0.00025),
    (ContactConfig(0.0025, "elliptic", 10.0), 0.00025),
)


def walk(task: TaskConfig, policy: Policy, contact: ContactConfig, step: float, robots: int) -> list[str]:
    """Return a line of figures for each command."""
    config = EvalConfig(COMMANDS, robots, 6.0, 2.0, True, True, False, False, None, 1, step)
    measures = bind_list("measure", ["sink_p99", "slip_share_all", "peak_force_p95"], "measures")
    report = evaluate(dataclasses.replace(task, contact=contact), policy, config, measures=measures)
    lines = []
    for row in report["commands"]:
        mean = {name: figure["mean"] for name, figure in row["measures"].items()}
        sink, slip = 1e3 * max(mean["sink_p99"]), 100 * mean["slip_share_all"]
        lines.append(f"{sink:5.1f} {slip:4.0f} {mean['peak_force_p95']:5.1f}")
    return lines


def steps_per_second(task: TaskConfig, contact: ContactConfig) -> float:
    """Return the environment's speed under random actions, 512 robots."""
    core = Go1Core(dataclasses.replace(task, backend=task.backend.as_reference(), contact=contact), 512)
    core.reset()
    action = torch.zeros(512, robot.NUM_JOINTS)
    for _ in range(10):
        core.step(action.normal_())
    begin = time.perf_counter()
    for _ in range(20):
        core.step(action.normal_())
    return 20 * 512 / (time.perf_counter() - begin)


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    given = {"policy": "paper", "robots": "10", "fine": "false"} | dict(a.split("=", 1) for a in arguments)
    config, policy, _ = load_run(shipped_policies()[given["policy"]])
    print("sink p99 mm, slip % of the loaded time, peak force p95 in body weights, at 1 and 2 m/s and 1 rad/s")
    for contact, step in CONTACTS + (FINE if given["fine"] == "true" else ()):
        lines = walk(config.task, policy, contact, step, int(given["robots"]))
        about = f"{1e3 * contact.time_constant:4g} ms {contact.cone:9s} {contact.impratio:2g}, step {1e3 * step:g} ms"
        print(f"{about:36s} {' | '.join(lines)}", flush=True)
    for _ in range(2):
        for contact, _step in CONTACTS[:1] + CONTACTS[2:5]:
            about = f"{1e3 * contact.time_constant:4g} ms {contact.cone:9s} {contact.impratio:2g}"
            print(f"{about}: {steps_per_second(config.task, contact):6.0f} steps/s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
