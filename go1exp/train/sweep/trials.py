"""Optuna's trials of several searches: what each is drawn with, and which of them do not run any more.

A search that was killed could not say what became of its trials, and Optuna counts them as running for ever. So each
search holds a lock in the folder while it lives, and its trials name it.
"""

from __future__ import annotations

import contextlib
import shutil
import time
import uuid
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.train import run_state

if TYPE_CHECKING:
    import optuna
    from optuna.trial import BaseTrial, FrozenTrial

FOLDER = "folder"
"""Attribute of a trial that was stopped, and of the one that goes on with it: its run folder."""

CONTINUES = "continues"
"""Attribute of a trial that goes on with another one: the number of that."""

SEARCH = "search"
"""Attribute of a trial: the name of the search that runs it."""

SEARCHES = ".searches"
"""In the folder of trials: a folder for each search that has not ended by itself, locked while that lives."""

NAMELESS = timedelta(minutes=1)
"""Longest time between a trial's start and the name of its search."""

LOOK_S = 0.5
"""Time between two looks at a run folder that is in use, s."""


@contextlib.contextmanager
def alive(folder: Path) -> Iterator[str]:
    """Be a search that others can see to be alive; give its name."""
    name = uuid.uuid4().hex
    with run_state.locked(folder / SEARCHES / name):
        yield name
    shutil.rmtree(folder / SEARCHES / name, ignore_errors=True)  # after an exception it tells that its trials are free


def sampler(seed: int, number: int, parallel: bool) -> optuna.samplers.TPESampler:
    """Return what draws the settings of one trial.

    A sampler that lived as long as its process would draw the same again in every process that goes on, and on every
    machine that joins. The number of a trial is its own on all of them.

    Args:
        seed: of the search.
        number: of the trial.
        parallel: other trials run meanwhile; do not draw close to them.
    """
    import numpy as np
    import optuna

    (word,) = np.random.SeedSequence([seed, number]).generate_state(1)
    return optuna.samplers.TPESampler(seed=int(word), constant_liar=parallel)


PATIENCE_S = 60.0
"""Longest wait for the training that a killed search left, s; after that the search goes on with others."""


def put_back(study: optuna.Study, folder: Path, patience: float = PATIENCE_S) -> bool:
    """Put the trials of searches that were killed in front, so that they go on in their run folders.

    Returns whether some stay as they are: their trainings still ran after ``patience``, or it is unknown yet whose they
    are.

    Args:
        study: Optuna's.
        folder: of the trials.
        patience: longest wait for trainings to end, s, for all of them together.
    """
    from optuna.trial import TrialState

    until, some_left = time.monotonic() + patience, False
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if _is_run(trial, folder):
            some_left = some_left or is_nameless(trial)
            continue
        run = trial.user_attrs.get(FOLDER, "")
        goes_on = run and not is_superfluous(study, trial)
        if goes_on and not _continuations(study, trial.number) and not _ended(folder / run, until):
            some_left = True
            if patience:
                print(f"trial {trial.number}: its training still runs, so others go first", flush=True)
            continue
        if goes_on:
            go_on(study, trial, run)
        try:
            study.tell(trial.number, state=TrialState.FAIL)
        except (ValueError, RuntimeError):  # another search was quicker
            continue
        result = "goes on now" if goes_on else "counts as failed"
        print(f"trial {trial.number}: its search was killed; {result}", flush=True)
    return some_left


def go_on(study: optuna.Study, trial: BaseTrial, run: str) -> None:
    """Put in front the trial that goes on with a stopped one, unless that is done already.

    To be called before the stopped one counts as failed: a search that is killed between the two has its trial still
    running, and ``put_back`` finds it. Two searches may do so at once; see ``is_superfluous``.

    Args:
        study: Optuna's.
        trial: the stopped one.
        run: name of its run folder.
    """
    if not _continuations(study, trial.number):
        stored = study.get_trials(deepcopy=False)[trial.number]
        params = {**stored.system_attrs.get("fixed_params", {}), **stored.params}  # one killed early has drawn none
        study.enqueue_trial(params, user_attrs={FOLDER: run, CONTINUES: trial.number})


def is_superfluous(study: optuna.Study, trial: BaseTrial) -> bool:
    """Whether an older trial goes on with the same one as this does: two searches may have put it in front at once."""
    continued = trial.user_attrs.get(CONTINUES)
    return continued is not None and min(_continuations(study, continued)) < trial.number


def ask(study: optuna.Study) -> optuna.Trial:
    """Return Optuna's next trial that is not superfluous; those that are have failed."""
    from optuna.trial import TrialState

    while is_superfluous(study, trial := study.ask()):
        study.tell(trial, state=TrialState.FAIL)
    return trial


def _continuations(study: optuna.Study, number: int) -> list[int]:
    """Return the numbers of the trials that go on with trial ``number``."""
    return [t.number for t in study.get_trials(deepcopy=False) if t.user_attrs.get(CONTINUES) == number]


def _is_run(trial: Any, folder: Path) -> bool:
    """Whether a search runs the trial; also where that cannot be known from here."""
    search, run = trial.user_attrs.get(SEARCH), trial.user_attrs.get(FOLDER)
    if search:
        place = folder / SEARCHES / search
        return not place.is_dir() or run_state.in_use(place)  # without it: of a machine with a folder of its own
    if run:  # of a version that named no search
        return not (folder / run).is_dir() or run_state.in_use(folder / run)
    return bool(datetime.now() - trial.datetime_start < NAMELESS)


def is_nameless(trial: FrozenTrial) -> bool:
    """Whether a running trial names neither search nor folder: it has just begun, or its search was killed then."""
    return trial.state.name == "RUNNING" and not {SEARCH, FOLDER} & {*trial.user_attrs}


def _ended(run: Path, until: float) -> bool:
    """Wait ``until`` (``time.monotonic``) for the training that a killed search left; return whether it has ended.

    It ends with a checkpoint after its iteration, if it can: one that is suspended cannot.
    """
    if run_state.in_use(run) and time.monotonic() < until:
        print(f"{run}: waiting for its training to save a checkpoint", flush=True)
    while run_state.in_use(run):
        if time.monotonic() >= until:
            return False
        time.sleep(LOOK_S)
    return True
