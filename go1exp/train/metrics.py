"""Where metrics go: CSV that a resumed run continues byte for byte, TensorBoard, Weights & Biases."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import HParam, KVWriter, Logger, TensorBoardOutputFormat

from go1exp.base.files import write_text
from go1exp.config.schema.training import EVALUATED
from go1exp.sim.task import LoggerConfig
from go1exp.train.wandb_writer import WandbWriter
from go1exp.train.wandb_writer import check_account as check_account
from go1exp.train.wandb_writer import log_tables as log_tables

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
            if path.exists():
                self._cut(name, path, iteration)

    def _cut(self, name: str, path: Path, iteration: int) -> None:
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        if not rows:
            return
        self._columns[name] = rows[0]
        whole = [r for r in rows[1:] if len(r) == len(rows[0]) and 0 < _number(r[0]) <= iteration]
        text = io.StringIO(newline="")
        csv.writer(text).writerows([rows[0], *whole])
        write_text(path, text.getvalue())

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


def _hparams(settings: dict[str, Any]) -> HParam:
    """Return a configuration as TensorBoard's hyperparameters: numbers, words and switches by their paths."""
    flat: dict[str, bool | float | str] = {}

    def take(value: Any, path: str) -> None:
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


def make_logger(config: LoggerConfig, run: Path, iteration: int, settings: dict[str, Any], steps: int = 0) -> Logger:
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
            print("tensorboard is not installed: metrics go to the other writers only")
    if config.csv:
        writers.append(CsvWriter(run, iteration))
    if config.wandb is not None:
        writers.append(WandbWriter(run, config.wandb, settings))
    return Logger(str(run), writers)
