"""What a LAS file declares, as bytes, and whether the file can hold it.

laspy interprets some records and writes them differently, and a decompressor allocates what a damaged file asks for. So
the records are read here, and the sizes of points and of compressed chunks are compared with the file first.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from jetnormal.errors import InputError
from jetnormal.support.extras import require

LASZIP = ("laszip encoded", 22204)
LONGEST_COMPRESSED = 8192
"""Bytes of a point: a compressor has several kB of statistics for each of them."""
_LASZIP_HEAD = struct.Struct("<H30xH")
"""The compressor and the number of items in the record; the items follow, each with its kind, size and version."""
_LAYERED = 3
_ITEMS = {10: (30, 9), 11: (6, 1), 12: (8, 2), 13: (29, 1)}
"""Size and number of layers of the items by kind: the point itself, colors, colors with infrared, a wave packet."""
_EXTRA_BYTES_ITEM = 14  # a layer for each byte


class Record(NamedTuple):
    """A variable length record (VLR, EVLR)."""

    user: str
    number: int
    description: str
    data: bytes


def read_records(stream: BinaryIO, path: Path) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    """Return the records as bytes: laspy interprets some of them, and writes these differently."""
    stream.seek(0)
    head = stream.read(375)
    size, points, count = struct.unpack_from("<HII", head, 94)
    if points > path.stat().st_size:
        raise InputError(f"{path}: its points begin behind its end; the file is truncated")
    stream.seek(size)
    records = tuple(_read_record(stream, "<H16sHH32s", path) for _ in range(count))
    late: tuple[Record, ...] = ()
    if head[25] >= 4:  # the minor version
        start, count = struct.unpack_from("<QI", head, 235)
        stream.seek(start)
        late = tuple(_read_record(stream, "<H16sHQ32s", path) for _ in range(count))
    return records, late


def _read_record(stream: BinaryIO, layout: str, path: Path) -> Record:
    _, user, number, length, description = struct.unpack(layout, stream.read(struct.calcsize(layout)))
    data = stream.read(min(length, path.stat().st_size))
    if len(data) != length:
        raise InputError(f"{path}: a record of the header is cut off; the file is truncated")
    texts = (text.split(b"\0")[0].decode("utf-8", "surrogateescape") for text in (user, description))
    return Record(next(texts), number, next(texts), data)


def check_size(header: Any, path: Path) -> None:
    """Refuse a number of points that the file cannot hold; compressed points are counted as they are unpacked."""
    size = path.stat().st_size - header.offset_to_point_data
    if not header.are_points_compressed and header.point_count * header.point_format.size > size:
        raise InputError(f"{path}: declares {header.point_count} points, more than its size allows; it is truncated")


def laszip_record(records: tuple[Record, ...], path: Path) -> bytes:
    """Find the record that says how points are compressed.

    Raises:
        InputError: there is none.
    """
    for record in records:
        if (record.user, record.number) == LASZIP and len(record.data) >= _LASZIP_HEAD.size:
            return record.data
    raise InputError(f"{path}: its points are compressed, but no record tells how; it is damaged")


def check_chunks(stream: BinaryIO, header: Any, laszip: bytes, path: Path) -> None:
    """Refuse compressed chunks, or parts of them, larger than the file: the decompressor would allocate them."""
    if header.point_format.size > LONGEST_COMPRESSED:
        raise InputError(f"{path}: declares points of {header.point_format.size} bytes, too long to be compressed")
    position, size, start = stream.tell(), path.stat().st_size, header.offset_to_point_data
    stream.seek(start)
    (table,) = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))
    if table == -1:  # written by what could not go back: the place stands at the end
        stream.seek(size - 8)
        (table,) = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))
    if not start < table <= size - 8:
        raise InputError(f"{path}: its table of compressed chunks is not there; the file is truncated")
    stream.seek(table)
    _, chunks = struct.unpack("<II", stream.read(8))
    if chunks > size:
        raise InputError(f"{path}: declares {chunks} compressed chunks, more than its size allows; it is damaged")
    stream.seek(table)
    lazrs = require("lazrs", str(path))
    record = lazrs.LazVlr(laszip)
    found, first = 0, start + 8
    for count, length in lazrs.read_chunk_table_only(stream, record):
        if found >= header.point_count:
            break  # an empty file has an empty chunk
        stream.seek(first)
        if first + length > table or not _layers_fit(stream, laszip, length):
            raise InputError(
                f"{path}: a compressed chunk is shorter than its layers or ends behind the table; it is damaged"
            )
        found += count if record.uses_variable_size_chunks() else record.chunk_size()
        first += length
    if found < header.point_count:
        raise InputError(f"{path}: declares {header.point_count} points, more than its chunks hold; it is truncated")
    stream.seek(position)


def _layers_fit(stream: BinaryIO, laszip: bytes, length: int) -> bool:
    """Whether a chunk is as long as its layers are.

    The chunks of point formats 6 and up begin with the first point as it is and the number of points; then come the
    lengths of the layers, one or several for each item of the points (LASzip, "layered chunked" compression).
    """
    compressor, items = _LASZIP_HEAD.unpack_from(laszip)
    if compressor != _LAYERED:
        return True
    sizes = []
    for item in range(items):
        kind, size = struct.unpack_from("<HH", laszip, _LASZIP_HEAD.size + 6 * item)
        sizes.append((size, size) if kind == _EXTRA_BYTES_ITEM else _ITEMS[kind])
        if sizes[-1][0] != size:
            return False
    head, layers = sum(size for size, _ in sizes) + 4, sum(count for _, count in sizes)
    stream.seek(head, 1)
    lengths = stream.read(4 * layers)
    return len(lengths) == 4 * layers and head + len(lengths) + sum(struct.unpack(f"<{layers}I", lengths)) <= length
