"""NumPy's .npy and .npz files, and the .bin files of KITTI.

An .npy file holds one array: rows of x y z, perhaps with normals and more, (N, 3 or more); a grid of such rows,
(H, W, 3 or more); or a structured array with fields of the usual names. An .npz file holds ``points`` (N, 3), perhaps
``normals``, and attributes of N rows each, by their names.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.columns import (
    COORDINATES,
    NORMALS,
    Columns,
    UniqueNames,
    as_unicode,
    cloud_from_columns,
    columns_from_cloud,
)
from jetnormal.formats.npz import describe_all, load_all, rows_of
from jetnormal.formats.registry import Format
from jetnormal.formats.storage import to_storable
from jetnormal.formats.streams import ROWS, CloudStream, RowWriter, SameLayout, from_table, memory_of, write_whole
from jetnormal.formats.text_columns import SKIPPED, Layout

ENCODINGS = ("binary",)

_POINTS = ("points", "xyz", "pos", "positions", "coordinates", "coords", "vertices", "arr_0")
_NORMALS = ("normals", "normal")
_TYPES = frozenset(("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"))


def read(path: Path, *, columns: str | None = None, decimal: str | None = None) -> Cloud:
    """Read an .npy or .npz file.

    Args:
        path: the file.
        columns: what the columns of an array are (`text_columns.Layout`).
        decimal: must be None; files of text have decimal signs.

    Raises:
        InputError: the file is damaged, or holds no points.
        UsageError: `columns` do not fit the file.
    """
    layout = _layout(columns, decimal, path)
    arrays = load_all(path)
    held = _find(arrays, path)
    names, notes = _name(held, arrays, layout, path)
    return _cloud(held, arrays, names, replace(held.source, notes=held.source.notes + notes), path)


@dataclass(frozen=True)
class _Held:
    """What the arrays of a file are.

    Attributes:
        points: name of the array of points; None if each coordinate has its own.
        normals: name of the array of normals, if there is one.
        attributes: names of the arrays that have a row for each point.
        count: points.
        source: what the shapes tell.
    """

    points: str | None
    normals: str | None
    attributes: tuple[str, ...]
    count: int
    source: Source

    @property
    def used(self) -> list[str]:
        """The names of all these arrays."""
        return [name for name in (self.points, self.normals, *self.attributes) if name is not None]


def _find(arrays: Mapping[str, NDArray[Any]], path: Path) -> _Held:
    """Find by names and shapes which array is what."""
    lower = {name.lower(): name for name in reversed(list(arrays))}
    if all(name in lower for name in COORDINATES):
        lengths = {values.shape[:1] for values in arrays.values()}
        if len(lengths) != 1 or lengths == {()}:
            raise InputError(f"{path}: the arrays do not have the same number of rows")
        return _Held(None, None, tuple(arrays), lengths.pop()[0], Source(format="numpy", encoding="binary"))
    points = next((lower[name] for name in _POINTS if name in lower), None)
    if points is None:
        raise InputError(f"{path}: no array of points among {', '.join(arrays) or 'nothing'}; call it points")
    source, table = _as_rows(arrays[points], path)
    if table.dtype.names:
        return _Held(points, None, (), len(table), source)
    normals = next((lower[each] for each in _NORMALS if each in lower), None)
    if normals is not None and arrays[normals].shape != (len(table), 3):
        normals = None
    others = {name: values.shape[:1] for name, values in arrays.items() if name not in (points, normals)}
    kept = tuple(name for name, length in others.items() if length == (len(table),))
    left = [name for name in others if name not in kept]
    notes = (f"arrays that do not have a row for each point are left out: {', '.join(left)}",) if left else ()
    return _Held(points, normals, kept, len(table), replace(source, notes=notes))


def _name(
    held: _Held, arrays: Mapping[str, NDArray[Any]], layout: Layout, path: Path
) -> tuple[list[str], tuple[str, ...]]:
    """Name the columns of the array of points by the layout or their values; return what to tell the user, too."""
    if held.points is None or arrays[held.points].dtype.names:
        return [], ()
    return layout.apply(None, list(_as_rows(arrays[held.points], path)[1].T), ".npy", path)


def _cloud(held: _Held, arrays: Mapping[str, NDArray[Any]], names: list[str], source: Source, path: Path) -> Cloud:
    """Make a cloud of arrays, or of the same rows of each."""
    found: Columns = {}
    if held.points is not None:
        table = _as_rows(arrays[held.points], path)[1]
        if table.dtype.names:
            return cloud_from_columns({field: table[field] for field in table.dtype.names}, source, path)
        found = {key: values for key, values in zip(names, table.T, strict=True) if key != SKIPPED}
    if held.normals is not None:
        found |= dict(zip(NORMALS, arrays[held.normals].T, strict=True))
    return cloud_from_columns(found | {name: arrays[name] for name in held.attributes}, source, path)


def _layout(columns: str | None, decimal: str | None, path: Path) -> Layout:
    if decimal is not None:
        raise UsageError(f"{path}: `decimal` is for text files")
    return Layout.parse(columns)


def stream(path: Path, *, columns: str | None = None, decimal: str | None = None) -> CloudStream:
    """Open an .npy or .npz file to be read in pieces.

    Raises:
        InputError: the file is damaged, or holds no points.
        UsageError: `columns` do not fit the file.
    """
    layout = _layout(columns, decimal, path)
    if zipfile.is_zipfile(path):
        return _stream_npz(path, layout)
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except ValueError as error:
        raise InputError(f"{path}: is no array of numbers that can be read in pieces ({error})") from None
    source, table = _as_rows(array, path)
    if table.dtype.names:
        return from_table(table, source, path)
    names, notes = layout.apply(None, list(table[:ROWS].T), ".npy", path)
    source = replace(source, notes=notes)

    def pieces(rows: int) -> Iterator[Cloud]:
        for start in range(0, max(1, len(table)), rows):
            piece = np.array(table[start : start + rows])
            found = {name: values for name, values in zip(names, piece.T, strict=True) if name != SKIPPED}
            yield cloud_from_columns(found, source, path)

    return CloudStream(len(table), memory_of(next(pieces(1))), pieces)


def _stream_npz(path: Path, layout: Layout) -> CloudStream:
    described = describe_all(path)
    held = _find({name: each.blank for name, each in described.items()}, path)
    wanted = {name: described[name] for name in held.used}
    names, notes = _name(held, next(rows_of(path, wanted, held.count, ROWS)), layout, path)
    source = replace(held.source, notes=held.source.notes + notes)

    def pieces(rows: int) -> Iterator[Cloud]:
        return (_cloud(held, arrays, names, source, path) for arrays in rows_of(path, wanted, held.count, rows))

    return CloudStream(held.count, memory_of(next(pieces(1))), pieces)


def _as_rows(array: NDArray[Any], path: Path) -> tuple[Source, NDArray[Any]]:
    """Points as rows (N, c) or records (N,); the source tells the shape of a grid."""
    grid = array.ndim - (array.dtype.names is None)
    if grid not in (1, 2) or (array.dtype.names is None and (array.shape[-1] < 3 or array.dtype.kind not in "iuf")):
        raise InputError(
            f"{path}: an array of shape {array.shape} and type {array.dtype} holds no points; (N, 3) or (H, W, 3) do"
        )
    source = Source(format="numpy", encoding="binary")
    if grid == 2:
        source = Source(format="numpy", encoding="binary", width=array.shape[1], height=array.shape[0])
        array = array.reshape(-1, *array.shape[2:])
    return source, array


def write_npy(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write an array (N, 3), with normals (N, 6), or with attributes a structured one (N,). Grids stay grids.

    Returns:
        What could not be kept.
    """
    return write_whole(_Rows(len(cloud), stream), cloud)


def write_rows(first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str) -> RowWriter:
    """Begin an .npy file of so many points."""
    return _Rows(points, stream)


class _Rows:
    """Writes the rows of an array behind its header."""

    def __init__(self, points: int, stream: BinaryIO) -> None:
        self._points, self._stream = points, stream
        self._layout = SameLayout()
        self._warnings: list[str] | None = None

    def write(self, cloud: Cloud) -> None:
        """Append points; the header precedes the first ones."""
        columns, warnings = _columns(cloud)
        self._layout.check(columns, warnings)
        table: NDArray[Any]
        if cloud.attributes:
            table = np.empty(len(cloud), [(name, values.dtype, values.shape[1:]) for name, values in columns.items()])
            for name, values in columns.items():
                table[name] = values
        else:
            table = np.stack([columns[name] for name in (*COORDINATES, *NORMALS) if name in columns], axis=1)
        if self._warnings is None:
            self._warnings = warnings
            shape = (*self._shape(cloud.source), *table.shape[1:])
            header = {"descr": np.lib.format.dtype_to_descr(table.dtype), "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(self._stream, header)
        self._stream.write(np.ascontiguousarray(table).tobytes())

    def _shape(self, source: Source) -> tuple[int, ...]:
        width, height = source.width or 0, source.height or 0
        is_grid = source.format == "numpy" and height > 1 and width * height == self._points
        return (height, width) if is_grid else (self._points,)

    def finish(self) -> list[str]:
        """Nothing follows the rows."""
        return self._warnings or []


def write_npz(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]:
    """Write the arrays ``points``, ``normals``, and one for each attribute.

    Returns:
        What could not be kept.
    """
    columns, warnings = _columns(cloud)
    arrays: Columns = {"points": np.stack([columns.pop(name) for name in COORDINATES], axis=1)}
    if cloud.normals is not None:
        arrays["normals"] = np.stack([columns.pop(name) for name in NORMALS], axis=1)
    unique = UniqueNames((*arrays, "file", "allow_pickle"))  # the last are savez's own parameters
    new_names = {name: unique.add(as_unicode(name)) for name in columns}
    warnings += [f"attribute {name!r} is written as {new!r}" for name, new in new_names.items() if new != name]
    named = {new_names[name]: values for name, values in columns.items()}
    np.savez(stream, allow_pickle=False, **arrays, **named)
    return warnings


def _columns(cloud: Cloud) -> tuple[Columns, list[str]]:
    columns, renamed = columns_from_cloud(cloud, NORMALS, np.dtype(np.float32))
    columns, changed = to_storable(columns, _TYPES, vectors=True)
    return columns, renamed + changed


def read_kitti(path: Path) -> Cloud:
    """Read rows x y z reflectance in float32, as in KITTI's velodyne folders; the scanner stands in the origin.

    Raises:
        InputError: the file does not consist of such rows.
    """
    size = path.stat().st_size
    if size % 16:
        raise InputError(f"{path}: {size} bytes are no rows of four float32; is this a KITTI scan?")
    with path.open("rb") as stream:
        table = np.fromfile(stream, "<f4").reshape(-1, 4)
    columns: Columns = dict(zip((*COORDINATES, "intensity"), table.T, strict=True))
    source = Source(format="kitti", encoding="binary", sensors=np.zeros((len(table), 3)))
    return cloud_from_columns(columns, source, path)


FORMATS = (
    Format("numpy", (".npy",), read, write_npy, ENCODINGS, has_columns=True, stream=stream, write_rows=write_rows),
    Format("numpy", (".npz",), read, write_npz, ENCODINGS, has_columns=True, stream=stream),
    Format("kitti", (), read_kitti, None, ENCODINGS),
)
