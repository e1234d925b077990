"""Where metrics go: CSV that a resumed run continues byte for byte, TensorBoard, Weights & Biases."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import os
import shlex
import subprocess
import sys
import uuid
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from stable_baselines3.common.logger import HParam, KVWriter, Logger, TensorBoardOutputFormat

from go1exp.base.files import write_text
from go1exp.config.schema.registry import ConfigError, Expected
from go1exp.config.schema.training import EVALUATED, ROWS
from go1exp.sim.task import LoggerConfig, WandbConfig
from go1exp.train.asynchronous import BEST

IDENTITY = "wandb_id"
"""In the run folder: the id under which a resumed run goes on."""

INDEX = "sweep.json"
"""A folder with it is a sweep, whose name is the group of its runs."""

BUNDLE = "bundle.zip"

EXPORTING = 600.0
"""Longest time for packing the bundle, s."""


def _wandb() -> ModuleType:
    try:
        import wandb
    except ImportError as error:
        raise Expected("logger=wandb needs the package wandb: pip install wandb, or use logger=local") from error
    return wandb


def _unless(variable: str, value: Any) -> Any:
    """Return a setting, or what the environment has in its place; wandb itself reads that only once in a process."""
    given = os.environ.get(variable)
    return (given.split(",") if variable == "WANDB_TAGS" else given) if given else value


def wandb_mode(config: WandbConfig) -> str:
    """Return offline, online, disabled or shared: that of the environment, or the configured one."""
    return str(_unless("WANDB_MODE", config.mode))


class WandbWriter(KVWriter):
    """Sends metrics to a Weights & Biases run; a resumed run continues under the same id.

    Its name is the run folder's, its group the sweep's, unless settings or environment have others.
    """

    def __init__(self, run: Path, config: WandbConfig, settings: dict[str, object]) -> None:
        wandb = _wandb()
        identity = run / IDENTITY
        if not identity.exists():
            write_text(identity, _unless("WANDB_RUN_ID", uuid.uuid4().hex[:8]))
        self._folder, self._config, self._step = run, config, 0
        place = run.resolve()
        in_sweep = next((p for p in place.parents if (p / INDEX).is_file()), None)
        self._run = wandb.init(
            project=_unless("WANDB_PROJECT", config.project),
            entity=_unless("WANDB_ENTITY", config.entity),
            group=_unless("WANDB_RUN_GROUP", config.group or (in_sweep.name if in_sweep else None)),
            name=_unless("WANDB_NAME", config.name or place.name),
            tags=_unless("WANDB_TAGS", list(config.tags)),
            notes=_unless("WANDB_NOTES", config.notes),
            mode=wandb_mode(config),
            id=identity.read_text(),
            resume="allow",
            dir=_unless("WANDB_DIR", str(run)),
            config=settings,
            settings=wandb.Settings(x_disable_stats=True, silent=True),
        )

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Log a row at ``step`` environment steps."""
        self._step = max(self._step, step)
        self._run.log(dict(key_values), step=step)

    def video(self, steps: int, file: Path) -> None:
        """Log a video of the policy after ``steps`` environment steps; W&B takes no rows of the past."""
        video = _wandb().Video(str(file), format="mp4", caption=f"after {steps:,} steps")
        self._run.log({"video": video, "video_steps": steps}, step=self._step)

    def close(self) -> None:
        """Log evaluations as a table, checkpoints and bundle as artifacts, and finish the run."""
        if (self._folder / ROWS).is_file():
            with (self._folder / ROWS).open(newline="") as file:
                rows = list(csv.DictReader(file))
            if rows:
                numbers = [{name: float(value) for name, value in row.items()} for row in rows]
                self._run.log({"evaluations": _table(numbers)}, step=self._step)
        if self._config.artifacts:
            self._log_artifacts()
        folder = Path(self._run.dir).parent
        self._run.finish()
        if wandb_mode(self._config) == "offline":
            print(f"logged offline; send it with: wandb sync {shlex.quote(str(folder))}")

    def _log_artifacts(self) -> None:
        checkpoints = sorted((self._folder / "checkpoints").glob("*.pt"))[-1:]
        best = [p for p in (self._folder / BEST, self._folder / "best.json") if p.is_file()]
        if checkpoints:
            self._artifact("checkpoint", "model", [*checkpoints, *best, self._folder / "config.yaml"])
            bundle = _bundle(self._folder)
            if bundle:
                self._artifact("bundle", "bundle", [bundle])

    def _artifact(self, name: str, kind: str, files: Sequence[Path]) -> None:
        artifact = _wandb().Artifact(f"{name}-{self._run.id}", type=kind)
        for file in files:
            if file.is_file():
                artifact.add_file(str(file), name=file.name)
        self._run.log_artifact(artifact)


def _bundle(run: Path) -> Path | None:
    """Pack the run's policy as ``go1exp export`` does, in a process of its own; None with a remark if it cannot."""
    command = [sys.executable, "-m", "go1exp", "export", f"run='{run.resolve()}'"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=EXPORTING)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(f"no bundle for Weights & Biases: {error}")
        return None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason"])[-1]
        print(f"no bundle for Weights & Biases: {reason}")
        return None
    return run / BUNDLE


def _table(rows: Sequence[Mapping[str, object]]) -> Any:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return _wandb().Table(columns=columns, data=[[row.get(name) for name in columns] for row in rows])


def log_tables(
    tables: Mapping[str, Sequence[Mapping[str, Any]]], page: Path, project: str, how: str, folder: Path
) -> None:
    """Log the tables of a report, and its page, as a run of its own.

    Args:
        tables: rows by name.
        page: HTML file.
        project: of Weights & Biases.
        how: offline or online.
        folder: where an offline run is left.
    """
    wandb = _wandb()
    run = wandb.init(
        project=_unless("WANDB_PROJECT", project),
        name=_unless("WANDB_NAME", f"report of {folder.resolve().parent.name}"),
        job_type="report",
        mode=_unless("WANDB_MODE", how),
        dir=_unless("WANDB_DIR", str(folder)),
        settings=wandb.Settings(x_disable_stats=True, silent=True),
    )
    run.log({name: _table(_of_one_kind(rows)) for name, rows in tables.items()} | {"report": wandb.Html(str(page))})
    run.finish()


def _of_one_kind(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return rows whose columns hold numbers or text: W&B refuses columns of both."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: [row.get(name, "") for row in rows] for name in names}
    for name, values in columns.items():
        numbers = all(value == "" or isinstance(value, int | float) for value in values)
        columns[name] = [None if v == "" else float(v) for v in values] if numbers else [str(v) for v in values]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def check_account(config: LoggerConfig) -> None:
    """Refuse to log online to Weights & Biases without a key: it would ask, or fail, when all is built.

    Raises:
        ConfigError: if neither the environment nor a netrc file holds one.
    """
    if config.wandb is None or wandb_mode(config.wandb) != "online":
        return
    try:
        import wandb

        known = wandb.login(prompt=False, verify=False)
    except ImportError:
        return  # the writer says what to install
    except Exception as error:  # a key of a wrong form
        raise ConfigError([f"logger.wandb.mode = 'online': {' '.join(str(error).split())}"]) from None
    if not known:
        raise ConfigError(
            [
                "logger.wandb.mode = 'online': there is no API key; set WANDB_API_KEY, or run wandb login, or use "
                "logger.wandb.mode=offline"
            ]
        )


CLOCK = "time/"
"""Prefix of metrics that depend on the machine's clock; they have a file of their own."""


class CsvWriter(KVWriter):
    """One row per iteration in ``metrics.csv``; wall-clock figures in ``timing.csv``, so the first is reproducible.

    Columns are those of the first row. Rows after ``iteration`` are cut off, so that a run resumed from an older
    checkpoint does not hold an iteration twice.
    """

    def __init__(self, run: Path, iteration: int) -> None:
        self._files = {name: run / name for name in ("metrics.csv", "timing.csv")}
        self._columns: dict[str, list[str]] = {}
        for name, path in self._files.items():
            kept = self._cut(name, path, iteration) if path.exists() else 0
            if kept < iteration:
                warnings.warn(f"{path}: rows of {iteration - kept} of {iteration} iterations are missing", stacklevel=2)

    def _cut(self, name: str, path: Path, iteration: int) -> int:
        rows: list[list[str]] = []
        with path.open(newline="", encoding="utf-8", errors="replace") as file, contextlib.suppress(csv.Error):
            rows = list(csv.reader(file))
        if not rows or rows[0][:2] != ["iteration", "steps"]:
            return 0
        self._columns[name] = rows[0]
        whole = [r for r in rows[1:] if len(r) == len(rows[0]) and 0 < _number(r[0]) <= iteration]
        text = io.StringIO(newline="")
        csv.writer(text).writerows([rows[0], *whole])
        write_text(path, text.getvalue())
        return len(whole)

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append a row to each file."""
        iteration = key_values.pop("iteration")
        parts = {
            "metrics.csv": {k: v for k, v in key_values.items() if not k.startswith(CLOCK)},
            "timing.csv": {k: v for k, v in key_values.items() if k.startswith(CLOCK)},
        }
        for name, values in parts.items():
            row = {"iteration": iteration, "steps": step, **values}
            path = self._files[name]
            try:
                if name not in self._columns:
                    self._columns[name] = list(row)
                    with path.open("w", newline="") as file:
                        csv.writer(file).writerow(self._columns[name])
                with path.open("a", newline="") as file:
                    csv.writer(file).writerow([row.get(c, "") for c in self._columns[name]])
            except OSError as error:
                raise OSError(error.errno, f"metrics cannot be written: {error.strerror}", str(path)) from error
        key_values["iteration"] = iteration

    def close(self) -> None:
        """Nothing is kept open."""


def _number(text: str) -> float:
    """Read an iteration's number; NaN, which is in no range, from what a crash of the machine left of one."""
    try:
        return float(text)
    except ValueError:
        return math.nan


class TensorBoardWriter(TensorBoardOutputFormat):
    """SB3's, which also hides the rows of a run that went on from an older checkpoint: they come once more."""

    def __init__(self, folder: Path, steps: int) -> None:
        super().__init__(str(folder))
        if steps:  # TensorBoard's own mark for it (``SummaryWriter(purge_step)``, which SB3 does not hand on)
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog

            restarted = SessionLog(status=SessionLog.START)
            self.writer._get_file_writer().add_event(Event(session_log=restarted), steps + 1)


def _hparams(settings: dict[str, object]) -> HParam:
    """Return a configuration as TensorBoard's hyperparameters: numbers, words and switches by their paths."""
    flat: dict[str, bool | float | str] = {}

    def take(value: object, path: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                take(inner, f"{path}.{key}" if path else str(key))
        elif isinstance(value, bool | int | float | str):
            flat[path] = value
        elif value is not None:
            flat[path] = str(value)

    take(settings, "")
    return HParam(
        flat, dict.fromkeys(("rollout/return", "rollout/length", "task/fall_share", f"{EVALUATED}score"), 0.0)
    )


def log_video(logger: Logger, steps: int, file: Path) -> None:
    """Log a video of the policy after ``steps`` environment steps, in the writers that take videos."""
    for writer in logger.output_formats:
        if isinstance(writer, WandbWriter):
            writer.video(steps, file)


def dump_late(logger: Logger, steps: int) -> None:
    """Write what was recorded to all writers but the CSV files, which have one row for each iteration."""
    for writer in logger.output_formats:
        if not isinstance(writer, CsvWriter):
            writer.write(dict(logger.name_to_value), dict(logger.name_to_excluded), steps)
    logger.name_to_value.clear()
    logger.name_to_excluded.clear()


def make_logger(config: LoggerConfig, run: Path, iteration: int, settings: dict[str, object], steps: int = 0) -> Logger:
    """Build SB3's logger with the configured writers.

    Args:
        config: which ones.
        run: the run folder.
        iteration: that training continues from: later rows are dropped.
        settings: the run's configuration, for Weights & Biases.
        steps: environment steps at ``iteration``.
    """
    writers: list[KVWriter] = []
    if config.tensorboard:
        try:
            writers.append(TensorBoardWriter(run / "tensorboard", steps))
            if settings and not steps:
                writers[-1].write({"hparams": _hparams(settings)}, {"hparams": ()}, 0)
        except AssertionError:
            print("tensorboard is not installed (pip install 'go1exp[tensorboard]'): metrics go to the other writers")
    if config.csv:
        writers.append(CsvWriter(run, iteration))
    if config.wandb is not None:
        writers.append(WandbWriter(run, config.wandb, settings))
    return Logger(str(run), writers)
