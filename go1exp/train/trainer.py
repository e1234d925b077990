"""One training run, from configuration to the last checkpoint."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from go1exp.config import TrainConfig
from go1exp.effects.rules import drives
from go1exp.env.core import Go1Core
from go1exp.env.faults import NumericalFault
from go1exp.env.sb3_env import Go1VecEnv
from go1exp.schema.registry import ConfigError, Expected
from go1exp.train import checkpoint, metrics, start
from go1exp.train.device import DevicePPO
from go1exp.train.ppo import AdaptivePPO
from go1exp.train.progress import Progress


class Stopped(Expected):
    """A signal asked training to stop, and the iteration that was under way is complete and saved."""


def build(config: TrainConfig) -> AdaptivePPO:
    """Build learner and environment.

    Raises:
        ConfigError: if the device is not there (SB3 would quietly take another).
    """
    if config.process.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError([f"device = {config.process.device!r}: torch finds no CUDA device; use device=cpu"])
    if config.process.torch_threads:
        torch.set_num_threads(config.process.torch_threads)
    core = Go1Core(config.task, config.ppo.num_envs, config.process.seed, spread_starts=config.task.sim.spread_starts)
    device = str(core.device) if config.process.device == "auto" else config.process.device
    learner = DevicePPO if core.device.type == torch.device(device).type == "cuda" else AdaptivePPO
    return learner(config.ppo, Go1VecEnv(core), config.process.seed, device)


def try_out(config: TrainConfig) -> None:
    """Build one robot, where that can fail for what a file holds: before a run folder says that this run began.

    Raises:
        ConfigError: if an actuator net does not fit the robot or the physics step.
        go1exp.schema.registry.Expected: if its file is damaged.
    """
    if any("file" in term.parameters for term, _ in drives(config.task.actuator)):
        Go1Core(config.task, 1)


def train(config: TrainConfig, container: dict[str, Any], run: Path, first: start.Weights | None = None) -> AdaptivePPO:
    """Train in ``run``, from its newest checkpoint if it has one; return the learner.

    SIGINT and SIGTERM end training after the iteration under way, with a checkpoint; a second one ends it at once.

    Args:
        config: what to train.
        container: the same as plain data, for the loggers.
        run: the run folder, already written.
        first: weights to begin with, unless ``run`` has a checkpoint.

    Raises:
        Stopped: after such a signal.
        NumericalFault: when a number stops being finite; ``fault.npz`` holds the moment.
        OSError: when metrics or a checkpoint cannot be written; what was saved before is untouched.
    """
    ppo = build(config)
    if checkpoint.checkpoints(run):
        state, path = checkpoint.load_latest(run)
        checkpoint.restore(ppo, state)
        print(f"continuing from {path}")
    elif first is not None:
        start.begin(ppo, first, run)
    env = ppo.get_env()
    assert isinstance(env, Go1VecEnv)
    logger = metrics.make_logger(config.logger, run, ppo.iteration, container)
    ppo.set_logger(logger)
    size = config.ppo.num_envs * config.ppo.steps
    clock = [time.monotonic()]

    with Progress(ppo.iteration, config.ppo.iterations, size) as progress, _signals() as asked_to_stop:

        def after_iteration(ppo: AdaptivePPO) -> None:
            now = time.monotonic()
            logger.record("iteration", ppo.iteration)
            logger.record("time/steps_per_s", size / (now - clock[0]))
            clock[0] = now
            for key, value in env.core.drain_metrics(config.ppo.steps).items():
                logger.record(key, value)
            progress.update(ppo.iteration, dict(logger.name_to_value))
            logger.dump(step=ppo.num_timesteps)
            last = ppo.iteration >= config.ppo.iterations
            if last or asked_to_stop() or ppo.iteration % config.checkpoint.every == 0:
                checkpoint.save(ppo, run, config.checkpoint.keep)
            if asked_to_stop() and not last:
                raise Stopped(f"stopped after iteration {ppo.iteration}")

        ppo.after_iteration = after_iteration
        left = config.ppo.iterations * size - ppo.num_timesteps
        try:
            if left > 0:
                ppo.learn(left, reset_num_timesteps=ppo.iteration == 0)
        except NumericalFault as fault:
            np.savez(run / "fault.npz", allow_pickle=False, **fault.dump)
            (run / "fault.json").write_text(json.dumps({"quantity": fault.quantity, "message": str(fault)}) + "\n")
            raise
        finally:
            logger.close()
    return ppo


@contextmanager
def _signals() -> Iterator[Any]:
    """Turn the first SIGINT or SIGTERM into a wish that can be asked for; give the second its usual effect."""
    received: list[int] = []
    usual = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        print("\nstopping after this iteration (again: at once)", flush=True)
        for s, handler in usual.items():
            signal.signal(s, handler)

    for s in usual:
        signal.signal(s, note)
    try:
        yield lambda: bool(received)
    finally:
        for s, handler in usual.items():
            signal.signal(s, handler)
