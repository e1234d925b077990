"""``go1exp train``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

from go1exp.choices import config_folder
from go1exp.cli.app import STOPPED, App, discard, run_dir
from go1exp.cli.quoting import command
from go1exp.cli.runs import run_folder as existing
from go1exp.cli.runs import shipped_policies
from go1exp.compose import key_values
from go1exp.schema.registry import ConfigError, Expected

RESUMABLE = ("ppo.iterations", "checkpoint.every", "checkpoint.keep", "torch_threads", "device", "backend")
"""Settings that a resumed run may change: none of them changes what was computed so far (the last three may change
what comes after in the last bits, and another engine rounds differently). ``backend`` and all that is in it."""


def _resumed(run: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the run's own configuration with the changes that resuming allows."""
    from go1exp.train import run_folder

    config = OmegaConf.create(run_folder.read_as_written(run))
    refused = []
    for override in overrides:
        key, _, value = override.partition("=")
        if key == "resume" or key.lstrip("+").startswith("hydra"):
            continue
        if key == "backend":
            config.backend = OmegaConf.load(f"{config_folder()}/backend/{value}.yaml")
        elif key in RESUMABLE or key.startswith("backend."):
            config.merge_with_dotlist([f"{key}={value}"])
        else:
            refused.append(f"{override}: a resumed run keeps its configuration; only {', '.join(RESUMABLE)} may change")
    if refused:
        raise ConfigError(refused)
    container = OmegaConf.to_container(config)
    assert isinstance(container, dict)
    return {str(k): v for k, v in container.items()}


def _refuse_other(run: Path, container: dict[str, Any]) -> None:
    """Raise ConfigError if ``run`` holds a run with another configuration: it would be neither one nor the other."""
    from go1exp.train import run_folder

    if not (run / "config.yaml").is_file():
        return
    old, new = OmegaConf.create(run_folder.read_as_written(run)), OmegaConf.create(container)
    for key in RESUMABLE:
        OmegaConf.update(old, key, OmegaConf.select(new, key), merge=False)
    before, after = (key_values(OmegaConf.to_container(c)) for c in (old, new))
    differ = sorted(k for k in {*before, *after} if before.get(k) != after.get(k))
    if differ:
        raise ConfigError([f"{run}: holds a run with other settings of {', '.join(differ)}; use another folder"])


def _source(start_from: str) -> Path:
    """Return the folder of the run or shipped policy whose weights are meant; a run folder goes first."""
    if (Path(start_from) / "config.yaml").is_file():
        return Path(start_from)
    there = shipped_policies()
    if start_from not in there:
        known = ", ".join(there) or "none"
        said = f"no run folder (it has no config.yaml) and no shipped policy (there are: {known})"
        raise ConfigError([f"start_from = {start_from!r}: {said}"])
    return there[start_from]


def _task(container: dict[str, Any]) -> int | None:
    from go1exp.config import parse_train

    run = run_dir()
    try:
        config = parse_train(container)
    except ConfigError:
        discard(run)
        raise
    if config.process.resume:
        discard(run)
        run = existing(config.process.resume, "resume")
        container = _resumed(run, list(HydraConfig.get().overrides.task))
        config = parse_train(container)
    else:
        _refuse_other(run, container)

    from go1exp.train import checkpoint, run_folder, start, trainer

    first = None
    try:
        if config.process.start_from and not checkpoint.checkpoints(run):
            first = start.read(config, _source(config.process.start_from))
        trainer.try_out(config)
    except (Expected, ConfigError, FileNotFoundError):
        if not config.process.resume:
            discard(run)
        raise
    run_folder.write(run, container)
    print(f"run folder {run}")
    try:
        trainer.train(config, container, run, first)
    except trainer.Stopped:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # so that the jobs after this one do not start
        print(f"stopped; go on with: {command('train', settings={'resume': run})}")
        return STOPPED
    print(f"done; now: {command('eval', settings={'run': run})}")
    return None


APP = App("train", _task)
