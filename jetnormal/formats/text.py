"""The XYZ family: rows of numbers as text, in ``.xyz .xyzn .txt .asc .csv .pts`` files.

Understood are blanks, tabs, commas and semicolons between the numbers (with semicolons also decimal commas);
a line of column names, plain or as a comment; a line with the number of points; comments after ``#`` or
``//``; Fortran's exponents (``1D3``). The user, a line of names, or the values tell what the columns are
(`text_columns`).
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.columns import (
    COORDINATES,
    Columns,
    UniqueNames,
    canonical_names,
    cloud_from_columns,
)
from jetnormal.formats.registry import Format
from jetnormal.formats.storage import COLORS
from jetnormal.formats.streams import CloudStream
from jetnormal.formats.table import read_table
from jetnormal.formats.text_columns import SKIPPED, Layout, are_bytes
from jetnormal.formats.text_header import Preamble, read_preamble
from jetnormal.formats.text_writer import ENCODINGS, Style, write, write_rows

_COMMENT = re.compile(rb"((?:#|//)[ \t]?)([^\r\n]*)")
_PIECE = 1 << 24
MOST_COLUMNS = 50_000  # each becomes an attribute
_EXACT_INTEGERS = 2.0**53  # from here on a double cannot hold every integer
_LARGEST_INTEGER = 2.0**63  # the largest int64 as a double


def read(path: Path, *, suffix: str, columns: str | None = None, decimal: str | None = None) -> Cloud:
    """Read rows of numbers; see the module's text for what is understood.

    Without names, `text_columns.guess_names` tells the columns.

    Args:
        path: the file.
        suffix: whose conventions it follows.
        columns: what the columns are (`text_columns.Layout`).
        decimal: "point", "comma", or None: a comma between semicolons.

    Raises:
        InputError: if the file is empty or is no such text.
        UsageError: if `columns` or `decimal` make no sense, or do not fit the file.
    """
    layout = _layout(columns, decimal)
    with _open(path) as stream:
        preamble = _read_preamble(stream, path, decimal)
        numbers, comments = _read_rows(stream, preamble, path)
    _check_count(preamble, len(numbers[0]), path)
    names, notes = layout.apply(preamble.names, numbers, suffix, path)
    spelling, found = _name_columns(names, preamble.names, numbers, path)
    return cloud_from_columns(found, _source(preamble, comments, spelling, notes, suffix), path)


def _layout(columns: str | None, decimal: str | None) -> Layout:
    if decimal not in (None, "point", "comma"):
        raise UsageError(f"the decimal sign is point or comma, not {decimal!r}")
    return Layout.parse(columns)


def _read_preamble(stream: BinaryIO, path: Path, decimal: str | None) -> Preamble:
    preamble = read_preamble(stream, path, decimal)
    if not preamble.columns and not preamble.names and preamble.count != 0:
        raise InputError(f"{path}: holds no points; is this the right file?")
    if preamble.columns and preamble.columns > MOST_COLUMNS:
        raise InputError(f"{path}: {preamble.columns:,} columns, more than {MOST_COLUMNS:,}; is this the right file?")
    return preamble


def _check_count(preamble: Preamble, found: int, path: Path) -> None:
    if preamble.count not in (None, found):
        raise InputError(f"{path}: declares {preamble.count} points but holds {found}; is it truncated?")


def _source(
    preamble: Preamble, comments: list[tuple[str, str]], spelling: dict[str, str], notes: tuple[str, ...], suffix: str
) -> Source:
    comments = preamble.comments + comments
    style = Style(
        suffix=suffix,
        delimiter=preamble.delimiter,
        header=preamble.header,
        count_line=preamble.count is not None,
        marker=comments[0][0] if comments else "# ",
        spelling=spelling,
    )
    texts = tuple(text for _, text in comments)
    return Source(format="xyz", encoding="ascii", comments=texts, extra=style, notes=notes)


def stream(path: Path, *, suffix: str, columns: str | None = None, decimal: str | None = None) -> CloudStream:
    """Open rows of numbers to be read in pieces, after one look at all of them: it tells the columns' types.

    Args, Raises: as `read`. It is an `InputError` if parts of the file look as if they had other columns.
    """
    layout = _layout(columns, decimal)
    with _open(path) as opened:
        preamble = _read_preamble(opened, path, decimal)
    points, comments, types = 0, [], {}  # type: ignore[var-annotated]
    layouts = set()
    for numbers, found_comments in _blocks(path, preamble):
        names, notes = layout.apply(preamble.names, numbers, suffix, path)
        spelling, found = _name_columns(names, preamble.names, numbers, path)
        layouts.add((*names, *notes))
        if len(layouts) > 1:
            raise InputError(f"{path}: what the columns are is not the same in all of its parts; give `columns`")
        points += len(numbers[0])
        comments += found_comments
        for name, values in found.items():
            types[name] = np.result_type(types.get(name, values.dtype), values.dtype)
    _check_count(preamble, points, path)
    source = _source(preamble, comments, spelling, notes, suffix)

    def pieces(rows: int) -> Iterator[Cloud]:
        for numbers, _ in _blocks(path, preamble):
            found = _name_columns(names, preamble.names, numbers, path)[1]
            found = {name: values.astype(types[name]) for name, values in found.items()}
            for start in range(0, max(1, len(numbers[0])), rows):
                part = {name: values[start : start + rows] for name, values in found.items()}
                yield cloud_from_columns(part, source, path)

    return CloudStream(points, 8 * len(types), pieces)


def _blocks(path: Path, preamble: Preamble) -> Iterator[tuple[list[NDArray[Any]], list[tuple[str, str]]]]:
    """The columns of numbers, and the comments among them, some megabytes of whole lines at a time; at least once."""
    rows = 0
    with _open(path) as opened:
        opened.seek(preamble.offset)
        line = preamble.line
        while text := opened.read(_PIECE):
            text += opened.readline()
            lines = text.count(b"\n")
            piece = replace(preamble, offset=0, line=line)
            numbers, comments = _read_rows(io.BytesIO(text), piece, path)
            line += lines
            rows += len(numbers[0])
            if len(numbers[0]):
                yield numbers, comments
    if not rows:
        yield [np.empty(0) for _ in preamble.names or COORDINATES], []


def _open(path: Path) -> BinaryIO:
    stream = path.open("rb")
    head = stream.read(1 << 16)
    if not head or head.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" in head:
        stream.close()
        problem = "is not plain text (UTF-8); export it again as such" if head else "is empty"
        raise InputError(f"{path}: {problem}")
    if b"\r" in head and b"\n" not in head:  # line ends of old Macintoshes
        with stream:
            return io.BytesIO((head + stream.read()).replace(b"\r", b"\n"))
    stream.seek(3 if head.startswith(b"\xef\xbb\xbf") else 0)
    return stream


def _read_rows(stream: BinaryIO, preamble: Preamble, path: Path) -> tuple[list[NDArray[Any]], list[tuple[str, str]]]:
    """The columns of numbers, and the comments among them.

    Comments and unusual numbers are rare, and looking for them is quick: only then the text is cleaned.
    """
    if not preamble.columns:
        return [np.empty(0) for _ in preamble.names or COORDINATES], []
    stream.seek(preamble.offset)
    pieces = iter(partial(stream.read, _PIECE), b"")
    unusual = (b"#", b"/", b"d", b"D") + ((b",",) if preamble.decimal_comma else ())
    is_unusual = any(sign in piece for piece in pieces for sign in unusual)
    stream.seek(preamble.offset)
    if not is_unusual:
        return _parse(stream, preamble, path), []
    cleaned, comments = _clean(stream.read(), preamble.decimal_comma)
    return _parse(io.BytesIO(cleaned), preamble, path), comments


def _parse(stream: BinaryIO, preamble: Preamble, path: Path) -> list[NDArray[Any]]:
    """Columns of float64, or of int64 where only those hold the numbers (time stamps in nanoseconds)."""
    delimiter = preamble.delimiter if preamble.delimiter in ",;" else None
    start = stream.tell()
    numbers = read_table(
        stream, np.dtype(np.float64), path=path, line=preamble.line, columns=preamble.columns, delimiter=delimiter
    )
    columns: list[NDArray[Any]] = list(numbers.T)
    largest = [np.abs(column).max() for column in columns]
    large = [index for index, size in enumerate(largest) if _EXACT_INTEGERS <= size <= _LARGEST_INTEGER]
    if large:
        stream.seek(start)
        words = np.loadtxt(stream, str, comments=None, delimiter=delimiter, usecols=large, ndmin=2, encoding="latin1")
        for index, column in zip(large, words.T, strict=True):
            with suppress(ValueError, OverflowError):  # large numbers that are no integers
                columns[index] = column.astype(np.int64)
    return columns


def _clean(text: bytes, decimal_comma: bool) -> tuple[bytes, list[tuple[str, str]]]:
    """Text with comments cut out, ``e`` for Fortran's ``D``, and points for decimal commas; and the comments."""
    comments = _COMMENT.findall(text)
    text = _COMMENT.sub(b"", text)
    if b"d" in text or b"D" in text:
        text = re.sub(rb"[dD](?=[-+\d])", b"e", text)
    if decimal_comma:
        text = text.replace(b",", b".")
    return text, [(marker.decode(), comment.decode("utf-8", "surrogateescape")) for marker, comment in comments]


def _name_columns(
    names: list[str], written: list[str] | None, numbers: list[NDArray[Any]], path: Path
) -> tuple[dict[str, str], Columns]:
    """The columns under the names they have in a cloud, and the file's spelling of these."""
    canonical = canonical_names(dict.fromkeys(names), path)
    colors = {name: color for color in COLORS for name in names if name.lower() in (color, color[0])}
    if len(colors) != 3 or len(set(colors.values())) != 3:
        colors = {}
    columns: Columns = {}
    spelling = {}
    unique = UniqueNames()
    for name, spelled, values in zip(names, written or names, numbers, strict=True):
        if name == SKIPPED:
            continue
        known = canonical.get(name) or colors.get(name) or "_".join(name.split()) or "column"
        key = unique.add(known)
        spelling[key] = spelled
        if key in canonical.values():
            columns[key] = values
        elif key in colors.values() and are_bytes(values):
            columns[key] = values.astype(np.uint8)
        else:
            columns[key] = _as_integers(values)
    return spelling, columns


def _as_integers(values: NDArray[Any]) -> NDArray[Any]:
    """A column without fractions as integers, so that labels and counts are written as such again."""
    if values.dtype.kind == "f":
        largest = np.abs(values).max(initial=0)
        if not largest < _EXACT_INTEGERS or (values != np.rint(values)).any():
            return values
    fits = not values.size or (values.min() >= -(2**31) and values.max() < 2**31)
    return values.astype(np.int32 if fits else np.int64)


def _format(suffix: str) -> Format:
    functions: tuple[Callable[..., Any], ...] = (read, write, stream, write_rows)
    reads, writes, streams, appends = (partial(function, suffix=suffix) for function in functions)
    return Format(
        "xyz",
        (suffix,),
        reads,
        writes,
        ENCODINGS,
        has_columns=True,
        stream=streams,
        write_rows=appends,
        stream_reads_all=True,
    )


FORMATS = tuple(_format(suffix) for suffix in (".xyz", ".xyzn", ".txt", ".asc", ".csv", ".pts"))
