"""PCD, the Point Cloud Library's format: ascii, binary (little endian) and LZF-compressed binary.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats import lzf
from jetnormal.formats.columns import Columns, UniqueNames, cloud_from_columns, columns_from_cloud
from jetnormal.formats.pcd_header import ENCODINGS, TYPES, Header, header_text, read_header
from jetnormal.formats.registry import Format
from jetnormal.formats.storage import pack_colors, to_storable
from jetnormal.formats.streams import CloudStream, RowWriter, SameLayout, from_chunks, from_table, mapped, write_whole
from jetnormal.formats.table import format_rows, read_table, skip_rows, table_pieces

_NORMALS = ("normal_x", "normal_y", "normal_z")


def read(path: Path) -> Cloud:
    """Read a PCD file. Organized clouds come row after row, NaN points included. Padding is left out.

    Raises:
        InputError: if the file is no PCD file, is damaged, or holds no coordinates.
    """
    with path.open("rb") as stream:
        header = read_header(stream, path)
        size = path.stat().st_size - stream.tell()
        if header.encoding == "ascii":
            columns = _read_ascii(stream, header, size, path)
        elif header.encoding == "binary":
            columns = _read_binary(stream, header, size, path)
        else:
            columns = _read_compressed(stream, header, size, path)
    columns = {name: values for name, values in columns.items() if name not in header.padding}
    return cloud_from_columns(columns, _source(header), path)


def stream(path: Path) -> CloudStream:
    """Open a PCD file to be read in pieces.

    Raises:
        InputError: the file is compressed, or as `read`. What is wrong in rows of text shows when they are read.
    """
    with path.open("rb") as file:
        header = read_header(file, path)
        offset, size = file.tell(), path.stat().st_size - file.tell()
        if header.encoding == "binary_compressed":
            raise InputError(f"{path}: is not read in pieces: a compressed PCD file is packed as a whole")
        if header.encoding == "ascii":
            return _stream_ascii(file, header, size, path)
        _check_size(header, header.points * header.dtype.itemsize, size, path)
    return from_table(mapped(path, header.dtype, offset, header.points), _source(header), path, header.padding)


def _stream_ascii(file: BinaryIO, header: Header, size: int, path: Path) -> CloudStream:
    _check_size(header, header.least_text, size, path)
    offset = file.tell()
    found = skip_rows(file, header.points)
    if found < header.points:
        raise InputError(f"{path}: declares {header.points} points but holds {found}; the file is truncated")
    _check_end(file, header, path)
    layout: dict[str, Any] = {"line": header.lines + 1, "columns": header.columns, "count": header.points}
    return from_chunks(
        header.points,
        lambda rows: table_pieces(path, offset, header.dtype, rows=rows, **layout),
        _source(header),
        path,
        header.padding,
    )


def _source(header: Header) -> Source:
    return Source(
        format="pcd",
        encoding=header.encoding,
        comments=header.comments,
        viewpoint=header.viewpoint,
        width=header.width,
        height=header.height,
    )


def _read_ascii(stream: BinaryIO, header: Header, size: int, path: Path) -> Columns:
    _check_size(header, header.least_text, size, path)
    table = read_table(
        stream,
        header.dtype,
        path=path,
        line=header.lines + 1,
        columns=header.columns,
        rows=header.points,
    )
    _check_end(stream, header, path)
    return _fields(table)


def _check_end(stream: BinaryIO, header: Header, path: Path) -> None:
    """Refuse text that has more rows than it declares."""
    if skip_rows(stream, 1):
        raise InputError(f"{path}: holds more than the {header.points} points it declares; correct POINTS")


def _read_binary(stream: BinaryIO, header: Header, size: int, path: Path) -> Columns:
    _check_size(header, header.points * header.dtype.itemsize, size, path)
    return _fields(np.fromfile(stream, header.dtype, header.points))


def _read_compressed(stream: BinaryIO, header: Header, size: int, path: Path) -> Columns:
    """The fields lie one after another (all x, then all y, ...), packed as a whole."""
    if header.points == 0:
        return _fields(np.empty(0, header.dtype))
    expected = header.points * header.dtype.itemsize
    _check_size(header, 8 + expected // lzf.MAX_RATIO, size, path)
    packed_size, unpacked_size = struct.unpack("<II", stream.read(8))
    packed = stream.read(min(packed_size, size))
    if unpacked_size != expected or len(packed) != packed_size:
        raise InputError(
            f"{path}: {header.points} points need {expected} bytes, but {len(packed)} of {packed_size} "
            f"compressed bytes for {unpacked_size} are there; the file is truncated or its header is wrong"
        )
    try:
        data = lzf.decompress(packed, unpacked_size)
    except ValueError as error:
        raise InputError(f"{path}: damaged compressed data ({error}); export the file again") from None
    columns: Columns = {}
    offset = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        values = np.frombuffer(data, field.base, header.points * int(np.prod(field.shape)), offset)
        columns[name] = values.reshape(header.points, *field.shape)
        offset += values.nbytes
    return columns


def _check_size(header: Header, needed: int, size: int, path: Path) -> None:
    if needed > size:
        raise InputError(
            f"{path}: declares {header.points} points, which need at least {needed} bytes, but {size} follow "
            "the header; the file is truncated or its header is wrong"
        )


def _fields(table: NDArray[Any]) -> Columns:
    return {name: table[name] for name in table.dtype.names or ()}


def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write a PCD file.

    New normals are float32, as in PCL's point types, and come with a ``curvature``: pcl::Normal and
    pcl::PointNormal hold the four together, and PCL's loader complains about a file without it. An unknown
    curvature is 0, PCL's own default. Colors of other formats are packed into ``rgb``.

    Returns:
        What could not be kept.
    """
    return write_whole(_Rows(len(cloud), stream, encoding), cloud)


def write_rows(first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str) -> RowWriter:
    """Begin a PCD file of so many points, binary or ascii.

    Raises:
        InputError: the encoding is binary_compressed, which packs a whole cloud field by field.
    """
    if encoding == "binary_compressed":
        raise InputError("a compressed PCD file is not written in pieces; choose the encoding 'binary'")
    return _Rows(points, stream, encoding)


class _Rows:
    """Writes points behind a header."""

    def __init__(self, points: int, stream: BinaryIO, encoding: str) -> None:
        self._points, self._stream, self._encoding = points, stream, encoding
        self._layout = SameLayout()
        self._warnings: list[str] | None = None

    def write(self, cloud: Cloud) -> None:
        """Append points; the header precedes the first ones."""
        columns, warnings = columns_from_cloud(cloud, _NORMALS, np.dtype(np.float32))
        if cloud.source.format != "pcd":
            columns = pack_colors(columns)
        columns, changed = to_storable(columns, TYPES, vectors=True)
        if "_" in columns:  # which means padding
            free = UniqueNames(columns).add("column")
            columns = {free if name == "_" else name: values for name, values in columns.items()}
            changed.append(f"attribute '_' is written as {free!r}")
        if cloud.normals is not None and cloud.source.normal_dtype is None:
            columns = _with_curvature(columns, len(cloud))
        if self._encoding == "ascii":
            columns = {name: _printable_color(name, values) for name, values in columns.items()}
        self._layout.check(columns, warnings + changed)
        if self._warnings is None:
            self._warnings = warnings + changed
            header = header_text(cloud.source, self._points, columns, self._encoding)
            self._stream.write(header.encode("utf-8", "surrogateescape"))
        for chunk in _body(columns, self._encoding):
            self._stream.write(chunk)

    def finish(self) -> list[str]:
        """Nothing follows the points."""
        return self._warnings or []


def _with_curvature(columns: Columns, points: int) -> Columns:
    curvature = columns.pop("curvature", np.zeros(points)).astype(np.float32)
    ordered: Columns = {}
    for name, values in columns.items():
        ordered[name] = values
        if name == _NORMALS[-1]:
            ordered["curvature"] = curvature
    return ordered


def _printable_color(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Opaque colors packed in floats are NaN, whose bits text would lose: as in PCL, integers it is."""
    if name in ("rgb", "rgba") and values.dtype == np.float32 and not np.isfinite(values).all():
        return np.ascontiguousarray(values).view(np.uint32)
    return values


def _body(columns: Columns, encoding: str) -> Iterator[bytes | memoryview]:
    points = len(columns["x"])
    if encoding == "ascii":
        flat = [part for values in columns.values() for part in values.reshape(points, -1).T] if points else []
        yield from format_rows(flat, " ") if points else ()
    elif encoding == "binary":
        described = [(name, values.dtype.newbyteorder("<"), values.shape[1:]) for name, values in columns.items()]
        table = np.empty(points, np.dtype(described))
        for name, values in columns.items():
            table[name] = values
        yield table.view(np.uint8).data
    else:
        fields = b"".join(values.astype(values.dtype.newbyteorder("<")).tobytes() for values in columns.values())
        if len(fields) > 0xFFFFFFFF:
            raise InputError("a compressed PCD file holds at most 4 GiB; choose the encoding 'binary'")
        packed = lzf.compress(fields)
        yield struct.pack("<II", len(packed), len(fields)) + packed


FORMATS = (
    Format("pcd", (".pcd",), read, write, ENCODINGS, keeps_viewpoint=True, stream=stream, write_rows=write_rows),
)
