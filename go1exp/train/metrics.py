"""Where metrics go: CSV that a resumed run continues byte for byte, TensorBoard, Weights & Biases."""

from __future__ import annotations

import csv
import os
import uuid
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from go1exp.config import LoggerConfig, WandbConfig
from go1exp.schema.registry import Expected

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
        whole = [r for r in rows[1:] if len(r) == len(rows[0]) and int(float(r[0])) <= iteration]
        partial = path.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            csv.writer(file).writerows([rows[0], *whole])
        os.replace(partial, path)

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


class WandbWriter(KVWriter):
    """Sends metrics to a Weights & Biases run; a resumed run continues under the same id."""

    def __init__(self, run: Path, config: WandbConfig, settings: dict[str, Any]) -> None:
        try:
            import wandb
        except ImportError as error:
            raise Expected("logger=wandb needs the package wandb: pip install wandb, or use logger=local") from error
        identity = run / "wandb_id"
        if not identity.exists():
            identity.write_text(uuid.uuid4().hex[:8])
        self._run = wandb.init(
            project=config.project,
            entity=config.entity,
            group=config.group,
            mode=config.mode,
            id=identity.read_text(),
            resume="allow",
            dir=str(run),
            config=settings,
            settings=wandb.Settings(x_disable_stats=True, silent=True),
        )

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Log a row at ``step`` environment steps."""
        self._run.log(dict(key_values), step=step)

    def close(self) -> None:
        """Finish the run."""
        self._run.finish()


def make_logger(config: LoggerConfig, run: Path, iteration: int, settings: dict[str, Any]) -> Logger:
    """Build SB3's logger with the configured writers; ``iteration`` is the one that training continues from."""
    writers: list[KVWriter] = []
    if config.tensorboard:
        try:
            writers.append(TensorBoardOutputFormat(str(run / "tensorboard")))
        except AssertionError:
            print("tensorboard is not installed: metrics go to the other writers only")
    if config.csv:
        writers.append(CsvWriter(run, iteration))
    if config.wandb is not None:
        writers.append(WandbWriter(run, config.wandb, settings))
    return Logger(str(run), writers)
