"""A file of separated values, or Parquet, as columns of numbers; complaints name the file, the column and the line."""

from __future__ import annotations

import codecs
import csv
import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base.wording import counted
from go1exp.logs.importers.source import beginning, is_parquet, kind, parquet_columns, parquet_names
from go1exp.logs.recording import RecordingError

UTF8 = "utf-8"

DELIMITERS = ";\t|,"  # what may stand between two columns, the most certain sign of it first

WITH_SIGN = {
    ",": re.compile(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*"),
    ".": re.compile(r"\s*[-+]?\d*\.\d+([eE][-+]?\d+)?\s*"),
}
"""Decimal sign -> a number that is written with it."""

BLOCK = 2**24  # bytes of a text file that are held at a time; 16 MiB have the types of nearly all columns right

UNIT = re.compile(r"\s*([\[(]?[^\W\d_].*|[\[(]?[°%].*|[\[(]?[-1]?[\])]?)\s*")
"""A cell of a line of units: a word, an empty cell, 1 or a dash."""

_WRONG_WIDTH = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")
"""Arrow's complaint about a row; it counts lines from 1, but not the empty ones below ``skip_lines``."""


@dataclass(frozen=True)
class Layout:
    """How a file is written."""

    header: bool = True  # whether the first line has the names of the columns
    skip_lines: int = 0  # lines before that
    delimiter: str = ","  # what stands between two columns
    decimal: str = "."  # decimal point, or comma
    encoding: str = UTF8  # how characters are written as bytes; a name that Python knows
    units: bool = False  # whether the line below the names has their units; found by ``read``

    @property
    def is_utf8(self) -> bool:
        """Whether the encoding is UTF-8, by whatever name."""
        return codecs.lookup(self.encoding).name == UTF8


@dataclass(frozen=True)
class Table:
    """Columns of a file."""

    columns: dict[str, np.ndarray]  # name -> (T,) numbers; a column of labels may be words
    unused: list[str]  # names of the other columns
    place: Callable[[int], str]  # row from 0 -> where it stands in the file, such as ``line 12``
    units: dict[str, str] = field(default_factory=dict)  # name -> unit, as a line below the names gives it


class _NoNumber(ValueError):
    """A cell that is no number: what it is, and where it stands in the file."""

    def __init__(self, cell: object, place: str) -> None:
        super().__init__(f"must be numbers, but {place} has {cell!r}")
        self.cell = str(cell)


def names(path: Path, layout: Layout) -> list[str]:
    """Return the names of the columns: those of the first line, or 1, 2, 3; of a list, ``name[0]``, ``name[1]``."""
    return list(parquet_names(path)) if is_parquet(path) else list(_text_names(path, layout))


def read(path: Path, wanted: Mapping[str, str], layout: Layout, labels: str | None = None) -> Table:
    """Return the columns that are asked for.

    Args:
        path: the file, text or Parquet.
        wanted: name of a column -> what it is for.
        layout: how a text is written.
        labels: column that may hold words in place of numbers.

    Raises:
        RecordingError: if it is no table, lacks a column, or holds what is no number; with every such column.
    """
    given = None if is_parquet(path) else _text_names(path, layout)
    units = {} if given is None else _units(path, layout, given)
    layout = replace(layout, units=bool(units))
    present = list(parquet_names(path) if given is None else given)
    lacking = [name for name in wanted if name not in present]
    hint = _question(present[0], layout) if len(present) == 1 else _no_names(present, layout)
    # Where the delimiter is another one, or names are missing, no name is right, and one complaint will do.
    wrong = [_missing(path, name, wanted[name], present) + hint for name in (lacking[:1] if hint else lacking)]
    existing = [name for name in wanted if name in present]

    def place(row: int) -> str:
        return f"row {row}" if given is None else f"line {line_of(path, row, layout)}"

    if given is None:
        table = parquet_columns(path, existing)
    else:
        table = _text(path, {name: given[name] for name in existing}, layout)
    values: dict[str, np.ndarray] = {}
    other_sign: list[tuple[str, _NoNumber]] = []
    for name in existing:
        try:
            values[name] = _words(table[name]) if name == labels else _numbers(table[name], place, layout)
        except _NoNumber as error:
            if _other_sign(error.cell, layout):
                other_sign.append((name, error))
            else:
                wrong.append(f"{path}: column {name!r}: {error}{_question(error.cell, layout)}")
        except ValueError as error:
            wrong.append(f"{path}: column {name!r}: {error}")
    if other_sign:
        name, first = other_sign[0]
        others = f" and {counted(len(other_sign) - 1, 'other column')}" if other_sign[1:] else ""
        wrong.append(f"{path}: column {name!r}{others}: {first}{_question(first.cell, layout)}")
    if wrong:
        raise RecordingError("\n".join(wrong))
    return Table(values, [name for name in present if name not in wanted], place, units)


def line_of(path: Path, row: int, layout: Layout) -> int:
    """Return the line of the file, from 1, of a row of numbers, from 0: empty lines are no rows."""
    rows = ((number, text) for number, text in _lines(path, layout) if text)
    return next(islice(rows, row + layout.header + layout.units, None), (row, ""))[0]


def _lines(path: Path, layout: Layout) -> Iterable[tuple[int, str]]:
    """Return the lines of a file below ``skip_lines``, with their numbers from 1."""
    with path.open(encoding=layout.encoding, errors="replace") as file:
        for number, line in enumerate(file, 1):
            if number > layout.skip_lines:
                yield number, line.rstrip("\n")


def _text_names(path: Path, layout: Layout) -> dict[str, str]:
    """Return a text's column names, stripped -> as Arrow has them; RecordingError for no table or a name twice."""
    start = beginning(path)
    if layout.is_utf8 and start[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        raise RecordingError(f"{path}: is UTF-16, not UTF-8; save it as UTF-8, or give encoding: utf-16")
    if b"\0" in start and "16" not in layout.encoding and "32" not in layout.encoding:
        raise RecordingError(f"{path}: is binary, not text: {kind(start) or 'of a kind that is not known'}")
    given = _arrow(path, layout, None)
    stripped = [name.strip() for name in given] if layout.header else [str(k + 1) for k in range(len(given))]
    twice = sorted({name for name in stripped if stripped.count(name) > 1})
    if twice:
        called = ", ".join(map(repr, twice))
        raise RecordingError(f"{path}: two columns are called {called}; names must differ{_no_names(stripped, layout)}")
    return dict(zip(stripped, given, strict=True))


def _units(path: Path, layout: Layout, given: Mapping[str, str]) -> dict[str, str]:
    """Return the unit of each column if the line below the names has units, and the next one numbers; else nothing."""
    rows = csv.reader((line for _, line in _lines(path, layout) if line), delimiter=layout.delimiter)
    below, first = ([*islice(rows, 1, 3), [], []])[:2] if layout.header else ([], [])
    if len(below) != len(given) or not any(re.search(r"[^\W\d_]|[°%]", cell) for cell in below):
        return {}
    if any(not UNIT.fullmatch(c) or c.strip().lower() in ("nan", "inf", "na", "null", "true", "false") for c in below):
        return {}
    if not first or any(re.search(r"\d", c) is None for c in first if c.strip()):
        return {}
    return dict(zip(given, (cell.strip() for cell in below), strict=True))


def _text(path: Path, wanted: Mapping[str, str], layout: Layout) -> dict[str, Any]:
    """Return columns of a text as Arrow has them; ``wanted`` is our name -> Arrow's name."""
    table = _arrow(path, layout, list(wanted.values()))
    if table.num_rows == 0:
        raise RecordingError(f"{path}: has no rows of numbers")
    return {ours: table.column(theirs) for ours, theirs in wanted.items()}


def _arrow(path: Path, layout: Layout, wanted: list[str] | None) -> Any:
    """Return columns of a text as Arrow's table, names of all if ``wanted`` is None; RecordingError if it is none."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    parse = arrow_csv.ParseOptions(delimiter=layout.delimiter)
    convert = arrow_csv.ConvertOptions(decimal_point=layout.decimal, include_columns=wanted)

    def options(block: int) -> Any:
        return arrow_csv.ReadOptions(
            use_threads=False,
            block_size=block,
            skip_rows=layout.skip_lines,
            skip_rows_after_names=int(layout.units),
            autogenerate_column_names=not layout.header,
            encoding="utf8" if layout.is_utf8 else layout.encoding,
        )

    # A character of another encoding may take up to three bytes of UTF-8, which Arrow makes of it.
    size = path.stat().st_size * (1 if layout.is_utf8 else 3) + 1
    try:
        try:
            reader = arrow_csv.open_csv(path, options(BLOCK), parse, convert)
            return reader.schema.names if wanted is None else reader.read_all()
        except pa.ArrowInvalid:
            if size <= BLOCK:
                raise
            # One block, so that Arrow sees the whole column before it chooses a type: 0 at first may be 0.5 later.
            return arrow_csv.read_csv(path, options(min(size, 2**31 - 1)), parse, convert)
    except UnicodeError:
        raise RecordingError(
            f"{path}: has characters that are not {layout.encoding.upper()}; save it as UTF-8, "
            "or give its encoding, such as encoding: latin-1"
        ) from None
    except (pa.ArrowException, OSError) as error:
        why = _uneven(path, str(error), layout) or f"not a table of numbers ({str(error).splitlines()[0]})"
        raise RecordingError(f"{path}: {why}") from error


# ---------------------------------------------------------------------- complaints


def _uneven(path: Path, message: str, layout: Layout) -> str | None:
    """Word Arrow's complaint about a row that is longer or shorter than the others; None if it is another one."""
    match = _WRONG_WIDTH.search(message)
    if match is None:
        return None
    number, expected, given = map(int, match.groups())
    filled = [(at, text) for at, text in _lines(path, layout) if text]
    at, text = filled[min(number - layout.skip_lines, len(filled)) - 1]
    first, head = filled[0]
    line = f"line {at} has {counted(given, 'cell')}, but line {first} has {expected}"
    if _other_delimiter(head, layout) and expected == 1:
        return line + _question(text, layout)
    later = "; if the names of the columns are not in the first line, give skip_lines" if given > expected else ""
    return f"{line}; every line must have as many as the first{later}"


def _missing(path: Path, name: str, what: str, present: Iterable[str]) -> str:
    lower = {other.lower(): other for other in present}
    close = [lower[n] for n in difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(map(repr, close))}? " if close else ""
    return f"{path}: no column {name!r} (for {what}); {hint}it has {', '.join(present)}"


def _no_names(names: Iterable[str], layout: Layout) -> str:
    """Ask whether the file has names of columns at all, if the first line is nothing but numbers; else empty."""
    try:
        _ = [float(name.replace(layout.decimal, ".")) for name in names]
    except ValueError:
        return ""
    return "; is the first line numbers, not names? Then give header: false" if layout.header else ""


def _other_delimiter(text: str, layout: Layout) -> str | None:
    return next((d for d in DELIMITERS if d != layout.delimiter and d in text), None)


def _other_sign(cell: str, layout: Layout) -> str | None:
    """Return the other decimal sign if a cell is a number that is written with it."""
    sign = "," if layout.decimal == "." else "."
    return sign if WITH_SIGN[sign].fullmatch(cell) else None


def _question(text: str, layout: Layout) -> str:
    """Ask for the delimiter and the decimal sign that a cell, a row or names look like; empty if they look right."""
    if sign := _other_sign(text, layout):
        return f"; is the decimal {sign!r}? Then give decimal: {json.dumps(sign)}"
    other = _other_delimiter(text, layout)
    if other is None:
        return ""
    sign = next((s for s in (_other_sign(cell, layout) for cell in text.split(other)) if s and s != other), None)
    give = f"Then give delimiter: {json.dumps(other)}"
    if sign is None:
        return f"; is the delimiter {other!r}? {give}"
    return f"; is the delimiter {other!r}, and the decimal {sign!r}? {give} and decimal: {json.dumps(sign)}"


def _words(column: Any) -> np.ndarray:
    """Return a column of labels (T,), words or numbers; ValueError if a cell is empty."""
    if column.null_count:
        raise ValueError(f"{counted(column.null_count, 'cell')} without a label")
    return np.asarray(column.to_numpy())


def _numbers(column: Any, place: Callable[[int], str], layout: Layout) -> np.ndarray:
    """Return a column of Arrow (T,), float64 or whole; ValueError with the place of the first cell without a number."""
    import pyarrow as pa

    if pa.types.is_boolean(column.type) or pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        empty = np.flatnonzero(column.is_null().to_numpy())
        if empty.size:
            cells, verb = counted(empty.size, "cell"), "is" if empty.size == 1 else "are"
            where = place(int(empty[0]))
            raise ValueError(f"{cells} {verb} empty or NaN, the first in {where}; leave such rows out")
        if pa.types.is_boolean(column.type) or pa.types.is_unsigned_integer(column.type):
            column = column.cast(pa.int64())  # differences of unsigned numbers would overflow
        numbers: np.ndarray = column.to_numpy()  # whole numbers stay whole: float64 cannot hold ns since 1970
        strange = np.flatnonzero(~np.isfinite(numbers))
        if strange.size:
            first = int(strange[0])
            raise ValueError(f"{numbers[first]} in {place(first)}; every value must be finite")
        return numbers.astype(np.float64) if numbers.dtype.kind == "f" else numbers
    for row, value in enumerate(column):
        cell = value.as_py()
        try:
            if _other_sign(str(cell), layout):
                raise ValueError
            float(cell.replace(layout.decimal, ".") if isinstance(cell, str) else cell)
        except (TypeError, ValueError):
            raise _NoNumber(cell, place(row)) from None
    raise ValueError(f"must be numbers, but is read as {column.type}")
