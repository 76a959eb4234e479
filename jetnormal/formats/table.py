"""Rows of numbers as text: the body of ASCII PLY and PCD files and of the XYZ family.

Reading goes through NumPy's C parser (1 M rows of 3 columns take about a second). Writing gives each number
its shortest text that reads back to the same bits.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError

_ROWS_PER_CHUNK = 50_000
_BYTES = 1 << 20  # that are looked at together


def read_table(
    stream: BinaryIO,
    dtype: np.dtype[Any],
    *,
    path: Path,
    line: int,
    columns: int,
    rows: int | None = None,
    delimiter: str | None = None,
) -> NDArray[Any]:
    """Read rows of numbers from a stream's position; blank lines are skipped.

    Args:
        stream: a binary stream; it is left right behind the last row that was read.
        dtype: a plain type for an array of shape (rows, columns), a structured type for one of shape (rows,).
        path: the file, for messages.
        line: number of the first line, for messages.
        columns: how many numbers each row must hold.
        rows: how many rows to read; None reads to the end.
        delimiter: one character, or None for any blanks and tabs.

    Raises:
        InputError: naming the line that holds a wrong number of values or one that is not a number of its
            type; or if the stream holds fewer than `rows`.
    """
    table = _parse(stream, dtype, path, line, columns, rows, delimiter)
    if rows is not None and len(table) < rows:
        raise InputError(f"{path}: declares {rows} points but holds {len(table)}; the file is truncated")
    return table


def table_pieces(
    path: Path, offset: int, dtype: np.dtype[Any], *, line: int, columns: int, count: int, rows: int
) -> Iterator[NDArray[Any]]:
    """Read rows of numbers of a file piece by piece; they have the values of `read_table`.

    Args:
        path: the file.
        offset: where its first row begins.
        dtype, line, columns: as for `read_table`.
        count: how many rows there are (`skip_rows`).
        rows: of a piece, at most. Without rows, there is one piece.

    Raises:
        InputError: as `read_table`.
    """
    with path.open("rb") as stream:
        stream.seek(offset)
        for start in range(0, max(1, count), rows):
            yield _parse(stream, dtype, path, line, columns, min(rows, count - start), None, offset)


def skip_rows(stream: BinaryIO, count: int) -> int:
    """Leave a stream behind the next `count` lines that are not blank; return how many there are."""
    lines = (raw for raw in stream if not raw.isspace())
    return sum(1 for _ in itertools.islice(lines, count))


def _parse(
    stream: BinaryIO,
    dtype: np.dtype[Any],
    path: Path,
    line: int,
    columns: int,
    rows: int | None,
    delimiter: str | None,
    origin: int | None = None,
) -> NDArray[Any]:
    """Up to so many rows; `line` is the number of the line at `origin`, or of the first one here."""
    if rows == 0:
        return np.empty(0, dtype)
    start = stream.tell()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there are blank lines
            warnings.simplefilter("error", DeprecationWarning)  # NumPy 2.2 takes 256 for a byte, and makes it 0
            table = np.loadtxt(
                stream,
                dtype,
                comments=None,
                delimiter=delimiter,
                max_rows=rows,
                ndmin=1 if dtype.names else 2,
                encoding="latin1",
            )
    except (ValueError, DeprecationWarning) as error:
        line += _lines_between(stream, start if origin is None else origin, start)
        stream.seek(start)
        problem = _find_problem(stream, _leaf_types(dtype, columns), line, delimiter)
        raise InputError(f"{path}: {problem or error}; correct the file") from None
    if not dtype.names and len(table) and table.shape[1] != columns:
        raise InputError(f"{path}: line {line}: {table.shape[1]} values instead of {columns}; correct the file")
    return table


def _lines_between(stream: BinaryIO, start: int, end: int) -> int:
    """The number of lines between two positions; the stream is moved."""
    stream.seek(start)
    sizes = range(start, end, _BYTES)
    return sum(stream.read(min(_BYTES, end - begin)).count(b"\n") for begin in sizes)


def _leaf_types(dtype: np.dtype[Any], columns: int) -> list[np.dtype[Any]]:
    if dtype.names is None:
        return [dtype] * columns
    fields = [dtype[name] for name in dtype.names]
    return [field.base for field in fields for _ in range(int(np.prod(field.shape)))]


def _find_problem(stream: BinaryIO, types: list[np.dtype[Any]], first_line: int, delimiter: str | None) -> str | None:
    """Say what is wrong with the first bad row, once the fast parser has given up."""
    for number, raw in enumerate(stream, first_line):
        text = raw.decode("latin1").strip()
        if not text:
            continue
        values = text.split(delimiter)
        if len(values) != len(types):
            return f"line {number}: {len(values)} values instead of {len(types)}"
        for value, dtype in zip(values, types, strict=True):
            if not _fits(value, dtype):
                return f"line {number}: {value.strip()[:40]!r} is not a number of type {dtype.name}"
    return None


def _fits(text: str, dtype: np.dtype[Any]) -> bool:
    parse: Callable[[str], float] = float if dtype.kind == "f" else int
    try:
        value = parse(text)
    except ValueError:
        return False
    if "_" in text:  # fine in Python's numbers alone
        return False
    return dtype.kind == "f" or np.iinfo(dtype).min <= value <= np.iinfo(dtype).max


def format_rows(columns: Sequence[NDArray[Any]], delimiter: str) -> Iterator[bytes]:
    """Yield the text of a table in chunks.

    Args:
        columns: arrays of shape (rows,), integers or floats.
        delimiter: what stands between two numbers.
    """
    row = delimiter.join(["%r"] * len(columns)) + "\n"
    for start in range(0, len(columns[0]), _ROWS_PER_CHUNK):
        chunk = [column[start : start + _ROWS_PER_CHUNK] for column in columns]
        flat: list[Any] = [None] * (len(chunk) * len(chunk[0]))
        for index, column in enumerate(chunk):
            values = _shortest(column) if column.dtype == np.float32 else column
            flat[index :: len(chunk)] = values.tolist()
        text = row * len(chunk[0]) % tuple(flat)
        yield (text.replace(f".0{delimiter}", delimiter).replace(".0\n", "\n").encode("ascii"))  # 1 instead of 1.0


def _shortest(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """The doubles with the fewest digits that round to these floats: 0.1 instead of 0.10000000149011612.

    Python prints a double in its shortest form, so this turns that into the shortest form of a float. Nine
    digits always suffice; a value that the scaling below cannot express keeps its exact, longer form.
    """
    exact = values.astype(np.float64)
    shortest = exact.copy()
    with np.errstate(all="ignore"):
        magnitude = np.floor(np.log10(np.abs(exact)))
        for digits in (9, 8, 7, 6):
            scale = 10.0 ** (digits - 1 - magnitude)
            rounded = np.rint(exact * scale) / scale
            same = rounded.astype(np.float32) == values
            shortest[same] = rounded[same]
    return shortest
