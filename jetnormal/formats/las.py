"""LAS and LAZ, the ASPRS exchange formats of lidar data, and COPC (LAZ in the order of an octree), through laspy.

Format: https://www.asprs.org/divisions-committees/lidar-division/laser-las-file-format-exchange-activities

Coordinates are integers in a file, times a scale, plus an offset. Both are kept, so that the same integers are written
again. Every record of the header (VLR, EVLR), among them the coordinate system, is carried along as the bytes it is.
Normals are the extra dimensions ``NormalX NormalY NormalZ``, as in PDAL.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import (
    COORDINATES,
    NORMALS,
    Columns,
    canonical_names,
    cloud_from_columns,
    columns_from_cloud,
)
from jetnormal.formats.las_records import LASZIP, Record, check_chunks, check_size, laszip_record, read_records
from jetnormal.formats.registry import Format, library, library_errors
from jetnormal.formats.storage import COLORS, to_storable
from jetnormal.formats.streams import CloudStream, RowWriter, SameLayout, memory_of

ENCODINGS = ("binary",)

_NORMALS = ("NormalX", "NormalY", "NormalZ")
_CHUNK = 1 << 20
_COMPRESSED_CHUNK = 50_000  # points
_TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "u8": 7, "i8": 8, "f4": 9, "f8": 10}
"""The codes of the types of extra dimensions."""
_EXTRA_BYTES = ("LASF_Spec", 4)
_WAVEFORMS = ("LASF_Spec", 65535)
_WITHOUT_WAVES = {9: 6, 10: 8}
"""The point formats whose wave packets lazrs reads and writes wrongly (0.8.2), and the same ones without packets."""
_WAVES = ("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t")
_LONGEST_NAME = 32
_LARGEST = 2**31 - 1
_FINEST_SCALE = 12  # decimals


@dataclass(frozen=True)
class LasExtra:
    """What a LAS file held besides its points' numbers.

    Attributes:
        header: laspy's header, without the records.
        records: of the header (VLRs).
        late_records: behind the points (EVLRs).
        spelling: the file's own names of the normals, by ``nx ny nz``.
        copc: whether the points were in the order of an octree.
    """

    header: Any
    records: tuple[Record, ...]
    late_records: tuple[Record, ...]
    spelling: dict[str, str]
    copc: bool

    def losses(self) -> list[str]:
        """Name what other formats cannot hold."""
        count = len(self.records) + len(self.late_records)
        kept = f"the LAS header and its {count} records, which tell the coordinate system," if count else "the header"
        return [f"{kept} is not kept"]


def read(path: Path) -> Cloud:
    """Read a LAS, LAZ or COPC file: every point, dimension and record.

    Raises:
        InputError: the file is no LAS file, is damaged, or laspy is missing.
    """
    with _opened(path) as (reader, source):
        chunks = list(_read_points(reader, _CHUNK, path))
    columns = {name: np.concatenate([chunk.pop(name) for chunk in chunks]) for name in list(chunks[0])}
    return cloud_from_columns(columns, source, path)


def stream(path: Path) -> CloudStream:
    """Open a LAS, LAZ or COPC file to be read in pieces.

    Raises:
        InputError: as `read`.
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
        laspy = _laspy(path)
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
    return bool(header.are_points_compressed and header.point_format.id in _WITHOUT_WAVES)


def _laspy(path: Path | str) -> Any:
    library("lazrs", "las", path)
    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs what it then raises
    return library("laspy", "las", path)


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


def write(cloud: Cloud, stream: BinaryIO, encoding: str, *, compress: bool) -> list[str]:
    """Write a LAS or LAZ file.

    A cloud from such a file keeps its version, point format, scales, offsets, and records. Any other gets version 1.4
    and the finest decimal scale that its extent allows, or a coarser one that holds its coordinates exactly.
    Attributes that are no dimensions of the point format become extra dimensions.

    Returns:
        What could not be kept.
    """
    points = cloud.points[cloud.valid]
    offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    writer = _Rows(cloud, offsets, [_decimal_scale(values) for values in (points - offsets).T], stream, compress)
    writer.write(cloud)
    return writer.finish()


def write_rows(
    first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str, *, compress: bool
) -> RowWriter:
    """Begin a LAS or LAZ file; a cloud of another format gets the finest decimal scale that `box` allows."""
    offsets = np.floor(box[0])
    return _Rows(first, offsets, [_finest_scale(float(largest)) for largest in box[1] - offsets], stream, compress)


class _Rows:
    """Writes rows behind a header; offsets and scales are for clouds that do not come from LAS."""

    def __init__(
        self, first: Cloud, offsets: NDArray[np.float64], scales: list[float], stream: BinaryIO, compress: bool
    ) -> None:
        self._laspy = _laspy("LAS output")
        self._extra = first.source.extra if isinstance(first.source.extra, LasExtra) else None
        self._stream, self._compress = stream, compress
        self._header: Any = deepcopy(self._extra.header) if self._extra else None
        self._new = offsets, scales
        self._layout = SameLayout()
        self._added: list[str] = []
        self._late: list[Record] = []
        self._sorted_by: Any = None
        self._writer: Any = None
        self._left_out = 0
        self._rounded: list[str] = []
        self._warnings: list[str] = []

    def write(self, cloud: Cloud) -> None:
        """Append the points that have finite coordinates."""
        rows = np.flatnonzero(cloud.valid)
        self._left_out += len(cloud) - len(rows)
        spelling = self._extra.spelling if self._extra else {}
        normal_names = tuple(spelling.get(name, new) for name, new in zip(NORMALS, _NORMALS, strict=True))
        columns, renamed = columns_from_cloud(cloud, normal_names, np.dtype(np.float32))
        columns = {name: values[rows] for name, values in columns.items() if name not in COORDINATES}
        if self._header is None:
            self._header = _new_header(self._laspy, *self._new, columns)
        standard, others, changed = _sort_columns(columns, self._point_format(), is_new=self._extra is None)
        others, converted = to_storable(others, frozenset(_TYPES), vectors=False)
        self._layout.check(others, renamed + changed + converted)
        if self._writer is None:
            self._begin(others, len(rows))
            self._warnings += renamed + changed + converted
        table = self._laspy.ScaleAwarePointRecord.zeros(len(rows), header=self._header)
        self._set_coordinates(table, cloud.points[rows], cloud.source.point_dtype)
        if self._extra is None and "return_number" not in standard:
            standard |= dict.fromkeys(("return_number", "number_of_returns"), np.ones(len(rows), np.uint8))
        for name, values in [*standard.items(), *zip(self._added, others.values(), strict=True)]:
            table[name] = values
        with library_errors("LAS output", "laspy"):
            self._writer.write_points(table)

    def _point_format(self) -> Any:
        """The point format without the dimensions that were added: what is there is sorted anew for each piece."""
        if self._compress and self._writer is None and self._header.point_format.id in _WITHOUT_WAVES:
            number = self._header.point_format.id
            self._warnings.append(f"point format {number} is not written; any wave packets are extra dimensions")
            _leave_waves_out(self._laspy, self._header)
        if self._writer is None:
            self._sorted_by = deepcopy(self._header.point_format)
        return self._sorted_by

    def _begin(self, others: Columns, rows: int) -> None:
        """Write the header; the first piece has that many rows."""
        self._added = _declare(self._laspy, self._header, others)
        records, self._late = _records_to_write(self._extra, self._header)
        if self._extra and any((record.user, record.number) == _WAVEFORMS for record in self._extra.late_records):
            self._header.start_of_waveform_data_packet_record = 0
        self._header.vlrs.extend(_as_vlr(self._laspy, record) for record in records)
        # The parallel compressor takes memory for whole chunks at once.
        parallel = rows > _COMPRESSED_CHUNK
        backend = self._laspy.LazBackend.LazrsParallel if parallel else self._laspy.LazBackend.Lazrs
        with library_errors("LAS output", "laspy"):
            self._writer = self._laspy.LasWriter(
                self._stream,
                self._header,
                do_compress=self._compress,
                laz_backend=backend,
                closefd=False,
                encoding_errors="ignore",
            )

    def _set_coordinates(self, table: Any, points: NDArray[np.float64], dtype: np.dtype[Any]) -> None:
        for axis, name in enumerate("XYZ"):
            scale, offset = self._header.scales[axis], self._header.offsets[axis]
            table[name], exact = _to_integers(points[:, axis], scale, offset, dtype)
            rounded = f"{name.lower()} is rounded to multiples of {scale:g}"
            if not exact and rounded not in self._rounded:
                self._rounded.append(rounded)

    def finish(self) -> list[str]:
        """Write what follows the points, and what the header says of all of them."""
        laspy, extra, writer = self._laspy, self._extra, self._writer
        with library_errors("LAS output", "laspy"):
            if self._late:
                writer.write_evlrs(laspy.vlrs.vlrlist.VLRList([_as_vlr(laspy, record) for record in self._late]))
            if extra:
                given, found = ([header.mins, header.maxs] for header in (extra.header, writer.header))
                if np.allclose(given, found, rtol=0, atol=extra.header.scales / 2):
                    writer.header.mins, writer.header.maxs = given  # as exact as they were
            writer.close()
            _write_legacy_counts(self._stream, writer.header)
        warnings = []
        if self._left_out:
            warnings.append(f"{self._left_out} points without finite coordinates cannot be held and are left out")
        warnings += self._rounded
        if extra and extra.copc:
            warnings.append(
                "is written as plain LAZ, not as COPC: the points keep their order, their octree is not kept"
            )
        if extra and any((record.user, record.number) == _WAVEFORMS for record in extra.late_records):
            warnings.append("the waveforms are not kept")
        return warnings + self._warnings


def _new_header(laspy: Any, offsets: NDArray[np.float64], scales: list[float], columns: Columns) -> Any:
    is_colored = all(name in columns for name in COLORS)
    header = laspy.LasHeader(version="1.4", point_format=7 if is_colored else 6)
    header.global_encoding.wkt = True  # the standard wants it for these point formats
    header.creation_date = None  # the same cloud gives the same bytes on any day
    header.generating_software = "jetnormal"
    header.offsets, header.scales = offsets, np.array(scales)
    return header


def _leave_waves_out(laspy: Any, header: Any) -> None:
    point_format = laspy.PointFormat(_WITHOUT_WAVES[header.point_format.id])
    point_format.dimensions += list(header.point_format.extra_dimensions)
    header.set_version_and_point_format(header.version, point_format)
    header.vlrs.clear()  # with a description of the extra dimensions


def _decimal_scale(values: NDArray[np.float64]) -> float:
    """The coarsest power of ten of which all are multiples; else the finest that 31 bits allow."""
    finest = _finest_scale(float(np.abs(values).max(initial=0)))
    scale = max(1.0, finest)
    while scale > finest:
        scaled = values / scale
        if np.abs(scaled - np.rint(scaled)).max(initial=0) < 1e-4:
            break
        scale = _power_of_ten(round(np.log10(scale)) - 1)
    return scale


def _finest_scale(largest: float) -> float:
    """The finest power of ten of which `largest` is a multiple that fits 31 bits."""
    exponent = -_FINEST_SCALE
    while largest / _power_of_ten(exponent) > _LARGEST:
        exponent += 1
    return _power_of_ten(exponent)


def _power_of_ten(exponent: int) -> float:
    return float(f"1e{exponent}")


def _to_integers(
    values: NDArray[np.float64], scale: float, offset: float, dtype: np.dtype[Any]
) -> tuple[NDArray[np.int32], bool]:
    """Coordinates as a file's integers, and whether these give the same ones as exactly as their type holds them."""
    scaled = np.rint((values - offset) / scale)
    if np.abs(scaled).max(initial=0) > _LARGEST:
        raise InputError(
            f"coordinates from {values.min():g} to {values.max():g} do not fit the LAS scale {scale:g} and offset "
            f"{offset:g} of the input; write another format"
        )
    largest = np.abs(values).max(initial=0)
    rounding = 4 * np.spacing(largest + abs(offset))
    if dtype == np.float32:
        rounding = max(rounding, float(np.spacing(np.float32(largest))) / 2)
    exact = bool(np.abs(scaled * scale + offset - values).max(initial=0) <= rounding)
    return scaled.astype(np.int32), exact


def _sort_columns(columns: Columns, point_format: Any, *, is_new: bool) -> tuple[Columns, Columns, list[str]]:
    """What the point format has a dimension for, what it has not, and what had to be changed to fit.

    Colors and intensities of other formats are spread over the 16 bits that LAS has for them.
    """
    there: Columns = {}
    others: Columns = {}
    warnings = []
    for name, given in columns.items():
        if name not in point_format.dimension_names:
            others[name] = given
            continue
        dimension, values = point_format.dimension_by_name(name), given
        if is_new and name in (*COLORS, "intensity"):
            values = _to_16_bits(values, is_color=name in COLORS)
        if not (_fits(values, dimension) if dimension.is_standard else _fits_extra(values, dimension)):
            others[name] = given
            continue
        if values.dtype.kind != given.dtype.kind:
            warnings.append(f"attribute {name!r} is scaled to 16 bits")
        is_integer = dimension.kind.name != "FloatingPoint" and not dimension.is_scaled
        there[name] = values.astype(np.int64) if is_integer and values.dtype.kind == "f" else values
    return there, others, warnings


def _to_16_bits(values: NDArray[Any], *, is_color: bool) -> NDArray[Any]:
    if is_color and values.dtype == np.uint8:
        return values * np.uint16(257)
    if values.dtype.kind == "f" and values.size and values.min() >= 0 and values.max() <= 1:
        return np.rint(values * 65535).astype(np.uint16)
    return values


def _fits(values: NDArray[Any], dimension: Any) -> bool:
    if values.ndim != 1 or values.dtype.kind not in "uif":
        return False
    if dimension.kind.name == "FloatingPoint" or not values.size:
        return True
    low, high = dimension.min, dimension.max
    return bool((values >= low).all() and (values <= high).all() and (values == np.rint(values)).all())


def _fits_extra(values: NDArray[Any], dimension: Any) -> bool:
    """Whether values can be stored in an extra dimension of the input; others may have taken its name since."""
    shape = () if dimension.num_elements == 1 else (dimension.num_elements,)
    if values.shape[1:] != shape or values.dtype.kind not in "uif":
        return False
    if not dimension.is_scaled:
        return bool(np.can_cast(values.dtype, dimension.dtype.base, "same_kind"))
    limits = np.iinfo(dimension.dtype.base) if dimension.dtype.base.kind in "iu" else np.finfo(dimension.dtype.base)
    raw = (values - dimension.offsets) / dimension.scales
    return bool(((raw >= limits.min) & (raw <= limits.max)).all())


def _declare(laspy: Any, header: Any, columns: Columns) -> list[str]:
    """Add extra dimensions of these names and types to a header; returns the names that they got there."""
    names: list[str] = []
    for name in columns:
        short = name.encode()[:_LONGEST_NAME].decode(errors="ignore")
        number = 2
        while short in names or short in header.point_format.dimension_names:
            ending = f"_{number}"
            short = name.encode()[: _LONGEST_NAME - len(ending)].decode(errors="ignore") + ending
            number += 1
        names.append(short)
        header.point_format.add_extra_dimension(laspy.ExtraBytesParams(short, columns[name].dtype))
    return names


def _write_legacy_counts(stream: BinaryIO, header: Any) -> None:
    """Repeat the numbers of points where readers of version 1.3 look: laspy leaves them 0 in version 1.4."""
    if header.version.minor >= 4 and header.point_format.id < 6 and header.point_count <= 0xFFFFFFFF:
        stream.seek(107)
        stream.write(struct.pack("<6I", header.point_count, *header.number_of_points_by_return[:5]))
        stream.seek(0, 2)


def _as_vlr(laspy: Any, record: Record) -> Any:
    return laspy.VLR(record.user, record.number, record.description, record.data)


def _records_to_write(extra: LasExtra | None, header: Any) -> tuple[list[Record], list[Record]]:
    """The records of the input, with the extra dimensions that were added described behind its own."""
    records = [record for record in extra.records if record.user != "copc"] if extra else []
    late = [r for r in extra.late_records if r.user != "copc" and (r.user, r.number) != _WAVEFORMS] if extra else []
    known = {dimension.name for dimension in extra.header.point_format.extra_dimensions} if extra else set()
    new = b"".join(
        _describe(dimension) for dimension in header.point_format.extra_dimensions if dimension.name not in known
    )
    if new:
        places = [index for index, record in enumerate(records) if (record.user, record.number) == _EXTRA_BYTES]
        if places:
            old = records[places[0]]
            records[places[0]] = old._replace(data=old.data + new)
        else:
            records.append(Record(*_EXTRA_BYTES, "Extra Bytes Record", new))
    return records, late


def _describe(dimension: Any) -> bytes:
    """The 192 bytes that tell a reader the name and the type of an extra dimension."""
    code = _TYPES[dimension.dtype.str[1:]]
    return struct.pack("<2xBB32s124x32s", code, 0, dimension.name.encode(), b"")


def _format(suffix: str, *, compress: bool) -> Format:
    writers: Any = [partial(function, compress=compress) for function in (write, write_rows)]
    return Format("las", (suffix,), read, writers[0], ENCODINGS, stream=stream, write_rows=writers[1])


FORMATS = (_format(".las", compress=False), _format(".laz", compress=True))
