"""A schedule at work: the settings of a task that change between two iterations (``sim/schedule.py``)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import torch

from go1exp.config.schema.physics import WarpBackend
from go1exp.config.schema.registry import ConfigError, unknown_name
from go1exp.config.schema.training import EVALUATED, Ramp, Value
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.metrics import GaitLog, TaskLog
from go1exp.sim.schedule import silent_rows
from go1exp.sim.task import TrainConfig

PREFIX = "schedule/"
"""Begin of the metrics that hold the values in force."""

LEARNER = (
    *("loss", "policy_gradient_loss", "value_loss", "entropy_loss", "clip_fraction", "approx_kl", "kl"),
    *("explained_variance", "std", "learning_rate"),
)
"""Metrics ``train/`` that every learner logs."""


class Schedule:
    """The ramps of a training.

    A value is a function of the steps since the run began, or since the iteration at whose end a metric reached its
    threshold. Together with those steps, the recent values of the metrics are the state that a checkpoint holds.
    """

    def __init__(
        self,
        ramps: Mapping[str, Ramp] | None = None,
        core: Go1Core | None = None,
        per_iteration: int = 1,
        iterations: int = 1,
    ) -> None:
        """Put the first values into force.

        Args:
            ramps: by name.
            core: environment, which was built with ``changing`` of the same settings.
            per_iteration: steps of all robots together in an iteration.
            iterations: of the whole training.
        """
        self._unit = {"steps": 1, "iterations": per_iteration, "share": per_iteration * iterations}
        self._ramps, self._core = dict(ramps or {}), core
        self._triggers = {key: ramp.when.all() for key, ramp in self._ramps.items() if ramp.when}
        self._recent = {
            key: [deque[float](maxlen=t.iterations) for t in triggers] for key, triggers in self._triggers.items()
        }
        self._started: dict[str, int | None] = dict.fromkeys(self._triggers)
        self._values: dict[str, Value] = {}
        self._apply(0)

    @property
    def measures(self) -> set[str]:
        """Metrics that start a ramp."""
        return {trigger.measure for of_ramp in self._triggers.values() for trigger in of_ramp}

    def advance(self, steps: int, metrics: Mapping[str, float]) -> list[str]:
        """Put the values of the next iteration into force.

        Args:
            steps: of all robots together so far.
            metrics: of the iteration that ended; those of ``measures`` at least, the same in each process of a group.

        Returns:
            Names of the ramps whose threshold was reached now.

        Raises:
            ConfigError: if a metric is missing.
        """
        begun = []
        for key, triggers in self._triggers.items():
            if self._started[key] is not None:
                continue
            satisfied = []
            for trigger, recent in zip(triggers, self._recent[key], strict=True):
                if trigger.measure not in metrics:
                    path = f"schedule.{key}.when.measure"
                    raise ConfigError([unknown_name(path, trigger.measure, metrics, "metric")])
                value = float(metrics[trigger.measure])
                if not math.isnan(value):  # NaN: nothing was measured in this iteration
                    recent.append(value)
                full = len(recent) == trigger.iterations and not math.isnan(value)
                satisfied.append(full and trigger.satisfied_by(sum(recent) / len(recent)))
            if all(satisfied):
                self._started[key] = steps
                begun.append(key)
        self._apply(steps)
        return begun

    def waiting(self) -> str:
        """Return which ramps have not reached their thresholds, and the metrics now; empty if none waits."""
        names: dict[str, list[str]] = {}
        for key, triggers in self._triggers.items():
            if self._started[key] is None:
                means = [sum(recent) / len(recent) if recent else math.nan for recent in self._recent[key]]
                pairs = zip(triggers, means, strict=True)
                names.setdefault(" and ".join(f"{t} (now {mean:.3g})" for t, mean in pairs), []).append(key)
        return "; ".join(f"{', '.join(keys)} (waiting for {condition})" for condition, keys in names.items())

    def _apply(self, steps: int) -> None:
        """Write the values at ``steps`` into the environment, those that differ from the present ones."""
        for key, ramp in self._ramps.items():
            per = self._unit[ramp.unit]
            start = self._started[key] if key in self._triggers else per * (ramp.start or 0.0)
            value = ramp.value(-math.inf if start is None else (steps - start) / per)
            if self._core is not None and self._values.get(key) != value:
                self._core.change(ramp.path, value)
            self._values[key] = value

    def metrics(self) -> dict[str, float]:
        """Return the values in force; of a range its two ends."""
        named: dict[str, float] = {}
        for key, value in self._values.items():
            if isinstance(value, tuple):
                named |= {f"{PREFIX}{key}_low": value[0], f"{PREFIX}{key}_high": value[1]}
            else:
                named[f"{PREFIX}{key}"] = value
        return named

    def state_dict(self) -> dict[str, Any]:
        """Return the state that does not follow from the steps, as plain data; empty without a trigger."""
        return {k: {"recent": [list(r) for r in self._recent[k]], "started": self._started[k]} for k in self._triggers}

    def load_state_dict(self, state: Mapping[str, Any], steps: int) -> None:
        """Continue from ``state_dict`` after ``steps`` of all robots together."""
        for key, of_key in state.items():
            for recent, kept in zip(self._recent[key], of_key["recent"], strict=True):
                recent.clear()
                recent.extend(kept)
            self._started[key] = of_key["started"]
        self._apply(steps)


def check_measures(config: TrainConfig) -> None:
    """Refuse a ramp that waits for a metric which the training does not log.

    Raises:
        ConfigError: naming it and the nearest ones.
    """
    cpu = torch.device("cpu")
    silent = silent_rows(config.task.reward, config.schedule.values())
    known = [name for t in config.task.reward if (name := f"reward/{t.key}") not in silent]
    known += [*GaitLog(1, 1.0, cpu).drain(), *TaskLog(1.0, cpu).drain(), "rollout/return", "rollout/length"]
    known += [f"train/{name}" for name in LEARNER]
    known += ["curriculum/terrain_level"] if config.task.terrain.kind != "flat" else []
    known += ["physics/overflow"] if isinstance(config.task.backend, WarpBackend) else []
    wanted = {
        f"schedule.{key}.when.{'also.' * depth}measure": trigger.measure
        for key, ramp in config.schedule.items()
        for depth, trigger in enumerate(ramp.when.all() if ramp.when else ())
    }
    strange = {path: name for path, name in wanted.items() if name not in known}
    if strange:
        raise ConfigError(
            [
                f"{path} = {name!r}: an evaluation takes its time, so that no two trainings would be the same"
                if name.startswith(EVALUATED)
                else unknown_name(path, name, known, "metric")
                for path, name in strange.items()
            ]
        )
