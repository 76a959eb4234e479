"""PLY, the Stanford polygon format: ascii and binary of either byte order.

Format: http://paulbourke.net/dataformats/ply/

The vertices come and go as columns. What follows them (faces, edges...) is carried along as the bytes it is,
unless the encoding changes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import NORMALS, Columns, cloud_from_columns, columns_from_cloud
from jetnormal.formats.ply_header import BYTE_ORDERS, ENCODINGS, TYPE_NAMES, Element, Header, Property, read_header
from jetnormal.formats.ply_rows import format_element, read_element
from jetnormal.formats.registry import Format
from jetnormal.formats.storage import to_storable, unpack_colors
from jetnormal.formats.streams import CloudStream, RowWriter, SameLayout, from_chunks, from_table, mapped, write_whole
from jetnormal.formats.table import skip_rows, table_pieces


@dataclass(frozen=True)
class PlyExtra:
    """What a PLY file held besides its vertices' numbers.

    Attributes:
        object_info: the ``obj_info`` lines.
        elements: the other elements; they are written behind the vertices.
        encoding: the encoding of `body`.
        body: the other elements' rows.
        length_types: for each vertex property that is a list, the type of the number that precedes it.
        points: how many vertices there were, to which faces refer.
        path: the file, for messages.
        header_lines: length of its header, for messages.
    """

    object_info: tuple[str, ...]
    elements: tuple[Element, ...]
    encoding: str
    body: bytes
    length_types: dict[str, str]
    points: int
    path: Path
    header_lines: int

    def losses(self) -> list[str]:
        """Name what other formats cannot hold."""
        return [f"{describe_elements(self.elements)} is not kept"] if self.elements else []


def read(path: Path) -> Cloud:
    """Read a PLY file.

    Raises:
        InputError: if the file is no PLY file, is damaged, or its vertices have no coordinates.
    """
    with path.open("rb") as stream:
        header, vertex = _read_header(stream, path)
        others = tuple(element for element in header.elements if element is not vertex)
        if vertex is header.elements[0]:
            columns = read_element(stream, vertex, header.encoding, path, header.lines + 1)
            body, trailing = _read_body(stream, header, others, path)
        else:
            parsed = _parse(stream, header.elements, header.encoding, path, header.lines + 1)
            columns = parsed.pop("vertex")
            body = _format(parsed, others, header.encoding)
            trailing = len(stream.read()) if header.encoding != "ascii" else 0
    return cloud_from_columns(columns, _source(header, vertex, others, body, trailing, path), path)


def stream(path: Path) -> CloudStream:
    """Open a PLY file to be read in pieces: one whose vertices come first and have no lists.

    Raises:
        InputError: the file is none of these, or as `read`. What is wrong in rows of text shows when they are read.
    """
    with path.open("rb") as file:
        header, vertex = _read_header(file, path)
        if vertex is not header.elements[0] or not vertex.is_scalar:
            raise InputError(f"{path}: is not read in pieces: its vertices have lists or stand behind other elements")
        dtype, offset, count = vertex.dtype(header.encoding), file.tell(), vertex.count
        if header.encoding != "ascii":
            file.seek(count * dtype.itemsize, io.SEEK_CUR)
        elif (found := skip_rows(file, count)) < count:
            raise InputError(f"{path}: declares {count} points but holds {found}; the file is truncated")
        others = header.elements[1:]
        body, trailing = _read_body(file, header, others, path)
    source = _source(header, vertex, others, body, trailing, path)
    if header.encoding != "ascii":
        return from_table(mapped(path, dtype, offset, count), source, path)
    layout: dict[str, Any] = {"line": header.lines + 1, "columns": len(vertex.properties), "count": count}
    return from_chunks(count, lambda rows: table_pieces(path, offset, dtype, rows=rows, **layout), source, path)


def _read_header(stream: BinaryIO, path: Path) -> tuple[Header, Element]:
    """The header and the element of the vertices; the rows that it tells of fit the size of the file."""
    header = read_header(stream, path)
    names = [element.name for element in header.elements]
    if names.count("vertex") != 1 or len(set(names)) != len(names):
        raise InputError(f"{path}: must hold one element 'vertex', but holds {', '.join(names) or 'nothing'}")
    size = path.stat().st_size - stream.tell()
    needed = sum(element.smallest_size(header.encoding) for element in header.elements)
    if needed > size + (header.encoding == "ascii"):  # the last line may lack its end
        counts = ", ".join(f"{element.count} x {element.name}" for element in header.elements)
        raise InputError(
            f"{path}: declares {counts}, which need at least {needed} bytes, but {size} follow the "
            "header; the file is truncated or its header is wrong"
        )
    return header, header.elements[names.index("vertex")]


def _read_body(stream: BinaryIO, header: Header, others: Sequence[Element], path: Path) -> tuple[bytes, int]:
    """The rows behind the vertices, and how many bytes follow them."""
    body = stream.read()
    size = _check_body(others, header.encoding, body, path, header.lines + 1 + header.elements[0].count)
    return body[:size], len(body) - size


def _source(
    header: Header, vertex: Element, others: tuple[Element, ...], body: bytes, trailing: int, path: Path
) -> Source:
    lengths = {prop.name: prop.length_type for prop in vertex.properties if prop.length_type}
    extra = PlyExtra(header.object_info, others, header.encoding, body, lengths, vertex.count, path, header.lines)
    notes = (f"{trailing} bytes behind the last element are left out",) if trailing else ()
    return Source(format="ply", encoding=header.encoding, comments=header.comments, extra=extra, notes=notes)


def _check_body(elements: Sequence[Element], encoding: str, body: bytes, path: Path, line: int) -> int:
    """Find out whether the rows of the elements that are carried along are all there, and in how many bytes."""
    if encoding == "ascii":
        rows = sum(1 for line in body.splitlines() if line.strip())
        expected = sum(element.count for element in elements)
        if rows != expected:
            raise InputError(f"{path}: {rows} rows follow the vertices instead of {expected}; correct the header")
        return len(body)
    stream = io.BytesIO(body)
    for element in elements:
        row = _row_type(element, encoding)
        table = np.frombuffer(body, row, element.count, stream.tell()) if _holds(body, element, row, stream) else None
        if table is None or not (element.is_scalar or (table["length"] == 3).all()):
            read_element(stream, element, encoding, path, line)
        else:
            stream.seek(table.nbytes, io.SEEK_CUR)
        line += element.count
    return stream.tell()


def _row_type(element: Element, encoding: str) -> np.dtype[Any] | None:
    """The type of rows of one length: numbers alone, or one list of three, as in nearly every mesh."""
    if element.is_scalar:
        return element.dtype(encoding)
    if len(element.properties) > 1:
        return None
    order, (prop,) = BYTE_ORDERS[encoding], element.properties
    return np.dtype([("length", f"{order}{prop.length_type}"), ("values", f"{order}{prop.type}", (3,))])


def _holds(body: bytes, element: Element, row: np.dtype[Any] | None, stream: io.BytesIO) -> bool:
    return row is not None and row.itemsize > 0 and stream.tell() + element.count * row.itemsize <= len(body)


def _parse(stream: BinaryIO, elements: Sequence[Element], encoding: str, path: Path, line: int) -> dict[str, Columns]:
    parsed = {}
    for element in elements:
        parsed[element.name] = read_element(stream, element, encoding, path, line)
        line += element.count
    return parsed


def _format(parsed: dict[str, Columns], elements: Sequence[Element], encoding: str) -> bytes:
    return b"".join(chunk for element in elements for chunk in format_element(parsed[element.name], element, encoding))


def _transcode(extra: PlyExtra, encoding: str) -> bytes:
    line = extra.header_lines + 1 + extra.points
    parsed = _parse(io.BytesIO(extra.body), extra.elements, extra.encoding, extra.path, line)
    return _format(parsed, extra.elements, encoding)


def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write a PLY file. New normals have the type of the coordinates.

    Returns:
        What could not be kept.
    """
    return write_whole(_Rows(len(cloud), stream, encoding), cloud)


def write_rows(first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str) -> RowWriter:
    """Begin a PLY file of so many points."""
    return _Rows(points, stream, encoding)


class _Rows:
    """Writes vertices behind a header, and the other elements of the input behind them."""

    def __init__(self, points: int, stream: BinaryIO, encoding: str) -> None:
        self._points, self._stream, self._encoding = points, stream, encoding
        self._layout = SameLayout()
        self._vertex: Element | None = None
        self._warnings: list[str] = []
        self._tail = b""

    def write(self, cloud: Cloud) -> None:
        """Append vertices; the header precedes the first ones."""
        floating = cloud.source.point_dtype.kind == "f"
        columns, warnings = columns_from_cloud(
            cloud, NORMALS, cloud.source.point_dtype if floating else np.dtype(np.float32)
        )
        if cloud.source.format == "pcd":
            columns = unpack_colors(columns)
        columns, changed = to_storable(columns, frozenset((*TYPE_NAMES, "O")), vectors=False)
        self._layout.check(columns, warnings + changed)
        if self._vertex is None:
            self._begin(cloud.source, columns)
            self._warnings = warnings + self._warnings + changed
        assert self._vertex is not None
        rows = replace(self._vertex, count=len(cloud))
        for chunk in format_element(columns, rows, self._encoding):
            self._stream.write(chunk)

    def _begin(self, source: Source, columns: Columns) -> None:
        extra = source.extra if isinstance(source.extra, PlyExtra) else None
        elements, self._tail = (extra.elements, extra.body) if extra else ((), b"")
        if extra and elements and self._points != extra.points:
            gone = f"{describe_elements(elements)} would refer to points that are gone and is not kept"
            self._warnings.append(gone)
            elements, self._tail = (), b""
        elif extra and elements and self._encoding != extra.encoding:
            self._tail = _transcode(extra, self._encoding)
        self._vertex = _vertex_element(columns, self._points, extra.length_types if extra else {})
        object_info = extra.object_info if extra else ()
        header = Header(self._encoding, (self._vertex, *elements), source.comments, object_info)
        self._stream.write(header.encode())

    def finish(self) -> list[str]:
        """Write the other elements."""
        self._stream.write(self._tail)
        return self._warnings


def describe_elements(elements: Sequence[Element]) -> str:
    """Name some elements as in a message, such as ``element 'face' (12 rows)``."""
    return ", ".join(f"element {element.name!r} ({element.count} rows)" for element in elements)


def _vertex_element(columns: Columns, points: int, length_types: dict[str, str]) -> Element:
    properties = []
    for name, values in columns.items():
        if values.dtype != object:
            properties.append(Property(name, values.dtype.str[1:]))
            continue
        longest = max(map(len, values), default=0)
        length_type = length_types.get(name, "u1")
        if longest > np.iinfo(length_type).max:
            length_type = "u4"
        properties.append(Property(name, values[0].dtype.str[1:] if len(values) else "f4", length_type))
    return Element("vertex", points, tuple(properties))


FORMATS = (Format("ply", (".ply",), read, write, ENCODINGS, stream=stream, write_rows=write_rows),)
