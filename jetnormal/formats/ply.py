"""PLY, the Stanford polygon format: ascii and binary of either byte order.

Format: http://paulbourke.net/dataformats/ply/

The vertices of nearly every file are scalar properties that come first; they are read and written here, as
one structured array. What follows them (faces, edges...) is carried along as the bytes it is. plyfile, which
parses row by row, does the rest: lists per vertex, elements before the vertices, and other elements whose
encoding changes.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import NORMALS, Columns, cloud_from_columns, columns_from_cloud
from jetnormal.formats.ply_header import BYTE_ORDERS, TYPE_NAMES, Element, Header, Property, read_header
from jetnormal.formats.storage import to_storable, unpack_colors
from jetnormal.formats.table import format_rows, read_table


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
    """

    object_info: tuple[str, ...]
    elements: tuple[Element, ...]
    encoding: str
    body: bytes
    length_types: dict[str, str]
    points: int


def read(path: Path) -> Cloud:
    """Reads a PLY file.

    Raises:
        InputError: if the file is no PLY file, is damaged, or its vertices have no coordinates.
    """
    with path.open("rb") as stream:
        header = read_header(stream, path)
        names = [element.name for element in header.elements]
        if names.count("vertex") != 1 or len(set(names)) != len(names):
            raise InputError(
                f"{path}: must hold one element 'vertex', but holds {', '.join(names) or 'nothing'}"
            )
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
        try:
            if vertex is header.elements[0] and vertex.is_scalar:
                columns, body = _read_scalars(stream, header, vertex, path)
                _check_body(others, header.encoding, body)
            else:
                columns, body = _read_any(stream, header, vertex)
        except ValueError as error:
            raise InputError(f"{path}: {error}; the file is damaged, export it again") from None
    lengths = {prop.name: prop.length_type for prop in vertex.properties if prop.length_type}
    extra = PlyExtra(header.object_info, others, header.encoding, body, lengths, vertex.count)
    source = Source(format="ply", encoding=header.encoding, comments=header.comments, extra=extra)
    return cloud_from_columns(columns, source, path)


def _read_scalars(stream: BinaryIO, header: Header, vertex: Element, path: Path) -> tuple[Columns, bytes]:
    dtype = vertex.dtype(header.encoding)
    if header.encoding == "ascii":
        table = read_table(
            stream, dtype, path=path, line=header.lines + 1, columns=len(vertex.properties), rows=vertex.count
        )
    else:
        table = np.fromfile(stream, dtype, vertex.count)
    return {name: table[name] for name in dtype.names or ()}, stream.read()


def _read_any(stream: BinaryIO, header: Header, vertex: Element) -> tuple[Columns, bytes]:
    elements = _parse(header.elements, header.encoding, stream.read())
    data = next(element for element in elements if element.name == "vertex").data
    body = _format([element for element in elements if element.name != "vertex"], header.encoding)
    return {prop.name: data[prop.name] for prop in vertex.properties}, body


def _check_body(elements: Sequence[Element], encoding: str, body: bytes) -> None:
    """Raises ValueError if the rows of the elements that are carried along are not all there."""
    if encoding == "ascii":
        rows, expected = sum(1 for line in body.splitlines() if line.strip()), sum(e.count for e in elements)
        if rows != expected:
            raise ValueError(f"{rows} rows follow the vertices instead of {expected}")
    elif not all(element.is_scalar for element in elements) and not _is_triangles(elements, encoding, body):
        _parse(elements, encoding, body)


def _is_triangles(elements: Sequence[Element], encoding: str, body: bytes) -> bool:
    """Whether the elements are one list of three numbers per row: nearly every mesh, and quick to tell."""
    if len(elements) != 1 or len(elements[0].properties) != 1:
        return False
    order, prop = BYTE_ORDERS[encoding], elements[0].properties[0]
    row = np.dtype([("length", f"{order}{prop.length_type}"), ("values", f"{order}{prop.type}", (3,))])
    if len(body) != elements[0].count * row.itemsize:
        return False
    return bool((np.frombuffer(body, row)["length"] == 3).all())


def _parse(elements: Sequence[Element], encoding: str, body: bytes) -> list[Any]:
    """The plyfile elements in a file's body. Raises ValueError where it is damaged."""
    import plyfile

    try:
        return list(
            plyfile.PlyData.read(io.BytesIO(Header(encoding, tuple(elements)).encode() + body)).elements
        )
    except plyfile.PlyParseError as error:
        raise ValueError(" ".join(str(error).split())) from None


def _format(elements: Sequence[Any], encoding: str) -> bytes:
    """A file's body made of plyfile elements."""
    import plyfile

    stream = io.BytesIO()
    plyfile.PlyData(elements, text=encoding == "ascii", byte_order=BYTE_ORDERS[encoding]).write(stream)
    return stream.getvalue().partition(b"end_header\n")[2]


def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Writes a PLY file. New normals have the type of the coordinates.

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
        tail = _format(_parse(elements, extra.encoding, tail), encoding)
    vertex = _vertex_element(columns, extra.length_types if extra else {})
    object_info = extra.object_info if extra else ()
    stream.write(Header(encoding, (vertex, *elements), cloud.source.comments, object_info).encode())
    for chunk in _vertex_body(columns, vertex, encoding):
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


def _vertex_body(columns: Columns, vertex: Element, encoding: str) -> Iterator[bytes | memoryview]:
    if not vertex.is_scalar:
        yield _format([_plyfile_element(columns, vertex)], encoding)
    elif encoding == "ascii":
        yield from format_rows(list(columns.values()), " ")
    else:
        table = np.empty(vertex.count, vertex.dtype(encoding))
        for name, values in columns.items():
            table[name] = values
        yield table.view(np.uint8).data


def _plyfile_element(columns: Columns, vertex: Element) -> Any:
    import plyfile

    table = np.empty(vertex.count, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    lists = [prop for prop in vertex.properties if prop.length_type]
    return plyfile.PlyElement.describe(
        table,
        vertex.name,
        len_types={prop.name: prop.length_type for prop in lists},
        val_types={prop.name: prop.type for prop in lists},
    )
