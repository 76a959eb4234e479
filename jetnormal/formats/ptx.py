"""PTX, Leica's text format of terrestrial scans: a grid of points for each scan, below the pose of its scanner.

Ten lines precede each grid: its columns, its rows, the scanner's position, its three axes, and the four rows of the
matrix that takes points (as rows) into the common frame. Then come x y z intensity, perhaps with red green blue, column
by column; ``0 0 0`` stands for what was not measured. The format has no place for normals, so it is only read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import COORDINATES, Columns
from jetnormal.formats.registry import Format
from jetnormal.formats.scans import Pose, Scan, cloud_from_scans, stream_of_scans
from jetnormal.formats.storage import COLORS
from jetnormal.formats.streams import CloudStream
from jetnormal.formats.table import read_table

_NAMES = {3: COORDINATES, 4: (*COORDINATES, "intensity"), 7: (*COORDINATES, "intensity", *COLORS)}
_LONGEST_LINE = 1 << 16
_TOLERANCE = 1e-3  # of a rotation written with few decimals


def read(path: Path) -> Cloud:
    """Read a PTX file: all scans, in the common frame; points that were not measured are left out and counted.

    The attributes ``row`` and ``column`` are those of the grid.

    Raises:
        InputError: the file is no PTX file, or is damaged.
    """
    return cloud_from_scans(list(_scans(path)), Source(format="ptx", encoding="ascii"), path)


def stream(path: Path) -> CloudStream:
    """Open a PTX file to be read scan by scan.

    Raises:
        InputError: as `read`.
    """
    return stream_of_scans(lambda: _scans(path), Source(format="ptx", encoding="ascii"), path)


def _scans(path: Path) -> Iterator[Scan]:
    with path.open("rb") as stream:
        line = 1
        while (first := _next_line(stream)) is not None:
            scan, line = _read_scan(stream, first, path, line)
            yield scan


def _next_line(stream: BinaryIO) -> list[str] | None:
    """The words of the next line that has any; None at the end."""
    while raw := stream.readline(_LONGEST_LINE):
        if words := raw.decode("latin1").split():
            return words
    return None


def _read_scan(stream: BinaryIO, first: list[str], path: Path, line: int) -> tuple[Scan, int]:
    header = [first, *(_next_line(stream) or [] for _ in range(9))]
    try:
        (width,), (height,) = ([int(word) for word in words] for words in header[:2])
        matrix = np.array([[float(word) for word in words] for words in header[6:]])
        if width < 0 or height < 0 or matrix.shape != (4, 4) or any(len(words) != 3 for words in header[2:6]):
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: line {line}: no ten lines of a PTX header; is this a PTX file?") from None
    rotation = matrix[:3, :3].T
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: line {line + 6}: the matrix is no rotation with a translation; correct it")
    columns = _read_grid(stream, width, height, path, line + 10)
    measured = np.any([columns[name] != 0 for name in COORDINATES], axis=0)
    columns = {name: values[measured] for name, values in columns.items()}
    scan = Scan(columns, Pose(rotation, matrix[3, :3]), int(np.sum(~measured)))
    return scan, line + 10 + width * height


def _read_grid(stream: BinaryIO, width: int, height: int, path: Path, line: int) -> Columns:
    start = stream.tell()
    count = len(stream.readline(_LONGEST_LINE).split()) if width * height else 4
    stream.seek(start)
    if count not in _NAMES:
        raise InputError(f"{path}: line {line}: {count} values; a PTX point has x y z, intensity, and perhaps a color")
    if 2 * count * width * height > path.stat().st_size + 1:
        raise InputError(f"{path}: declares {width} x {height} points, more than its size allows; it is truncated")
    table = read_table(stream, np.dtype(np.float64), path=path, line=line, columns=count, rows=width * height)
    table = table.reshape(width * height, count)
    columns: Columns = dict(zip(_NAMES[count], table.T, strict=True))
    for name in COLORS:
        if name in columns and not ((columns[name] >= 0) & (columns[name] <= 255)).all():
            raise InputError(f"{path}: colors must be integers from 0 to 255; correct the scan of line {line}")
        if name in columns:
            columns[name] = columns[name].astype(np.uint8)
    index = np.arange(width * height, dtype=np.uint32)
    return columns | {"row": index % max(height, 1), "column": index // max(height, 1)}


FORMATS = (Format("ptx", (".ptx",), read, None, ("ascii",), stream=stream, stream_reads_all=True),)
