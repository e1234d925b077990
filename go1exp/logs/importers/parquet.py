"""Columns of any Parquet file; elements of lists are columns of their own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.logs.importers.source import beginning
from go1exp.logs.recording import KEY, RecordingError


def is_parquet(path: Path) -> bool:
    """Return whether a file begins as Parquet does."""
    return beginning(path)[:4] == b"PAR1"


def column_names(path: Path) -> dict[str, tuple[str, int | None, int]]:
    """Return the names of the columns -> column in the file, place in its lists (None: no list), length of these.

    The first row has the lengths of lists.

    Raises:
        RecordingError: if it is damaged, has no rows, or is a recording.
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


def columns_of(path: Path, wanted: Iterable[str]) -> dict[str, Any]:
    """Return columns of a Parquet file as Arrow has them, elements of lists as columns of their own."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    source = {name: place for name, place in column_names(path).items() if name in set(wanted)}
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
