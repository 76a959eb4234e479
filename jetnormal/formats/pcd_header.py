"""The header of a PCD file, read and written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jetnormal.cloud import AT_ORIGIN, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import Columns, UniqueNames

ENCODINGS = ("binary", "binary_compressed", "ascii")
_TITLE = ".PCD v0.7 - Point Cloud Data file format"
TYPES = frozenset(("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"))
_FIELD_KEYS = ("FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT")
_CLOUD_KEYS = ("VERSION", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_LONGEST_HEADER_LINE = 65536


@dataclass(frozen=True)
class Header:
    """What the header of a PCD file says."""

    dtype: np.dtype[Any]
    """One point: a structured type whose fields with COUNT > 1 are sub-arrays."""
    padding: frozenset[str]
    """The fields that PCL calls ``_``: gaps of its structures in memory, which its binary files hold, too."""
    width: int
    height: int
    viewpoint: tuple[float, ...]
    encoding: str
    comments: tuple[str, ...]
    lines: int

    @property
    def points(self) -> int:
        """Number of points."""
        return self.width * self.height

    @property
    def columns(self) -> int:
        """Numbers of a point."""
        return sum(int(np.prod(self.dtype[name].shape)) for name in self.dtype.names or ())

    @property
    def least_text(self) -> int:
        """The least bytes of the rows as text: a digit and a blank for each number; the last line may lack its end."""
        return self.points * 2 * self.columns - 1


def read_header(stream: BinaryIO, path: Path) -> Header:
    """Read the header of a PCD file; the stream is left behind it.

    Raises:
        InputError: it is damaged or no such header.
    """
    entries: dict[str, list[str]] = {}
    comments: list[str] = []
    lines = 0
    while "DATA" not in entries:
        raw = stream.readline(_LONGEST_HEADER_LINE)
        lines += 1
        text = raw.decode("utf-8-sig", "surrogateescape").strip()
        if text.startswith("#"):
            comments.append(text[1:].strip())
        elif text:
            key, *values = text.split()
            if key not in (*_FIELD_KEYS, *_CLOUD_KEYS):
                raise InputError(f"{path}: line {lines}: {text[:40]!r} is no PCD header; is this a PCD file?")
            entries["FIELDS" if key == "COLUMNS" else key] = values
        elif not raw:
            raise InputError(f"{path}: the PCD header has no DATA line; the file is truncated or no PCD file")
    try:
        return _interpret(entries, tuple(comments), lines)
    except ValueError as error:
        raise InputError(f"{path}: damaged PCD header ({error}); correct it or export the file again") from None


def _interpret(entries: dict[str, list[str]], comments: tuple[str, ...], lines: int) -> Header:
    fields = entries.get("FIELDS", [])
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(fields))]
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    if not fields or not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT do not have the same number of entries")
    described: list[tuple[str, str, tuple[int, ...]]] = []
    unique = UniqueNames()
    for name, size, kind, count in zip(fields, sizes, kinds, counts, strict=True):
        if kind.lower() + size not in TYPES or count < 1:
            raise ValueError(f"field {name!r} has TYPE {kind}, SIZE {size} and COUNT {count}")
        described.append((unique.add(name), "<" + kind.lower() + size, () if count == 1 else (count,)))
    padding = frozenset(field[0] for field, name in zip(described, fields, strict=True) if name == "_")
    declared = {key: int(" ".join(entries[key])) for key in ("WIDTH", "HEIGHT", "POINTS") if key in entries}
    width, height = declared.get("WIDTH", declared.get("POINTS", -1)), declared.get("HEIGHT", 1)
    if width < 0 or height < 0 or declared.get("POINTS", width * height) != width * height:
        raise ValueError(f"the number of points is unclear: {declared}")
    viewpoint = tuple(float(value) for value in entries.get("VIEWPOINT", AT_ORIGIN))
    encoding = " ".join(entries["DATA"])
    if len(viewpoint) != 7:
        raise ValueError("VIEWPOINT does not hold 7 numbers")
    if encoding not in ENCODINGS:
        raise ValueError(f"DATA {encoding} is none of {', '.join(ENCODINGS)}")
    return Header(np.dtype(described), padding, width, height, viewpoint, encoding, comments, lines)


def header_text(source: Source, points: int, columns: Columns, encoding: str) -> str:
    """Write the header of so many points with the types of these columns."""
    width, height = source.width or 0, source.height or 0
    if width * height != points:  # points were removed, or the format had no such thing
        width, height = points, 1
    counts = [int(np.prod(values.shape[1:])) for values in columns.values()]
    own_comments = source.format == "pcd"
    comments = source.comments if own_comments else (_TITLE, *source.comments)
    lines = [f"# {comment}".rstrip() for comment in comments]
    lines += [
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(values.dtype.itemsize) for values in columns.values()),
        "TYPE " + " ".join(values.dtype.kind.upper() for values in columns.values()),
        "COUNT " + " ".join(map(str, counts)),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT " + " ".join(repr(v).removesuffix(".0") for v in source.viewpoint or AT_ORIGIN),
        f"POINTS {points}",
        f"DATA {encoding}",
    ]
    return "\n".join(lines) + "\n"
