"""Evaluate runs without an evaluation, with the same settings: on the grid of commands, and by protocols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from go1exp.config.schema.registry import TooLongError, bind_list
from go1exp.config.schema.settings import subset
from go1exp.evaluate.agents import PolicyAgent, Progress
from go1exp.evaluate.protocol.base import Chosen
from go1exp.evaluate.protocol.pages import write as write_protocol
from go1exp.evaluate.protocol.playing import Rates, play
from go1exp.evaluate.quantities import FILE, write
from go1exp.evaluate.report.evaluations import GRID, PROTOCOLS, names
from go1exp.evaluate.report.settings import EvaluationSettings
from go1exp.evaluate.report.study import Run
from go1exp.evaluate.rollout import EvalConfig, evaluate, grid
from go1exp.train.policy import load_run

BEST = "best.pt"  # the checkpoint that evaluation during training found best, in a run folder


Wanted = tuple[Run, Chosen | None]  # an evaluation of a run: by a protocol, or on the grid for None


def missing(runs: Sequence[Run], protocols: Sequence[Chosen | None] = (None,)) -> list[Wanted]:
    """Return the evaluations (None: the grid) that runs with a checkpoint do not have."""
    return [
        (run, protocol)
        for run in runs
        for protocol in protocols
        if (protocol.key if protocol else GRID) not in names(run) and any((run.folder / "checkpoints").glob("*.pt"))
    ]


def _checkpoint(run: Path, settings: EvaluationSettings) -> Path | None:
    best = run / BEST
    return best if settings.checkpoint == "best" and best.is_file() else None


def play_protocol(run: Run, protocol: Chosen, settings: EvaluationSettings, on_step: Progress) -> None:
    """Play a protocol with a run's policy, its files into the run's folder; raise ValueError if the policy cannot."""
    config, policy, about = load_run(run.folder, _checkpoint(run.folder, settings))
    agent = PolicyAgent(run.label, config.task, policy, about=about)
    velocities = protocol.protocol.policy_velocities().items()
    problems = [p for key, v in velocities for p in agent.problems(v, f"protocol.{protocol.key}.{key}")]
    if problems:
        raise ValueError("; ".join(problems))
    result = play(protocol, agent, Rates(settings.seed), {"robot": {}}, on_step)
    write_protocol(result, run.folder / PROTOCOLS)


def evaluate_run(run: Path, settings: EvaluationSettings, on_step: Progress) -> dict[str, Any]:
    """Evaluate the policy of a run folder on the grid; return the report of ``evaluate``."""
    config, policy, about = load_run(run, _checkpoint(run, settings))
    commands = grid(settings.x, settings.y, settings.yaw, False)
    wanted = subset(EvalConfig, settings, commands=commands)
    measures = bind_list("measure", list(settings.measures), "evaluation.measures")
    return {"policy": about, "robot": {}, **evaluate(config.task, policy, wanted, on_step, measures), "criteria": []}


def evaluate_missing(
    wanted: Sequence[Wanted], settings: EvaluationSettings, on_run: Callable[[int, int, str], Progress]
) -> list[str]:
    """Evaluate runs one by one into their folders; return remarks; raise TooLongError if memory is too small.

    ``on_run`` gets the number of an evaluation, that of all, and its label, and returns a progress callback.
    """
    notes = []
    for number, (run, protocol) in enumerate(wanted, 1):
        label = f"{run.label}, {protocol.key if protocol else GRID}"
        show = on_run(number, len(wanted), label)
        try:
            if protocol is None:
                write(evaluate_run(run.folder, settings, show), run.folder / FILE)
            else:
                play_protocol(run, protocol, settings, show)
        except TooLongError as error:  # asked of every run: none could be evaluated
            group = "" if protocol else "evaluation."
            raise TooLongError([group + problem for problem in error.problems]) from None
        except (OSError, RuntimeError, ValueError) as error:
            notes.append(f"{label}: could not be evaluated ({' '.join(str(error).split())[:160]})")
    return notes
