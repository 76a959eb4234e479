"""LAS and LAZ, the ASPRS exchange formats of lidar data, and COPC (LAZ in the order of an octree), through laspy.

Format: https://www.asprs.org/divisions-committees/lidar-division/laser-las-file-format-exchange-activities

Coordinates are integers in a file, times a scale, plus an offset. Both are kept, so that the same integers are written
again. Every record of the header (VLR, EVLR), among them the coordinate system, is carried along as the bytes it is.
Normals are the extra dimensions ``NormalX NormalY NormalZ``, as in PDAL.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import (
    COORDINATES,
    NORMALS,
    Columns,
    canonical_names,
    cloud_from_columns,
)
from jetnormal.formats.las_extra import WITHOUT_WAVES, LasExtra, import_laspy
from jetnormal.formats.las_records import LASZIP, Record, check_chunks, check_size, laszip_record, read_records
from jetnormal.formats.las_writer import write, write_rows
from jetnormal.formats.registry import Format, library_errors
from jetnormal.formats.streams import CloudStream, memory_of

ENCODINGS = ("binary",)

_CHUNK = 1 << 20
_WAVES = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t")


def read(path: Path) -> Cloud:
    """Read a LAS, LAZ or COPC file: every point, dimension and record.

    Raises:
        InputError: the file is no LAS file, or is damaged.
        ResourceError: laspy or lazrs is missing.
    """
    with _opened(path) as (reader, source):
        chunks = list(_read_points(reader, _CHUNK, path))
    columns = {name: np.concatenate([chunk.pop(name) for chunk in chunks]) for name in list(chunks[0])}
    return cloud_from_columns(columns, source, path)


def stream(path: Path) -> CloudStream:
    """Open a LAS, LAZ or COPC file to be read in pieces.

    Raises:
        InputError, ResourceError: as `read`.
    """

    def pieces(rows: int) -> Iterator[Cloud]:
        with _opened(path) as (reader, source):
            for columns in _read_points(reader, rows, path):
                yield cloud_from_columns(columns, source, path)

    return CloudStream(_opened_count(path), memory_of(next(pieces(1))), pieces)


def _opened_count(path: Path) -> int:
    with _opened(path) as (reader, _):
        return int(reader.header.point_count)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Source]]:
    """laspy's reader of a file, and what the file says about itself."""
    with path.open("rb") as stream:
        if stream.read(4) != b"LASF":
            raise InputError(f"{path}: does not begin with 'LASF'; is this a LAS file?")
        laspy = import_laspy(path)
        with library_errors(path, "laspy"):
            records, late = read_records(stream, path)
            stream.seek(0)
            # The parallel decompressor trusts all sizes in a file, and ends the process where memory lacks for them.
            backend = laspy.LazBackend.Lazrs
            with laspy.open(stream, closefd=False, read_evlrs=False, laz_backend=backend) as reader:
                check_size(reader.header, path)
                if reader.header.are_points_compressed:
                    check_chunks(stream, reader.header, laszip_record(records, path), path)
                yield reader, _source(reader.header, records, late, path)


def _source(original: Any, records: tuple[Record, ...], late: tuple[Record, ...], path: Path) -> Source:
    header = deepcopy(original)
    header.vlrs.clear()
    header.evlrs = None
    names = canonical_names((*COORDINATES, *header.point_format.dimension_names), path)
    extra = LasExtra(
        header,
        tuple(record for record in records if (record.user, record.number) != LASZIP),
        late,
        {canonical: name for name, canonical in names.items() if canonical in NORMALS},
        copc=any(record.user == "copc" for record in records),
    )
    notes = ("the wave packets, which the LAZ library reads wrongly, are left out",) if _loses_waves(header) else ()
    return Source(format="las", encoding="binary", extra=extra, notes=notes)


def _loses_waves(header: Any) -> bool:
    return bool(header.are_points_compressed and header.point_format.id in WITHOUT_WAVES)


def _read_points(reader: Any, rows: int, path: Path) -> Iterator[Columns]:
    """The coordinates and every other dimension, in its order, so many rows at a time and at least once."""
    header = reader.header
    left_out = ("X", "Y", "Z", *(_WAVES if _loses_waves(header) else ()))
    names = [*COORDINATES, *(name for name in header.point_format.dimension_names if name not in left_out)]
    found = 0
    for record in reader.chunk_iterator(rows):
        found += len(record)
        yield {name: np.array(record[name]) for name in names}
    if found != header.point_count:
        raise InputError(f"{path}: declares {header.point_count} points but holds {found}; it is truncated")
    if not found:
        empty = reader.read_points(0)
        yield {name: np.array(empty[name]) for name in names}


def _format(suffix: str, *, compress: bool) -> Format:
    writers: Any = [partial(function, compress=compress) for function in (write, write_rows)]
    return Format("las", (suffix,), read, writers[0], ENCODINGS, stream=stream, write_rows=writers[1])


FORMATS = (_format(".las", compress=False), _format(".laz", compress=True))
