"""Clouds that are read and written piece by piece: what a format needs for files larger than memory.

A format can offer both (`registry.Format`):

    def stream(path: Path) -> CloudStream: ...
    def write_rows(first: Cloud, points: int, box: Floats, stream: BinaryIO, encoding: str) -> RowWriter: ...

The pieces of a file are clouds as `read` would give them, with the same types and the same `Source`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import Columns, cloud_from_columns

ROWS = 500_000  # of a piece


@dataclass(frozen=True)
class CloudStream:
    """A file that can be read in pieces, any number of times.

    Attributes:
        points: rows of the file.
        bytes_per_point: of a row in memory, with all attributes.
        pieces: yields the rows in their order, at most so many in each cloud. A file without points has one piece.
    """

    points: int
    bytes_per_point: int
    pieces: Callable[[int], Iterator[Cloud]]


class RowWriter(Protocol):
    """Writes a cloud row by row behind a header that is written already."""

    def write(self, rows: Cloud) -> None:
        """Append rows that have the attributes, types and source of the first ones.

        Raises:
            InputError: they do not.
        """
        ...

    def finish(self) -> list[str]:
        """Write what follows the rows; return what could not be kept."""
        ...


def write_whole(writer: RowWriter, cloud: Cloud) -> list[str]:
    """Write a cloud as a single piece; return what could not be kept."""
    writer.write(cloud)
    return writer.finish()


class SameLayout:
    """Sees to it that the columns of all pieces have the names and types of those of the first.

    Some types depend on values: integers that fit 32 bits, numbers that are scaled to 16 bits. A whole cloud shows all
    of its values, a piece does not.
    """

    def __init__(self) -> None:
        self._known: list[tuple[str, str, tuple[int, ...]]] | None = None
        self._warnings: list[str] = []

    def check(self, columns: Columns, warnings: list[str]) -> None:
        """Compare the columns of a piece, and what was said about them, with those of the pieces before.

        Raises:
            InputError: something differs.
        """
        layout = [(name, values.dtype.str, values.shape[1:]) for name, values in columns.items()]
        if self._known is None:
            self._known, self._warnings = layout, warnings
        changed = [name for name, *_ in set(self._known) ^ set(layout)]
        if changed or warnings != self._warnings:
            what = f"the type of {changed[0]!r}" if changed else "how an attribute is written"
            raise InputError(
                f"{what} depends on its values, which a file written in pieces cannot wait for; write .ply"
            )


def mapped(path: Path, dtype: np.dtype[Any], offset: int, count: int) -> NDArray[Any]:
    """Map records (count,) of a file into memory, to be read as they are needed."""
    return np.memmap(path, dtype, "r", offset, count) if count else np.empty(0, dtype)


def from_table(table: NDArray[Any], source: Source, path: Path, left_out: frozenset[str] = frozenset()) -> CloudStream:
    """Make a stream of records (N,) that are mapped from a file.

    Args:
        table: structured, one record for each point.
        source: what the file says about itself.
        path: the file, for messages.
        left_out: fields that are no attributes.
    """

    def chunks(rows: int) -> Iterator[NDArray[Any]]:
        return (np.array(table[start : start + rows]) for start in range(0, max(1, len(table)), rows))

    return from_chunks(len(table), chunks, source, path, left_out)


def from_chunks(
    points: int,
    chunks: Callable[[int], Iterator[NDArray[Any]]],
    source: Source,
    path: Path,
    left_out: frozenset[str] = frozenset(),
) -> CloudStream:
    """Make a stream of records that come in chunks (n,) of at most so many; one is there without points.

    Args:
        points: records in all.
        chunks: yields them in their order.
        source, path, left_out: as for `from_table`.
    """

    def pieces(rows: int) -> Iterator[Cloud]:
        for chunk in chunks(rows):
            columns = {name: chunk[name] for name in chunk.dtype.names or () if name not in left_out}
            yield cloud_from_columns(columns, source, path)

    return CloudStream(points, memory_of(next(pieces(1))), pieces)


def memory_of(cloud: Cloud) -> int:
    """Return the bytes that a row of a cloud takes in memory."""
    arrays = [cloud.points, cloud.normals, cloud.source.sensors, *cloud.attributes.values()]
    return sum(int(a.itemsize * np.prod(a.shape[1:])) for a in arrays if a is not None)
