"""How late targets may come before a robot falls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from go1exp.config.schema.registry import Term, members
from go1exp.evaluate.controller.types import Controller
from go1exp.evaluate.rollout import EvalConfig, evaluate
from go1exp.sim.task import TaskConfig
from go1exp.train.policy import Policy

DELAYS_MS = (10, 20, 30, 40)

EFFECT = "command_delay"


def delayed(task: TaskConfig, delay: float) -> TaskConfig:
    """Return the task with targets that take force ``delay`` s late, in place of another such effect of its own."""
    others = tuple(e for e in task.effect if e.entry.name != EFFECT)
    entry = members("effect")[EFFECT]
    term = Term(EFFECT, entry, entry.check({"delay": delay}, EFFECT)[0], {"spread": {}})
    return dataclasses.replace(task, effect=(*others, term))


def delay_margin(
    task: TaskConfig,
    policy: Policy | None,
    config: EvalConfig,
    falls: dict[str, Any],
    on_step: Callable[[int, int], None] = lambda done, total: None,
    controller: Callable[[], Controller] | None = None,
) -> dict[str, Any]:
    """Run the grid with later and later targets until a robot falls.

    Args:
        task: as for ``evaluate``; a delay within its actuator stays, and the margin comes on top of it.
        policy: as for ``evaluate``.
        config: as for ``evaluate``.
        falls: ``distinct_falls`` of the grid without any further delay.
        on_step: called with the progress of each run.
        controller: as for ``evaluate``.

    Returns:
        ``ms``, the largest delay without falls, None if robots fall without any; ``falls`` of each delay that was run.
    """
    runs, margin = {"0": falls}, None if falls["count"] else 0
    for ms in DELAYS_MS:
        if margin is None or runs[str(margin)]["count"]:
            break
        late = delayed(task, 1e-3 * ms)
        runs[str(ms)] = evaluate(late, policy, config, on_step, controller=controller)["distinct_falls"]
        if runs[str(ms)]["count"]:
            break
        margin = ms
    return {"ms": margin, "falls": runs}
