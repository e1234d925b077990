"""A search for settings with Optuna: trials are jobs of a sweep, drawn one after the other and ended early if hopeless.

Optuna draws, keeps the trials in a database, and says which are hopeless; a trial is a process as any job is
(``command.py``), and what it learns is read from its ``metrics.csv``. The same search on several machines shares the
database and the folder.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from go1exp.base.errors import Expected
from go1exp.base.files import write_json
from go1exp.config.schema.registry import Count, CountOrZero
from go1exp.config.schema.settings import settings
from go1exp.train.early_stop import file_of, logged
from go1exp.train.sweep import index, trials
from go1exp.train.sweep.command import CORES, PARENT, Command, Ended, Running
from go1exp.train.sweep.launchers import shares
from go1exp.train.sweep.trials import FOLDER, LOOK_S

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial


@settings
class TuneSettings:
    """``conf/tune.yaml``.

    Attributes:
        space: what to draw from, such as ["ppo.gamma=interval(0.97,0.995)"]; also tag(log,interval(..)), range(..),
            choice(..).
        overrides: settings of every trial, such as ["experiment=minute"].
        trials: trainings of the whole search, those of earlier commands and of other machines counted.
        workers: trainings at once on this machine, its cores shared out.
        metric: column of metrics.csv that says how good a training is, or eval/score and others of eval.every.
        direction: whether more of it is better.
        average: newest rows that the metric is averaged over.
        warmup: iterations before a training may be ended early.
        prune: end a training whose metric is below the median of the others at the same iteration.
        storage: where trials are kept, as Optuna names databases; null is a SQLite file in out.
        seed: of the draws; with one worker the same search from nothing draws the same.
        out: folder of the search: a run folder for each trial, and an index as sweeps have.
    """

    space: tuple[str, ...]
    overrides: tuple[str, ...]
    trials: Count
    workers: Count
    metric: Annotated[str, Field(min_length=1)]
    direction: Literal["maximize", "minimize"]
    average: Count
    warmup: CountOrZero
    prune: bool
    storage: str | None
    seed: CountOrZero
    out: Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class Range:
    """What a setting is drawn from.

    Attributes:
        low: least value, of the setting's unit; an int draws whole numbers.
        high: largest value, itself drawn.
        step: between whole numbers.
        log: draw the logarithm evenly.
        choices: values as they are typed, in place of all of these.
    """

    low: float = 0.0
    high: float = 0.0
    step: int = 1
    log: bool = False
    choices: tuple[str, ...] = ()

    @property
    def example(self) -> float | str:
        """A value that may be drawn."""
        return self.choices[0] if self.choices else self.low

    def draw(self, trial: Trial, key: str) -> float | str:
        """Draw for one of Optuna's trials."""
        if self.choices:
            return trial.suggest_categorical(key, list(self.choices))
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(key, self.low, self.high, step=self.step, log=self.log)
        return trial.suggest_float(key, self.low, self.high, log=self.log)


class Search:
    """One search, from its first trial or where it stopped."""

    def __init__(
        self, settings: TuneSettings, ranges: dict[str, Range], plan: Callable[[Sequence[str], Path], None]
    ) -> None:
        """Prepare it.

        Args:
            settings: of the search.
            ranges: key of a setting -> what it is drawn from.
            plan: ``(overrides, run folder)``, makes the folder of a trial; raises ConfigError.
        """
        self.settings, self.ranges, self.plan = settings, ranges, plan
        self.folder = Path(settings.out).absolute()
        self._lock = threading.Lock()
        self._running: dict[int, Running] = {}
        self._stopping = self._some_left = False

    def run(self) -> FrozenTrial | None:
        """Run the trials that are left; return Optuna's best one, None if none has a value.

        Raises:
            KeyboardInterrupt: after a person stopped it; what ran has saved a checkpoint, and goes on next time.
            Expected: if the storage cannot be reached, or holds a search over other settings.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        study = self._study()
        self._some_left = trials.put_back(study, self.folder)
        cores = sorted(os.sched_getaffinity(0))
        free = shares(cores, self.settings.workers)
        with trials.alive(self.folder) as name, ThreadPoolExecutor(self.settings.workers) as pool:
            workers = [pool.submit(self._work, study, share, name) for share in free]
            try:
                for worker in workers:
                    worker.result()
            except BaseException:
                self._stop()
                raise
            finally:
                self._write(study)
        finished = [t for t in study.get_trials(deepcopy=False) if t.value is not None and t.state.name == "COMPLETE"]
        return study.best_trial if finished else None

    def _study(self) -> Study:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        settings = self.settings
        storage = settings.storage or f"sqlite:///{self.folder / 'optuna.db'}"
        pruner = optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=settings.warmup)
        try:
            study = optuna.create_study(
                study_name=self.folder.name,
                storage=storage,
                pruner=pruner if settings.prune else optuna.pruners.NopPruner(),
                direction=settings.direction,
                load_if_exists=True,
            )
        except Exception as error:  # SQLAlchemy's, Optuna's, a driver's
            result = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise Expected(f"storage = {storage!r}: cannot be used ({result})") from None
        about = {"metric": settings.metric, "space": sorted(self.ranges)}
        if any(study.user_attrs.get(key, value) != value for key, value in about.items()):  # killed, it may have one
            raise Expected(f"{self.folder}: holds a search for {study.user_attrs}; use another out")
        for key, value in about.items():
            study.set_user_attr(key, value)
        return study

    def _work(self, study: Study, share: tuple[int, ...], search: str) -> None:
        """Run one trial after the other on the cores of ``share``; ``search`` is the name of this search."""
        while not self._stopping:
            with self._lock:
                if self._some_left:
                    self._some_left = trials.put_back(study, self.folder, patience=0.0)
                counted = [t for t in study.get_trials(deepcopy=False) if t.state.name not in ("FAIL", "WAITING")]
                full = len(counted) >= self.settings.trials
                if full and not any(trials.is_nameless(t) for t in counted):
                    return
                if not full:
                    trial = trials.ask(study)
                    trial.set_user_attr(trials.SEARCH, search)
                    study.sampler = trials.sampler(self.settings.seed, trial.number, self.settings.workers > 1)
                    drawn = {key: drawn_from.draw(trial, key) for key, drawn_from in self.ranges.items()}
            if full:  # whether the nameless one counts is known in a minute
                time.sleep(trials.LOOK_S)
                continue
            self._try(study, trial, drawn, share)

    def _try(self, study: Study, trial: Trial, drawn: dict[str, float | str], share: tuple[int, ...]) -> None:
        import optuna

        run = self.folder / trial.user_attrs.get(FOLDER, f"trial-{trial.number:04}")
        trial.set_user_attr(FOLDER, run.name)
        overrides = [*self.settings.overrides, *(f"{key}={value}" for key, value in drawn.items())]
        try:
            with self._lock:  # composing is not made for threads
                self.plan(overrides, run)
        except BaseException:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            raise
        how, values, hopeless = self._train(trial, run, share)
        if self._stopping:
            trials.go_on(study, trial, run.name)
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            result = "stopped; goes on next time"
        elif hopeless:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            result = f"ended early at iteration {values[-1][0]}: {values[-1][1]:.5g}"
        elif how.status == 0 and values:
            study.tell(trial, values[-1][1])
            result = f"{values[-1][1]:.5g}"
        else:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            result = f"failed ({how.cause or f'{file_of(self.settings.metric)} has no {self.settings.metric}'})"
        with self._lock:
            self._write(study)
            words = " ".join(f"{key}={value}" for key, value in drawn.items())
            print(f"trial {trial.number}: {result}  {words}", flush=True)

    def _train(self, trial: Trial, run: Path, share: tuple[int, ...]) -> tuple[Ended, list[tuple[int, float]], bool]:
        words = (sys.executable, "-m", "go1exp.cli.child", PARENT, CORES, "train", f"resume='{run}'")
        command = Command(
            (*words, f"hydra.run.dir='{run}'", "hydra.output_subdir=null"), os.getcwd(), str(run / "job.log")
        )
        command = replace(command, cores=share, variables={"OMP_NUM_THREADS": str(len(share))})
        running = Running(command)
        self._running[trial.number] = running
        ended: list[Ended] = []
        waiting = threading.Thread(target=lambda: ended.append(running.wait()))
        waiting.start()
        hopeless, newest = False, 0
        while waiting.is_alive():
            waiting.join(LOOK_S)
            values = self._values(run)
            for iteration, value in values:
                if iteration > newest and not hopeless:
                    trial.report(value, iteration)
                    newest, hopeless = iteration, trial.should_prune()
                    if hopeless:
                        values = [v for v in values if v[0] <= iteration]
                        running.stop()
        self._running.pop(trial.number, None)
        return ended[0], self._values(run), hopeless

    def _values(self, run: Path) -> list[tuple[int, float]]:
        rows, newest = list(logged(run, self.settings.metric)), self.settings.average
        return [
            (iteration, sum(v for _, v in rows[max(0, k + 1 - newest) : k + 1]) / min(k + 1, newest))
            for k, (iteration, _) in enumerate(rows)
        ]

    def _stop(self) -> None:
        self._stopping = True
        if self._running:
            print(f"\nstopping {len(self._running)} trials after the iteration under way", file=sys.stderr, flush=True)
        for running in list(self._running.values()):
            running.stop()

    def _write(self, study: Study) -> None:
        """Write the trials as the index of a sweep, and the best one's settings."""
        begun = [t for t in study.get_trials(deepcopy=False) if FOLDER in t.user_attrs and t.params]
        newest = {t.user_attrs[FOLDER]: t for t in begun}  # one that went on has its folder from an older one
        jobs = []
        for number, (name, trial) in enumerate(newest.items()):
            drawn = tuple(f"{key}={value}" for key, value in trial.params.items())
            state, cause = STATES[trial.state.name]
            jobs.append(index.Job(number, " ".join(drawn), (*self.settings.overrides, *drawn), name, state, cause))
        index.write(self.folder, index.Index(tuple(jobs), {"name": "tune"}, os.getcwd()))
        best = [t for t in begun if t.state.name == "COMPLETE"]
        if best:
            best_trial = study.best_trial
            write_json(self.folder / "best.json", {"value": best_trial.value, "overrides": best_trial.params})


STATES: dict[str, tuple[index.JobState, str]] = {
    "COMPLETE": ("done", ""),
    "PRUNED": ("done", "ended early"),
    "RUNNING": ("running", ""),
    "WAITING": ("waiting", ""),
    "FAIL": ("failed", ""),
}
"""Optuna's state of a trial -> that of a job, and its cause."""
