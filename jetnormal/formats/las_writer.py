"""Writing of LAS and LAZ files, at once or in pieces (`formats.las`)."""

from __future__ import annotations

import struct
from copy import deepcopy
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError
from jetnormal.formats.columns import (
    COORDINATES,
    NORMALS,
    Columns,
    columns_from_cloud,
)
from jetnormal.formats.las_dimensions import (
    TYPES,
    decimal_scale,
    declare,
    describe,
    finest_scale,
    sort_columns,
    to_integers,
)
from jetnormal.formats.las_extra import WITHOUT_WAVES, LasExtra, import_laspy
from jetnormal.formats.las_records import LONGEST_COMPRESSED, Record
from jetnormal.formats.registry import WRITE_ADVICE, library_errors
from jetnormal.formats.storage import COLORS, to_storable
from jetnormal.formats.streams import RowWriter, SameLayout, write_whole

_NORMALS = ("NormalX", "NormalY", "NormalZ")
_COMPRESSED_CHUNK = 50_000  # points
_EXTRA_BYTES = ("LASF_Spec", 4)
_WAVEFORMS = ("LASF_Spec", 65535)


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
    return write_whole(
        _Rows(cloud, offsets, [decimal_scale(values) for values in (points - offsets).T], stream, compress), cloud
    )


def write_rows(
    first: Cloud, points: int, box: NDArray[np.float64], stream: BinaryIO, encoding: str, *, compress: bool
) -> RowWriter:
    """Begin a LAS or LAZ file; a cloud of another format gets the finest decimal scale that `box` allows."""
    offsets = np.floor(box[0])
    return _Rows(first, offsets, [finest_scale(float(largest)) for largest in box[1] - offsets], stream, compress)


class _Rows:
    """Writes rows behind a header; offsets and scales are for clouds that do not come from LAS."""

    def __init__(
        self, first: Cloud, offsets: NDArray[np.float64], scales: list[float], stream: BinaryIO, compress: bool
    ) -> None:
        self._laspy = import_laspy("LAS output")
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
        standard, others, changed = sort_columns(columns, self._point_format(), is_new=self._extra is None)
        others, converted = to_storable(others, frozenset(TYPES), vectors=False)
        self._layout.check(others, renamed + changed + converted)
        if self._writer is None:
            self._begin(others, len(rows))
            self._warnings += renamed + changed + converted
            pairs = zip(others, self._added, strict=True)
            self._warnings += [f"attribute {name!r} is written as {new!r}" for name, new in pairs if name != new]
        table = self._laspy.ScaleAwarePointRecord.zeros(len(rows), header=self._header)
        self._set_coordinates(table, cloud.points[rows], cloud.source.point_dtype)
        if self._extra is None and "return_number" not in standard:
            standard |= dict.fromkeys(("return_number", "number_of_returns"), np.ones(len(rows), np.uint8))
        for name, values in [*standard.items(), *zip(self._added, others.values(), strict=True)]:
            table[name] = values
        with library_errors("LAS output", "laspy", WRITE_ADVICE):
            self._writer.write_points(table)

    def _point_format(self) -> Any:
        """The point format without the dimensions that were added: what is there is sorted anew for each piece."""
        if self._compress and self._writer is None and self._header.point_format.id in WITHOUT_WAVES:
            number = self._header.point_format.id
            self._warnings.append(f"point format {number} is not written; any wave packets are extra dimensions")
            _leave_waves_out(self._laspy, self._header)
        if self._writer is None:
            self._sorted_by = deepcopy(self._header.point_format)
        return self._sorted_by

    def _begin(self, others: Columns, rows: int) -> None:
        """Write the header; the first piece has that many rows."""
        self._added = declare(self._laspy, self._header, others)
        records, self._late = _records_to_write(self._extra, self._header)
        if self._extra and any((record.user, record.number) == _WAVEFORMS for record in self._extra.late_records):
            self._header.start_of_waveform_data_packet_record = 0
        self._header.vlrs.extend(_as_vlr(self._laspy, record) for record in records)
        if self._compress and self._header.point_format.size > LONGEST_COMPRESSED:
            raise InputError(
                f"points of {self._header.point_format.size} bytes are not compressed, only up to "
                f"{LONGEST_COMPRESSED}; write a .las file"
            )
        # The parallel compressor takes memory for whole chunks at once.
        parallel = rows > _COMPRESSED_CHUNK
        backend = self._laspy.LazBackend.LazrsParallel if parallel else self._laspy.LazBackend.Lazrs
        with library_errors("LAS output", "laspy", WRITE_ADVICE):
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
            table[name], exact = to_integers(points[:, axis], scale, offset, dtype)
            rounded = f"{name.lower()} is rounded to multiples of {scale:g}"
            if not exact and rounded not in self._rounded:
                self._rounded.append(rounded)

    def finish(self) -> list[str]:
        """Write what follows the points, and what the header says of all of them."""
        laspy, extra, writer = self._laspy, self._extra, self._writer
        with library_errors("LAS output", "laspy", WRITE_ADVICE):
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
    point_format = laspy.PointFormat(WITHOUT_WAVES[header.point_format.id])
    point_format.dimensions += list(header.point_format.extra_dimensions)
    header.set_version_and_point_format(header.version, point_format)
    header.vlrs.clear()  # with a description of the extra dimensions


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
        describe(dimension) for dimension in header.point_format.extra_dimensions if dimension.name not in known
    )
    if new:
        places = [index for index, record in enumerate(records) if (record.user, record.number) == _EXTRA_BYTES]
        if places:
            old = records[places[0]]
            records[places[0]] = old._replace(data=old.data + new)
        else:
            records.append(Record(*_EXTRA_BYTES, "Extra Bytes Record", new))
    return records, late
