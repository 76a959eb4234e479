"""PLY, the Stanford polygon format: ascii and binary of either byte order.

Format: http://paulbourke.net/dataformats/ply/

The vertices come and go as columns. What follows them (faces, edges...) is carried along as the bytes it is,
unless the encoding changes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import NORMALS, Columns, cloud_from_columns, columns_from_cloud
from jetnormal.formats.ply_header import BYTE_ORDERS, ENCODINGS, TYPE_NAMES, Element, Header, Property, read_header
from jetnormal.formats.ply_rows import format_element, read_element
from jetnormal.formats.registry import Format
from jetnormal.formats.storage import to_storable, unpack_colors


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
        vertex = header.elements[names.index("vertex")]
        others = tuple(element for element in header.elements if element is not vertex)
        trailing = 0
        if vertex is header.elements[0]:
            columns = read_element(stream, vertex, header.encoding, path, header.lines + 1)
            body = stream.read()
            size = _check_body(others, header.encoding, body, path, header.lines + 1 + vertex.count)
            body, trailing = body[:size], len(body) - size
        else:
            parsed = _parse(stream, header.elements, header.encoding, path, header.lines + 1)
            columns = parsed.pop("vertex")
            body = _format(parsed, others, header.encoding)
            trailing = len(stream.read()) if header.encoding != "ascii" else 0
    lengths = {prop.name: prop.length_type for prop in vertex.properties if prop.length_type}
    extra = PlyExtra(header.object_info, others, header.encoding, body, lengths, vertex.count, path, header.lines)
    notes = (f"{trailing} bytes behind the last element are left out",) if trailing else ()
    source = Source(format="ply", encoding=header.encoding, comments=header.comments, extra=extra, notes=notes)
    return cloud_from_columns(columns, source, path)


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
    floating = cloud.source.point_dtype.kind == "f"
    columns, warnings = columns_from_cloud(
        cloud, NORMALS, cloud.source.point_dtype if floating else np.dtype(np.float32)
    )
    if cloud.source.format == "pcd":
        columns = unpack_colors(columns)
    extra = cloud.source.extra if isinstance(cloud.source.extra, PlyExtra) else None
    columns, changed = to_storable(columns, frozenset((*TYPE_NAMES, "O")), vectors=False)
    elements, tail = (extra.elements, extra.body) if extra else ((), b"")
    if extra and elements and len(cloud) != extra.points:
        warnings.append(f"{describe_elements(elements)} would refer to points that are gone and is not kept")
        elements, tail = (), b""
    elif extra and elements and encoding != extra.encoding:
        tail = _transcode(extra, encoding)
    vertex = _vertex_element(columns, extra.length_types if extra else {})
    object_info = extra.object_info if extra else ()
    stream.write(Header(encoding, (vertex, *elements), cloud.source.comments, object_info).encode())
    for chunk in format_element(columns, vertex, encoding):
        stream.write(chunk)
    stream.write(tail)
    return warnings + changed


def describe_elements(elements: Sequence[Element]) -> str:
    """What to call some elements in a message, such as ``element 'face' (12 rows)``."""
    return ", ".join(f"element {element.name!r} ({element.count} rows)" for element in elements)


def _vertex_element(columns: Columns, length_types: dict[str, str]) -> Element:
    properties = []
    for name, values in columns.items():
        if values.dtype != object:
            properties.append(Property(name, values.dtype.str[1:]))
            continue
        longest = max(map(len, values), default=0)
        length_type = length_types.get(name, "u1")
        if longest > np.iinfo(length_type).max:
            length_type = "u4"
        kinds = {np.asarray(row).dtype.newbyteorder("=") for row in values}
        properties.append(Property(name, np.result_type(*kinds).str[1:] if kinds else "f4", length_type))
    return Element("vertex", len(columns["x"]), tuple(properties))


FORMATS = (Format("ply", (".ply",), read, write, ENCODINGS),)
