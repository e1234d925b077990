"""What importers share: finding and opening files, clocks and their episodes, and building a checked recording."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from go1exp import __version__
from go1exp.base.wording import counted
from go1exp.config.schema.registry import explain
from go1exp.logs.recording import KEY, Meta, Recording, RecordingError, problems, stop
from go1exp.robot.go1_fields import TORQUE_NOTE, in_torque_steps

LEVEL = (1.0, 0.0, 0.0, 0.0)  # attitude of an upright base, w-x-y-z
RATE_DIGITS = 6  # significant digits of a rate taken from time stamps


RESTART = 0.5  # least share of the time since the last beginning that a clock loses where it begins anew (chosen)
MOST_STEPS = 10.0
"""Longest step after that, in median steps (chosen): behind a single wrong stamp the clock leaps ahead."""

COARSE = 0.1
"""Share of rows with the time of the row before, from which the clock is rounded; fewer are copies of a row."""

OVERFLOW = (16, 24, 32)  # bits of counters that begin anew at their end

KINDS = {
    b"#ROSBAG": "a ROS 1 bag; make an MCAP of it: rosbags-convert --src FILE.bag --dst FOLDER --dst-storage mcap "
    "(of the package rosbags)",
    b"SQLite format 3": "a .db3 bag of ROS 2 or another SQLite file; make an MCAP of a bag: "
    "mcap convert FILE.db3 FILE.mcap (of the mcap tool), or ros2 bag convert",
    b"\x89MCAP0": "an MCAP log; import it with mcap_joint_state or an importer of its message",
    b"\x28\xb5\x2f\xfd": "compressed by zstd as a whole; unpack it: zstd -d FILE",
    b"\x1f\x8b": "compressed by gzip; unpack it: gunzip FILE",
    b"PK\x03\x04": "a zip archive, as .npz and .xlsx are; save it as CSV or Parquet",
    b"\x89HDF": "HDF5, as .mat of MATLAB may be; save it as CSV or Parquet",
    b"MATLAB": "a .mat of MATLAB; save it as CSV or Parquet",
    b"\x93NUMPY": "an array of NumPy; save it as CSV or Parquet",
    b"PAR1": "Parquet; import it with csv",
}
"""How a file of another kind begins -> what it is, and how to make one that is read."""


def beginning(path: Path) -> bytes:
    """Return the first 4 KiB of a file; of ``run.csv.gz`` and its like, those of what is compressed."""
    import pyarrow as pa

    try:
        with pa.input_stream(str(path)) as stream:
            return bytes(stream.read(4096))
    except OSError:  # not what its ending says
        with path.open("rb") as file:
            return file.read(4096)


def kind(start: bytes) -> str | None:
    """Return what a file is by its first bytes, and how to make one of it that is read; None if unknown."""
    return next((what for magic, what in KINDS.items() if start.startswith(magic)), None)


def files(path: Path, *patterns: str) -> list[Path]:
    """Return ``path`` itself, or the files below the folder ``path`` that match the first pattern of any, by name.

    The ending may be in capitals: ``*.csv`` matches ``RUN.CSV``, too. RecordingError if there is none.
    """
    if path.is_file():
        return [path]
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    present = sorted(file for file in path.rglob("*") if file.is_file())
    for pattern in patterns:
        if matches := [file for file in present if fnmatch(file.name.lower(), pattern.lower())]:
            return matches
    other = next((f"; {f.name} is {what}" for f in present if (what := kind(beginning(f)))), "")
    raise RecordingError(f"{path}: no {' or '.join(patterns)} in this folder{other}")


def restarts(t: np.ndarray) -> list[int]:
    """Return rows where a clock (T,) begins anew, losing half of what passed; none if it steps back otherwise."""
    steps = np.diff(t)
    ordinary = MOST_STEPS * np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    begins, begin = [], 0
    for k in np.flatnonzero(steps < 0).tolist():
        lost, passed = -steps[k], t[k] - t[begin]
        if k + 1 >= len(steps) or passed <= 0 or lost < RESTART * passed or not 0 <= steps[k + 1] <= ordinary:
            return []
        begin = k + 1
        begins.append(begin)
    return begins


def without_repeats(t: np.ndarray) -> np.ndarray:
    """Return the rows (K,) of ``t`` (T,) whose time is not that of the row before."""
    return np.flatnonzero(np.concatenate([[True], np.diff(t) != 0]))


def episodes(labels: np.ndarray | None, t: np.ndarray | None, rows: int) -> list[tuple[str, np.ndarray]]:
    """Return name and rows (K,) of each episode: by its label, and by where the clock ``t`` begins anew."""
    by_label = [("", np.arange(rows))]
    if labels is not None:
        values, first, index = np.unique(labels, return_index=True, return_inverse=True)
        groups = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1])
        by_label = [(_label(values[k]), groups[k]) for k in np.argsort(first)]
    named = []
    for name, part in by_label:
        begins = [] if t is None else restarts(t[part])
        pieces = np.split(part, begins)
        named += [(f"{name}_{k}".strip("_") if begins else name, piece) for k, piece in enumerate(pieces)]
    return named


def _label(value: float | str) -> str:
    """Return the value of an episode's column as a part of a file's name."""
    whole = not isinstance(value, str) and value == int(value)
    return re.sub(r"[^\w.-]+", "_", str(int(value) if whole else value)).strip("_") or "_"


def check_clock(
    where: str, t: np.ndarray, cells: np.ndarray, column: str, place: Callable[[int], str], rows: np.ndarray
) -> None:
    """Raise RecordingError if the time ``t`` (T,), s, does not increase; with its place, its cell, and what to do.

    ``rows`` (T,) are those of the file, of which ``place`` says where each stands.
    """
    if len(t) < 2:
        raise RecordingError(f"{where}: has {counted(len(t), 'row')} of numbers; at least 2 are needed")
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if not back.size:
        return
    k = int(back[0])
    where = f"{where}: column {column!r} (for t): must increase strictly, but {place(int(rows[k + 1]))} has "
    where += f"{cells[k + 1]} after {cells[k]} ({counted(back.size, 'such row')})"
    if bits := overflow(cells):
        raise RecordingError(f"{where}; it is a counter of {bits} bits that overflows: add {2**bits} from there on")
    if steps.max() <= 0 and t[-1] < t[0]:
        raise RecordingError(f"{where}; it runs backward: put the rows in the other order")
    if steps.min() < 0:
        several = "sort the rows by time, or leave such rows out; if the file has several episodes, give their column"
        raise RecordingError(f"{where}; {several} (episode: NAME)")
    if back.size < COARSE * len(steps) or t[-1] <= t[0]:
        raise RecordingError(f"{where}; leave such rows out (drop_repeats: true)")
    hz = (len(t) - 1) / (t[-1] - t[0])
    raise RecordingError(
        f"{where}; its times are rounded: take t out of columns and give rate_hz (about {hz:.3g}), "
        "or keep one row of each time (drop_repeats: true)"
    )


def overflow(cells: np.ndarray) -> int | None:
    """Return the bits of a counter (T,) that begins anew at its end; None if it is no such counter."""
    steps = np.diff(cells.astype(np.float64))
    ahead = steps[steps > 0]
    if cells.dtype.kind not in "iu" or not ahead.size:
        return None
    usual = 10 * float(np.median(ahead))
    return next((b for b in OVERFLOW if ((steps[steps < 0] + 2.0**b) > 0).all() and steps.min() + 2.0**b < usual), None)


@dataclass(frozen=True)
class Arrays:
    """The arrays of one ``.npz`` by key; every error names the file and the key."""

    path: Path
    values: Mapping[str, np.ndarray]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def numbers(self, key: str, *shape: int) -> np.ndarray:
        """Return the array ``key``, ``(T, *shape)`` float64; RecordingError if absent, of another shape or type."""
        values = self._get(key)
        if values.dtype.kind not in "fiub" or values.ndim != 1 + len(shape) or values.shape[1:] != shape:
            wanted = ", ".join(["T", *map(str, shape)]) + ("" if shape else ",")
            raise RecordingError(f"{self.path}: {key}: must be numbers ({wanted}), not {values.dtype} {values.shape}")
        return values.astype(np.float64)

    def names(self, key: str) -> tuple[str, ...]:
        """Return the array of strings ``key``."""
        values = self._get(key)
        if values.dtype.kind != "U" or values.ndim != 1:
            raise RecordingError(f"{self.path}: {key}: must be a list of words, not {values.dtype} {values.shape}")
        return tuple(str(name) for name in values)

    def _get(self, key: str) -> np.ndarray:
        if key not in self.values:
            raise RecordingError(f"{self.path}: no array {key!r}; it has {', '.join(self.values) or 'none'}")
        return self.values[key]


def load_npz(path: Path) -> Arrays:
    """Open a ``.npz`` of plain arrays, nothing is unpickled; RecordingError if damaged, no archive, or of objects."""
    try:
        with path.open("rb") as file:  # opened here, because NumPy does not close a damaged file
            archive = np.load(file, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("one bare array")
            return Arrays(path, {key: archive[key] for key in archive.files})
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        # NumPy's message advises to allow pickles
        reason = "no zip archive of them" if "pickle" in str(error) else error
        raise RecordingError(f"{path}: not a whole .npz of plain arrays ({reason})") from error


def is_parquet(path: Path) -> bool:
    """Return whether a file begins as Parquet does."""
    return beginning(path)[:4] == b"PAR1"


def parquet_names(path: Path) -> dict[str, tuple[str, int | None, int]]:
    """Return the names of the columns -> column in the file, place in its lists (None: no list), length of these.

    The first row has the lengths of lists. RecordingError if it is damaged, has no rows, or is a recording.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            if KEY in (file.metadata.metadata or {}):
                raise RecordingError(f"{path}: is a recording already; there is nothing to import")
            first = next(file.iter_batches(batch_size=1), None)
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: not a whole Parquet file ({str(error).splitlines()[0]})") from error
    if first is None or first.num_rows == 0:
        raise RecordingError(f"{path}: has no rows of numbers")
    places: dict[str, tuple[str, int | None, int]] = {}
    for name, (value,) in first.to_pydict().items():
        if isinstance(value, list):
            places |= {f"{name}[{k}]": (name, k, len(value)) for k in range(len(value))}
        else:
            places[name] = (name, None, 0)
    return places


def parquet_columns(path: Path, wanted: Iterable[str]) -> dict[str, Any]:
    """Return columns of a Parquet file as Arrow has them, elements of lists as columns of their own."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    source = {name: place for name, place in parquet_names(path).items() if name in set(wanted)}
    try:
        table = pq.read_table(path, columns=list(dict.fromkeys(name for name, *_ in source.values())))
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: not a whole Parquet file ({str(error).splitlines()[0]})") from error
    columns = {}
    for ours, (name, k, width) in source.items():
        column = table.column(name).combine_chunks()
        if k is not None:
            lengths = np.asarray(column.value_lengths().fill_null(0)) if hasattr(column, "value_lengths") else width
            if np.any(lengths != width) or column.null_count:
                raise RecordingError(f"{path}: column {name!r}: its lists are not all of {width} elements, as row 0's")
            column = column.flatten()[k::width]
        columns[ours] = pa.chunked_array([column])
    return columns


def rate(path: Path, t: np.ndarray) -> float:
    """Return the sampling rate, Hz: one by the median step of ``t``; RecordingError unless two stamps advance."""
    if len(t) < 2:
        raise RecordingError(f"{path}: t: has {counted(len(t), 'stamp')}; at least 2 are needed")
    steps = np.diff(t)
    step = float(np.median(steps))
    if not (np.isfinite(step) and step > 0):
        back = np.flatnonzero(~(steps > 0))
        row = int(back[0]) + 1
        rows = counted(back.size, "such row")
        raise RecordingError(
            f"{path}: t: must increase strictly, but row {row} (from 0) has {t[row]} s after {t[row - 1]} s ({rows}); "
            "the times are rounded, or the rows are in another order"
        )
    return float(f"{1 / step:.{RATE_DIGITS}g}")


def recording(path: Path, importer: str, channels: dict[str, np.ndarray], **about: Any) -> Recording:
    """Build a recording and check it; ``about`` are further fields of ``Meta``.

    By default the rate is that of the column ``t``, and the episode has the name of the file. The notes say it where
    the torques of a Go1 have the steps of its packets, as those of ``go1exp deploy`` do. RecordingError naming
    ``path``, if anything breaks the format.
    """
    # What a source does not state is None in the metadata, not a guess.
    known: dict[str, Any] = dict.fromkeys(("base_quat", "kp", "kd", "tau_limit", "excitation", "repeat_of"))
    known |= {"source": "measured", "tool": f"go1exp importer {importer}", "episode": path.stem}
    known |= {"versions": {"go1exp": __version__, "numpy": np.__version__}}
    if "rate_hz" not in about:
        known["rate_hz"] = rate(path, channels["t"])
    try:
        meta = Meta(**(known | about))
    except ValidationError as error:
        stop(path, explain(error, "metadata", Meta.__dataclass_fields__))
        raise  # not reached: an error has lines
    result = Recording(meta, channels, path)
    torques = [values for name, values in channels.items() if name.startswith("tau_est_")]
    if meta.robot == "go1" and torques and in_torque_steps(np.concatenate(torques)):
        result = replace(result, meta=replace(meta, notes="; ".join(filter(None, (meta.notes, TORQUE_NOTE)))))
    stop(path, problems(result))
    return result
