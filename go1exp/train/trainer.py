"""One training run, from configuration to the last checkpoint."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType, TracebackType

import numpy as np
import torch
from stable_baselines3.common.logger import Logger

from go1exp.base import signals
from go1exp.base.files import opened, write_json
from go1exp.config.schema.physics import fitting_step
from go1exp.config.schema.registry import Expected
from go1exp.sim.effects.rules import nested_actuators
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import device_of
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TaskConfig, TrainConfig, parse_train
from go1exp.train import checkpoint, metrics, preflight, run_folder
from go1exp.train.asynchronous import AsyncEvaluation
from go1exp.train.device import DevicePPO
from go1exp.train.early_stop import EarlyStop
from go1exp.train.group import Group, together
from go1exp.train.policy import Weights, begin_with
from go1exp.train.ppo import AdaptivePPO
from go1exp.train.schedule import Schedule

LINE_PERIOD = 15.0
"""Least time between two lines when there is no terminal, s."""


class Progress:
    """Steps per second, time left, return, KL, learning rate and terrain level of a training run."""

    def __init__(self, iteration: int, iterations: int, steps_per_iteration: int) -> None:
        self._first, self._last, self._size = iteration, iterations, steps_per_iteration
        self._start = time.monotonic()
        self._printed = -LINE_PERIOD
        self._bar: Bar | None = None
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            self._bar = Bar(
                TextColumn("{task.completed:.0f}/{task.total:.0f}"),
                BarColumn(bar_width=20),
                TimeRemainingColumn(),
                TextColumn("{task.description}"),
                console=Console(stderr=True),
            )
            self._bar.add_task("starting", total=iterations, completed=iteration)

    def __enter__(self) -> Progress:
        """Show the bar."""
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar's last state on the screen."""
        if self._bar:
            self._bar.stop()

    def update(self, iteration: int, metrics: dict[str, float]) -> None:
        """Show the metrics of ``iteration``."""
        elapsed = time.monotonic() - self._start
        rate = (iteration - self._first) * self._size / max(elapsed, 1e-9)
        parts = [f"{rate:,.0f} steps/s"]
        for key, label, form in (
            ("rollout/return", "return", "{:.2f}"),
            ("rollout/length", "length", "{:.0f} steps"),
            ("train/kl", "KL", "{:.4f}"),
            ("train/learning_rate", "lr", "{:.1e}"),
            ("curriculum/terrain_level", "terrain", "{:.2f}"),
        ):
            if key in metrics and not math.isnan(metrics[key]):
                parts.append(f"{label} {form.format(metrics[key])}")
        text = "  ".join(parts)
        if self._bar:
            self._bar.update(self._bar.task_ids[0], completed=iteration, description=text)
        elif elapsed - self._printed >= LINE_PERIOD or iteration == self._last:
            self._printed = elapsed
            left = (self._last - iteration) * elapsed / max(iteration - self._first, 1)
            print(f"iteration {iteration}/{self._last}  {text}  {duration(left)} left", file=sys.stderr, flush=True)

    def say_ramps(self, iteration: int, begun: Sequence[str], schedule: Schedule) -> None:
        """Print which ramps begin; at half the training and at its end warn of those that have not begun."""
        if begun:
            self._say(f"iteration {iteration}: these ramps begin: {', '.join(begun)}")
        if iteration in (self._last // 2, self._last) and (waiting := schedule.waiting()):
            self._say(f"warning: iteration {iteration}/{self._last}: these ramps have not begun: {waiting}")

    def _say(self, text: str) -> None:
        if self._bar:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Return a duration as text, in seconds below two minutes."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.1f} min"


LAST_PRESS = 3
"""The Ctrl-C that ends training without a checkpoint of the iteration under way."""


class EndedEarly(Exception):
    """The rule of ``stop`` has ended a training, which is complete."""


class Stopped(Expected):
    """A signal asked training to stop, and the iteration that was under way is complete and saved.

    Attributes:
        finished: whether it was the last one anyway.
    """

    def __init__(self, message: str, finished: bool) -> None:
        super().__init__(message)
        self.finished = finished


def trained_task(config: TrainConfig) -> TaskConfig:
    """Return the task with the physics step of the training; a net with a history of its own spacing keeps its step."""
    factor, task = config.ppo.coarse_physics, config.task
    if factor == 1 or any(term.parameters.get("period") == "exact" for term, _ in nested_actuators(task.actuator)):
        return task
    step = fitting_step(task.sim.policy_dt, factor * task.sim.physics_dt)
    return replace(task, sim=replace(task.sim, physics_dt=step))


def build(config: TrainConfig, group: Group | None = None) -> AdaptivePPO:
    """Build learner and environment, of a member of ``group`` with its share of the robots.

    Raises:
        ConfigError: if a device is not there.
    """
    preflight.check_devices(config)
    if config.process.torch_threads:
        torch.set_num_threads(config.process.torch_threads)
    group, seed = group or Group(), config.process.seed
    local = group.rows(config.ppo.num_envs)
    share = {"num_envs": local.stop - local.start, "first_env": local.start}
    share["changing"] = {ramp.path for ramp in config.schedule.values()}
    core = Go1Core(trained_task(config), seed=seed, **share, spread_starts=config.task.sim.spread_starts, critic=True)
    device = str(core.device) if config.process.device == "auto" else config.process.device
    if core.device.type == torch.device(device).type == "cuda" or group.size > 1:
        ppo: AdaptivePPO = DevicePPO(config.ppo, Go1VecEnv(core), seed, device, config.estimator, group)
    else:
        ppo = AdaptivePPO(config.ppo, Go1VecEnv(core), seed, device, config.estimator)
    ppo.schedule = Schedule(config.schedule, core, config.ppo.num_envs * config.ppo.steps, config.ppo.iterations)
    return ppo


def train(config: TrainConfig, container: dict[str, object], run: Path, first: Weights | None = None) -> AdaptivePPO:
    """Train in ``run``, from its newest checkpoint if it has one, on as many GPUs as asked for; return the learner.

    SIGINT, SIGTERM and SIGHUP end training after the iteration under way, with a checkpoint. A third SIGINT ends it at
    once; the checkpoints that are there stay.

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
    backend = "nccl" if device_of(config.task.backend).type == "cuda" else "gloo"
    with together(config.process.devices, train_as_member, container, run, backend) as group:
        ppo = _begun(config, run, first, group)
        logger = metrics.make_logger(config.logger, run, ppo.iteration, container, ppo.num_timesteps)
        size = config.ppo.num_envs * config.ppo.steps
        evaluation = AsyncEvaluation(
            config, run, ppo.iteration, lambda steps, file: metrics.log_video(logger, steps, file)
        )
        stop = EarlyStop(config.stop, run, ppo.iteration)
        with Progress(ppo.iteration, config.ppo.iterations, size) as progress, _signals() as asked_to_stop:
            ppo.after_iteration = _Closing(config, run, logger, progress, asked_to_stop, evaluation, stop)
            complete = False
            try:
                _learn(ppo, config, logger)
                complete = True
            except NumericalFault as fault:
                _keep(fault, run)
                raise
            finally:
                _close(ppo, logger, evaluation, complete)
    return ppo


def _close(ppo: AdaptivePPO, logger: Logger, evaluation: AsyncEvaluation, complete: bool) -> None:
    """End the asynchronous evaluation, after its jobs if the training is complete, and close the logs."""
    figures = evaluation.finish(wait=complete)
    for problem in evaluation.problems:
        print(problem)
    if evaluation.skipped:
        print(f"{evaluation.skipped} evaluations or videos were skipped: their process is slower than the training")
    if figures:
        for key, value in figures.items():
            logger.record(key, value)
        metrics.dump_late(logger, ppo.num_timesteps)
    logger.close()


def train_as_member(container: dict[str, object], run: Path, group: Group) -> None:
    """Train as another member of ``group`` than its first: without files, log and signal handlers."""
    config = parse_train(run_folder.with_kept_plugins(run, container))
    ppo = _begun(config, run, None, group)
    logger = Logger(None, [])
    ppo.after_iteration = _Closing(config, run, logger, None, lambda: False)
    try:
        _learn(ppo, config, logger)
    except NumericalFault as fault:
        _keep(fault, run)
        raise
    except Stopped:
        pass


def _learn(ppo: AdaptivePPO, config: TrainConfig, logger: Logger) -> None:
    ppo.set_logger(logger)
    left = config.ppo.iterations * config.ppo.num_envs * config.ppo.steps - ppo.num_timesteps
    if left > 0:
        try:
            ppo.learn(left, reset_num_timesteps=ppo.iteration == 0)
        except EndedEarly as ended:
            print(f"ended early: {ended}")


def _begun(config: TrainConfig, run: Path, first: Weights | None, group: Group) -> AdaptivePPO:
    ppo = build(config, group)
    latest = group.agreed(checkpoint.load_latest(run)[1].name if group.first and checkpoint.checkpoints(run) else None)
    if latest:
        path = run / "checkpoints" / latest
        checkpoint.restore(ppo, checkpoint.read(path))
        if group.first:
            print(f"continuing from {path}")
    elif first is not None:
        begin_with(ppo, first, run)
    group.share_weights(ppo.policy)
    return ppo


@dataclass
class _Closing:
    """End of an iteration: metrics, progress, schedule, checkpoint, and the end of training if requested."""

    config: TrainConfig
    run: Path
    logger: Logger
    progress: Progress | None
    asked_to_stop: Callable[[], bool]
    evaluation: AsyncEvaluation | None = None
    stop: EarlyStop | None = None
    _clock: float = field(default_factory=time.monotonic)

    def __call__(self, ppo: AdaptivePPO) -> None:
        """Close the iteration that ``ppo`` has just completed."""
        steps, now = self.config.ppo.steps, time.monotonic()
        self.logger.record("iteration", ppo.iteration)
        self.logger.record("time/steps_per_s", self.config.ppo.num_envs * steps / (now - self._clock))
        self._clock = now
        figures = ppo.group.metrics(ppo.core.drain_metrics(steps)) | ppo.schedule.metrics()
        figures |= self.evaluation.collect() if self.evaluation else {}
        for key, value in figures.items():
            self.logger.record(key, value)
        logged = dict(self.logger.name_to_value)
        if self.progress:
            self.progress.update(ppo.iteration, logged)
        self.logger.dump(step=ppo.num_timesteps)
        measures = {name: logged[name] for name in ppo.schedule.measures if name in logged}
        begun = ppo.schedule.advance(ppo.num_timesteps, ppo.group.agreed(measures) if ppo.schedule.measures else {})
        last = ppo.iteration >= self.config.ppo.iterations
        if self.progress:
            self.progress.say_ramps(ppo.iteration, begun, ppo.schedule)
        reason = ppo.group.agreed(self.stop.reason(ppo.iteration, logged) if self.stop and not last else "")
        stopping = ppo.group.agreed(self.asked_to_stop())
        if last or stopping or reason or ppo.iteration % self.config.checkpoint.every == 0:
            checkpoint.save(ppo, self.run, self.config.checkpoint.keep)
        if self.evaluation:
            self.evaluation.offer(ppo, last=last or bool(reason))
        if reason:
            if self.stop:
                self.stop.note(ppo.iteration, reason)
            raise EndedEarly(reason)
        if stopping:
            raise Stopped(f"stopped after iteration {ppo.iteration}", finished=last)


def _keep(fault: NumericalFault, run: Path) -> None:
    with opened(run / "fault.npz") as file:
        np.savez(file, allow_pickle=False, **fault.dump)
    write_json(run / "fault.json", {"quantity": fault.quantity, "message": str(fault)}, indent=None)


@contextmanager
def _signals() -> Iterator[Callable[[], bool]]:
    """Turn signals into a request to stop; the third Ctrl-C has its usual effect.

    SIGTERM and SIGHUP stay a request however often they arrive: the end of a terminal sends several.
    """
    received: list[int] = []
    usual = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        presses = received.count(signal.SIGINT)
        if presses == LAST_PRESS:
            signal.signal(signal.SIGINT, usual)
            os.kill(os.getpid(), signal.SIGINT)
        elif presses == LAST_PRESS - 1 and number == signal.SIGINT:
            signals.say(
                "\nheard; stopping when this iteration's checkpoint is written (Ctrl-C again: at once, without it)"
            )
        elif len(received) == 1:
            signals.say("\nstopping after this iteration, with a checkpoint")
        if number == signal.SIGHUP:
            signals.leave_terminal()

    with signals.handled(note):
        yield lambda: bool(received)
