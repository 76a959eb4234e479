"""The header of a PLY file: its elements and their properties."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jetnormal.errors import InputError
from jetnormal.formats.columns import UniqueNames

ENCODINGS = ("binary_little_endian", "binary_big_endian", "ascii")

BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
TYPE_NAMES = {  # of number types, in the original spelling, which every reader knows
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_TYPES = {name: code for code, name in TYPE_NAMES.items()} | {
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_LONGEST_HEADER_LINE = 65536


@dataclass(frozen=True)
class Property:
    """A column of an element."""

    name: str
    type: str
    """NumPy code without byte order, such as ``"f4"``."""
    length_type: str | None = None
    """The type of the number that precedes each list; None for a scalar."""

    def __str__(self) -> str:
        kind = (
            TYPE_NAMES[self.type]
            if self.length_type is None
            else (f"list {TYPE_NAMES[self.length_type]} {TYPE_NAMES[self.type]}")
        )
        return f"property {kind} {self.name}"


@dataclass(frozen=True)
class Element:
    """A table of a file, such as its vertices or its faces: `count` rows with these columns."""

    name: str
    count: int
    properties: tuple[Property, ...] = ()

    def __str__(self) -> str:
        return "\n".join([f"element {self.name} {self.count}", *map(str, self.properties)])

    @property
    def is_scalar(self) -> bool:
        """Whether no property is a list."""
        return all(prop.length_type is None for prop in self.properties)

    def smallest_size(self, encoding: str) -> int:
        """Return the least bytes that the rows take: lists may be empty, a number in text a digit and a blank."""
        if encoding == "ascii":
            return self.count * 2 * len(self.properties)
        return self.count * sum(np.dtype(prop.length_type or prop.type).itemsize for prop in self.properties)

    def dtype(self, encoding: str) -> np.dtype[Any]:
        """Return the structured type of a row without lists, in the byte order of an encoding."""
        order = BYTE_ORDERS[encoding]
        return np.dtype([(prop.name, order + prop.type) for prop in self.properties])


@dataclass(frozen=True)
class Header:
    """What the header of a PLY file says; `lines` is its length."""

    encoding: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...] = ()
    object_info: tuple[str, ...] = ()
    lines: int = 0

    def __str__(self) -> str:
        lines = ["ply", f"format {self.encoding} 1.0"]
        lines += [f"comment {comment}".rstrip() for comment in self.comments]
        lines += [f"obj_info {info}".rstrip() for info in self.object_info]
        return "\n".join([*lines, *map(str, self.elements), "end_header\n"])

    def encode(self) -> bytes:
        """Return the header as the bytes of a file."""
        return str(self).encode("utf-8", "surrogateescape")


def read_header(stream: BinaryIO, path: Path) -> Header:
    """Read the header of a PLY file; the stream is left behind it.

    Raises:
        InputError: it is damaged or no such header.
    """
    if stream.readline(_LONGEST_HEADER_LINE).removeprefix(b"\xef\xbb\xbf").strip() != b"ply":
        raise InputError(f"{path}: does not begin with the line 'ply'; is this a PLY file?")
    encoding, comments, object_info = "", [], []  # type: ignore[var-annotated]
    found: list[_Declaration] = []
    for number in range(2, 1_000_000):
        raw = stream.readline(_LONGEST_HEADER_LINE)
        if not raw:
            break
        line = raw.decode("utf-8", "surrogateescape").strip()
        keyword, _, rest = line.partition(" ")
        try:
            if keyword == "end_header" and encoding:
                elements = tuple(Element(each.name, each.count, tuple(each.properties)) for each in found)
                return Header(encoding, elements, tuple(comments), tuple(object_info), number)
            if keyword == "comment":
                comments.append(rest)
            elif keyword == "obj_info":
                object_info.append(rest)
            elif keyword == "format" and rest.split()[0] in ENCODINGS:
                encoding = rest.split()[0]
            elif keyword == "element":
                name, count = rest.split()
                found.append(_Declaration(name, _to_count(count)))
            elif keyword == "property":
                found[-1].add(rest.split())
            elif line:
                raise ValueError
        except (ValueError, KeyError, IndexError):
            raise InputError(f"{path}: line {number}: {line[:60]!r} is not valid in a PLY header") from None
    raise InputError(f"{path}: the PLY header has no format or no end_header; the file is truncated")


@dataclass
class _Declaration:
    """An element whose properties are being read."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)
    names: UniqueNames = field(default_factory=UniqueNames)

    def add(self, words: list[str]) -> None:
        """Take the words of a property; a name that the element already has gets a number."""
        *kind, name = words
        if len(kind) == 3 and kind[0] == "list":
            if np.dtype(_TYPES[kind[1]]).kind == "f":
                raise ValueError  # a list cannot have 2.5 members
            added = Property(self.names.add(name), _TYPES[kind[2]], _TYPES[kind[1]])
        elif len(kind) == 1:
            added = Property(self.names.add(name), _TYPES[kind[0]])
        else:
            raise ValueError
        self.properties.append(added)


def _to_count(text: str) -> int:
    if not text.isdecimal() or len(text) > 18:
        raise ValueError
    return int(text)
