"""``go1exp train``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.base.errors import STOPPED
from go1exp.cli import hydra_main, sweep
from go1exp.cli.app import App, discard
from go1exp.cli.places import run_folder as existing
from go1exp.cli.places import shipped_policies
from go1exp.cli.verbs import command
from go1exp.config.choices import config_folder
from go1exp.config.compose import key_values
from go1exp.config.hydra_adapter import read_yaml, with_values
from go1exp.config.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.sim.task import TrainConfig
    from go1exp.train.policy import Weights

RESUMABLE = (
    *("ppo.iterations", "checkpoint.every", "checkpoint.keep", "torch_threads", "device", "devices", "backend"),
    *("eval", "video", "stop"),
)
"""Settings that a resumed run may change: none of them changes what was computed so far (threads, devices and backend
may change what comes after in the last bits, and another engine rounds differently). Sections, and all in them."""

MOST_NAMED = 8  # settings that differ from those of another run, in a message


def _resumed(run: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the run's own configuration with the changes that resuming allows."""
    from go1exp.train import run_folder

    container = run_folder.read_as_written(run)
    refused = []
    for override in overrides:
        key, _, value = override.partition("=")
        if key == "resume" or key.lstrip("+").startswith("hydra"):
            continue
        if key == "backend":
            container["backend"] = read_yaml(config_folder() / "backend" / f"{value}.yaml")
        elif _may_change(key):
            container = with_values(container, [f"{key}={value}"])
        else:
            refused.append(f"{override}: a resumed run keeps its configuration; only {', '.join(RESUMABLE)} may change")
    if refused:
        raise ConfigError(refused)
    return container


def _may_change(key: str) -> bool:
    return any(key == other or key.startswith(f"{other}.") for other in RESUMABLE)


def _refuse_other(run: Path, container: dict[str, object]) -> None:
    """Raise ConfigError if ``run`` holds a run with another configuration: it would be neither one nor the other."""
    from go1exp.train import run_folder

    if not (run / "config.yaml").is_file():
        return
    before, after = key_values(run_folder.read_as_written(run)), key_values(container)
    differ = [f"plugins ({name} has changed)" for name in run_folder.differing_plugins(run, container)]
    differ += sorted(k for k in {*before, *after} if before.get(k) != after.get(k) and not _may_change(k))
    if differ:
        beyond = f" and {len(differ) - MOST_NAMED} more" if len(differ) > MOST_NAMED else ""
        named = ", ".join(differ[:MOST_NAMED]) + beyond
        raise ConfigError([f"{run}: holds a run with other settings of {named}; use another folder"])


def _source(start_from: str) -> Path:
    """Return the folder of the run or shipped policy whose weights are meant; a run folder goes first."""
    if (Path(start_from) / "config.yaml").is_file():
        return Path(start_from)
    shipped = shipped_policies()
    if start_from not in shipped:
        known = ", ".join(shipped) or "none"
        problem = f"no run folder (it has no config.yaml) and no shipped policy (there are: {known})"
        raise ConfigError([f"start_from = {start_from!r}: {problem}"])
    return shipped[start_from]


@dataclass(frozen=True)
class TrainJob:
    """One requested training: its folder, its configuration, and whether it goes on with an older one."""

    run: Path
    config: TrainConfig
    container: dict[str, Any]
    resumed: bool


def resolved(container: dict[str, object], overrides: list[str], run: Path) -> TrainJob:
    """Return the training of a configuration, in ``run`` unless it resumes; touches no file; raise ConfigError."""
    from go1exp.sim.task import parse_train

    config = parse_train(container)
    if config.process.resume:
        return _planned(existing(config.process.resume, "resume"), overrides)
    _refuse_other(run, container)
    return TrainJob(run, config, container, resumed=False)


def check(job: TrainJob) -> None:
    """Refuse what cannot be trained on this machine, before anything is written."""
    from go1exp.train import preflight

    preflight.check(job.config)


def _task(container: dict[str, object]) -> int | None:
    about = hydra_main.job()
    folder, overrides = about.folder, about.overrides
    try:
        if container.get("sweep"):
            sweep.leave_to_go_on(RULES, APP, str(container["sweep"]), overrides)
        _refuse_one_of_a_sweep(about)
        job = resolved(container, overrides, folder)
        check(job)
    except BaseException:
        discard(folder)
        raise
    if job.resumed:
        discard(folder)
    return _run(job)


def _refuse_one_of_a_sweep(about: hydra_main.Job) -> None:
    """Raise ConfigError where a study or a launcher was chosen without ``-m``.

    Hydra composes one run, of none of the study's values, and would train it here, whatever the launcher.
    """
    if about.multirun:
        return
    given = [o for o in (*about.overrides, *about.of_hydra) if not o.startswith("hydra.mode=")]
    again = command("train", "-m", *given)
    if about.study is not None:
        raise ConfigError([f"study={about.study}: is a sweep and needs -m: {again}"])
    for launcher in given:
        if launcher.startswith("hydra/launcher=") and launcher != "hydra/launcher=basic":
            raise ConfigError([f"{launcher}: starts the jobs of a sweep and needs -m: {again}"])


def _go_on(run: Path, overrides: list[str]) -> int | None:
    job = _planned(run, overrides)
    check(job)
    return _run(job)


def _planned(run: Path, overrides: list[str]) -> TrainJob:
    """Return the training of the folder ``run``, with what ``overrides`` may change; raise ConfigError otherwise."""
    from go1exp.sim.task import parse_train
    from go1exp.train import run_folder

    container = _resumed(run, overrides)
    try:
        config = parse_train(run_folder.with_kept_plugins(run, container))
    except ConfigError:
        run_folder.read_parsed(run)  # where the run itself is not one that this version knows, that names its file
        raise
    return TrainJob(run, config, container, resumed=True)


def plan(job: TrainJob) -> None:
    """Write the run folder of a job that has not begun; one that has begun stays as it is."""
    from go1exp.config.schema import plugins
    from go1exp.train import run_folder, run_state

    if run_state.read(job.run).state == "not started":
        with plugins.restored():
            run_folder.write(job.run, job.container)


def _run(job: TrainJob) -> int | None:
    from go1exp.train import run_state

    with run_state.locked(job.run):
        try:
            if not job.resumed:
                _refuse_other(job.run, job.container)  # again: now no other process can begin one there
            first = _first_weights(job)
            if _is_finished(job):
                return None
        except BaseException:
            if not job.resumed:
                discard(job.run, run_state.FILES)
            raise
        return _train(job, first)


def _first_weights(job: TrainJob) -> Weights | None:
    """Read what ``start_from`` names, unless the run has begun already."""
    from go1exp.train import checkpoint, policy

    source = job.config.process.start_from
    return policy.read_weights(job.config, _source(source)) if source and not checkpoint.checkpoints(job.run) else None


def _is_finished(job: TrainJob) -> bool:
    """Whether the folder holds all iterations already, or was ended by the same rule; print it."""
    from go1exp.train import checkpoint, early_stop, run_state

    wanted = job.config.ppo.iterations
    if reason := early_stop.ended(job.run, job.config.stop):
        run_state.write(job.run, "done")
        print(f"{job.run}: {reason}; now: {command('eval', settings={'run': job.run})}")
        return True
    if checkpoint.iterations_done(job.run) < wanted:
        return False
    done = int(checkpoint.load_latest(job.run)[0]["iteration"])
    if done < wanted:
        return False
    run_state.write(job.run, "done")
    beyond = "" if done == wanted else f", more than the {wanted} asked for"
    print(f"{job.run} has {done} iterations already{beyond}; now: {command('eval', settings={'run': job.run})}")
    return True


def _train(job: TrainJob, first: Weights | None) -> int | None:
    from go1exp.train import checkpoint, run_folder, run_state, trainer

    if job.resumed and run_state.read(job.run).state != "not started" and not checkpoint.checkpoints(job.run):
        print(f"{job.run}: no checkpoint; training begins anew")
    run_folder.write(job.run, job.container)
    run_state.write(job.run, "running")
    print(f"run folder {job.run}", flush=True)
    try:
        trainer.train(job.config, job.container, job.run, first)
    except trainer.Stopped as stopped:
        run_state.write(job.run, "done" if stopped.finished else "stopped")
        if hydra_main.in_multirun():
            raise KeyboardInterrupt from None  # the jobs after this one do not start
        if not stopped.finished:
            print(f"stopped; go on with: {command('train', settings={'resume': job.run})}")
            return STOPPED
    except KeyboardInterrupt:
        run_state.write(job.run, "stopped")
        print(f"stopped; go on with: {command('train', settings={'resume': job.run})}")
        raise
    except Exception as error:
        run_state.note_failure(job.run, APP.cause(error))
        raise
    else:
        run_state.write(job.run, "done")
    print(f"done; now: {command('eval', settings={'run': job.run})}")
    return None


RULES = sweep.Rules(resolved, check, plan, _planned, _go_on)

APP = App("train", _task, sweep=partial(sweep.begin, RULES))
