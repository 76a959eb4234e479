"""The faces of a PLY file, which the codec of clouds carries along as bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError
from jetnormal.formats.ply import PlyExtra
from jetnormal.formats.ply_header import BYTE_ORDERS, Element
from jetnormal.formats.ply_rows import read_element
from jetnormal.formats.table import read_table

LIST_NAMES = ("vertex_indices", "vertex_index")


def polygons_of(extra: PlyExtra, path: Path) -> Sequence[NDArray[Any]] | NDArray[Any]:
    """Return the corners of each face: an array (F, 3) if all are triangles, or F arrays (n,); none without faces.

    Raises:
        InputError: the faces have no list of vertices, or rows are damaged.
    """
    stream = io.BytesIO(extra.body)
    line = extra.header_lines + 1 + extra.points
    for element in extra.elements:
        if element.name == "face":
            return _polygons(stream, element, extra, path, line)
        read_element(stream, element, extra.encoding, path, line)
        line += element.count
    return []


def _polygons(stream: io.BytesIO, element: Element, extra: PlyExtra, path: Path, line: int) -> Any:
    names = [prop.name for prop in element.properties if prop.length_type and prop.name in LIST_NAMES]
    if not names:
        raise InputError(f"{path}: its faces have no list {LIST_NAMES[0]!r}; export the mesh again")
    (kind,) = {prop.type[0] for prop in element.properties if prop.name == names[0]}
    if kind == "f":
        raise InputError(f"{path}: the list {names[0]!r} holds no integers; export the mesh again")
    if len(element.properties) == 1:
        triangles = _triangles(stream, element, extra.encoding, path, line)
        if triangles is not None:
            return triangles
    return read_element(stream, element, extra.encoding, path, line)[names[0]]


def _triangles(stream: io.BytesIO, element: Element, encoding: str, path: Path, line: int) -> NDArray[np.int64] | None:
    """The corners (F, 3) if a list of three is all that each row holds: nearly every mesh, and quick to read."""
    start, (prop,) = stream.tell(), element.properties
    if encoding == "ascii":
        try:
            rows = read_table(stream, np.dtype(np.int64), path=path, line=line, columns=4, rows=element.count)
        except InputError:  # other polygons, or damaged: reading row by row tells
            stream.seek(start)
            return None
        if element.count == 0:
            return np.empty((0, 3), np.int64)
        lengths, corners = rows[:, 0], rows[:, 1:]
    else:
        order = BYTE_ORDERS[encoding]
        row = np.dtype([("length", f"{order}{prop.length_type}"), ("corners", f"{order}{prop.type}", (3,))])
        if len(stream.getbuffer()) - start < element.count * row.itemsize:
            return None
        table = np.frombuffer(stream.getbuffer(), row, element.count, start)
        lengths, corners = table["length"], table["corners"]
    return corners.astype(np.int64) if (lengths == 3).all() else None
