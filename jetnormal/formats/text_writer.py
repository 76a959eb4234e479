"""Writing of text files (`formats.text`): their layout, the line of names, and rows of numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.formats.columns import (
    COORDINATES,
    NORMALS,
    Columns,
    UniqueNames,
    columns_from_cloud,
)
from jetnormal.formats.storage import to_storable, unpack_colors
from jetnormal.formats.streams import RowWriter, write_whole
from jetnormal.formats.table import format_rows
from jetnormal.formats.text_columns import by_position, guess_names
from jetnormal.formats.text_header import is_number

ENCODINGS = ("ascii",)
_TYPES = frozenset(("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"))


@dataclass(frozen=True)
class Style:
    """How a text file is laid out.

    Attributes:
        suffix: of the file, in lower case.
        delimiter: what stands between two numbers.
        header: ``""`` for none, ``"plain"`` for a line of names, or the beginning of a comment with the
            names.
        count_line: whether a line gives the number of points.
        marker: what begins a comment.
        spelling: the file's own names of columns, where they differ from those in the cloud.
    """

    suffix: str
    delimiter: str = " "
    header: str = ""
    count_line: bool = False
    marker: str = "# "
    spelling: dict[str, str] = field(default_factory=dict)


def write(cloud: Cloud, stream: BinaryIO, encoding: str, *, suffix: str) -> list[str]:
    """Write rows of numbers, each in the shortest text that reads back to the same value.

    A file read from the same suffix keeps its delimiter, names, count line and comments. New normals have the
    precision of float32. CSV files always have a line of names; other new files but PTS have one, as a comment,
    only if there are attributes, since strict readers of plain ``x y z nx ny nz`` rows stop at it. Where names
    are missing that `read` would not guess, a warning tells them. Readers without names go by position: unless the
    file itself named its columns, the coordinates come first, then the normals, then the rest; in PTS files the
    normals come last, behind x y z intensity red green blue.

    Returns:
        What could not be kept.
    """
    return write_whole(_Rows(len(cloud), stream, suffix), cloud)


def write_rows(
    first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str, *, suffix: str
) -> RowWriter:
    """Begin a text file of so many points."""
    return _Rows(points, stream, suffix)


class _Rows:
    """Writes rows of numbers behind the lines that precede them."""

    def __init__(self, points: int, stream: BinaryIO, suffix: str) -> None:
        self._points, self._stream, self._suffix = points, stream, suffix
        self._style: Style | None = None
        self._warnings: list[str] = []

    def write(self, cloud: Cloud) -> None:
        """Append rows; what precedes them comes before the first."""
        columns, renamed = columns_from_cloud(cloud, NORMALS, np.dtype(np.float32))
        if cloud.source.format == "pcd":
            columns = unpack_colors(columns)
        columns, changed = to_storable(columns, _TYPES, vectors=False)
        is_first = self._style is None
        style = self._style = self._style or self._choose_style(cloud.source, columns)
        if not style.spelling or not style.header:
            columns = {name: columns[name] for name in by_position(list(columns), self._suffix)}
        if is_first:
            self._begin(columns, style)
            self._warnings = renamed + self._warnings + changed
        for chunk in format_rows(list(columns.values()), style.delimiter):
            self._stream.write(chunk)

    def _choose_style(self, source: Source, columns: Columns) -> Style:
        style = source.extra
        if isinstance(style, Style) and style.suffix == self._suffix:
            self._stream.writelines(_encode(f"{style.marker}{comment}") for comment in source.comments)
            return style
        self._warnings += ["comments are not kept"] if source.comments else []
        return _new_style(self._suffix, has_attributes=not set(columns) <= {*COORDINATES, *NORMALS})

    def _begin(self, columns: Columns, style: Style) -> None:
        header = style.header or ("plain" if self._suffix == ".csv" else "")
        if header:
            spelled, respelled = _header_names(columns, style)
            self._warnings += respelled
            names = style.delimiter.join(spelled)
            self._stream.write(_encode(names if header == "plain" else f"{header}{names}"))
        elif _loses_names(columns, self._suffix):
            self._warnings.append(f"the columns' names are not kept; they are {' '.join(columns)}")
        if style.count_line:
            self._stream.write(_encode(str(self._points)))

    def finish(self) -> list[str]:
        """Nothing follows the rows."""
        return self._warnings


def _loses_names(columns: Columns, suffix: str) -> bool:
    """Whether a reader of the numbers alone would miss the name of a column."""
    guessed = guess_names(list(columns.values()), suffix)
    return any(a != b and not a.startswith("column_") for a, b in zip(columns, guessed, strict=True))


def _header_names(columns: Columns, style: Style) -> tuple[list[str], list[str]]:
    """The names for a line of names, without what would end one, and a warning for each that had to change."""
    names, warnings = [], []
    unique = UniqueNames()
    for name in columns:
        spelled = style.spelling.get(name, name)
        clean = re.sub(r'[,;"#\r\n]|//', "_", spelled) if name not in style.spelling else spelled
        clean = unique.add(f"column_{clean}" if is_number(clean) else clean)
        names.append(clean)
        if clean != spelled:
            warnings.append(f"attribute {name!r} is written as {clean!r}")
    return names, warnings


def _new_style(suffix: str, has_attributes: bool) -> Style:
    if suffix == ".csv":
        return Style(suffix, delimiter=",", header="plain")
    if suffix == ".pts":
        return Style(suffix, count_line=True)
    return Style(suffix, header="# " if has_attributes else "")


def _encode(line: str) -> bytes:
    return line.encode("utf-8", "surrogateescape") + b"\n"
