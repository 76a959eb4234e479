"""Point-cloud files: reading, and writing without losing anything. `registry` tells how to add a format."""

from __future__ import annotations

import itertools
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import AT_ORIGIN, Cloud, Source
from jetnormal.errors import InputError, ResourceError, UsageError, unreadable
from jetnormal.formats import atomic
from jetnormal.formats.registry import Format, all_formats, find_format, suffixes
from jetnormal.formats.streams import CloudStream, RowWriter
from jetnormal.support.streams import STREAM

__all__ = [
    "CloudStream",
    "Format",
    "all_formats",
    "check_pieces",
    "check_target",
    "find_format",
    "format_for",
    "open_stream",
    "read",
    "suffixes",
    "write",
    "write_pieces",
]


def format_for(path: Path, name: str | None) -> str | None:
    """Tell which format a file has by its name: none, if its suffix tells it, else `name`."""
    return None if any(path.suffix.lower() in known.suffixes for known in all_formats()) else name


def read(
    path: str | PathLike[str], *, format: str | None = None, columns: str | None = None, decimal: str | None = None
) -> Cloud:
    """Read a point cloud.

    Rows whose coordinates are not finite are kept (`Cloud.valid` tells them), but where a format marks the points that
    its scanner did not measure: these are left out, and `Source.notes` tells how many.

    Args:
        path: the file, or "-" for standard input.
        format: its format, such as "ply" or "kitti"; by default the suffix, in either case, tells it.
        columns: what the columns of a text file are, in their order: "id,x,y,z,intensity,-" ("-" leaves one out); or
            which of its names are meant: "x=Rechtswert,y=Hochwert,z=Hoehe".
        decimal: "point" or "comma", the decimal sign of a text file; by default a comma only between semicolons.

    Raises:
        InputError: the file is missing, damaged, of an unknown suffix, or holds no coordinates.
        UsageError: `columns` or `decimal` do not fit the file.
        ResourceError: it does not fit into memory, or the library that reads it is missing.
    """
    path = Path(path)
    known = find_format(path, format)
    options = _layout_options(known, columns, decimal, path)
    try:
        with _as_file(path) as file:
            return known.read(file, **options)
    except OSError as error:
        raise unreadable(path, error) from error
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; split the file or use a larger machine") from error


def _layout_options(known: Format, columns: str | None, decimal: str | None, path: Path) -> dict[str, str | None]:
    """The arguments of `Format.read` and `Format.stream` beside the path."""
    if known.has_columns:
        return {"columns": columns, "decimal": decimal}
    if columns is not None or decimal is not None:
        raise UsageError(f"{path}: `columns` and `decimal` are for text files, not for {known.name}")
    return {}


@contextmanager
def _as_file(path: Path) -> Iterator[Path]:
    """The file itself, or one that holds what came through standard input."""
    if str(path) != STREAM:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="jetnormal-") as folder:
        copy = Path(folder) / "stdin"
        with copy.open("wb") as stream:
            shutil.copyfileobj(sys.stdin.buffer, stream)
        try:
            yield copy
        except (InputError, ResourceError) as error:
            raise type(error)(str(error).replace(str(copy), "standard input")) from error


def open_stream(
    path: str | PathLike[str], *, format: str | None = None, columns: str | None = None, decimal: str | None = None
) -> CloudStream:
    """Open a point cloud to be read in pieces, whatever its size.

    Args: as for `read`; a stream such as standard input cannot be read twice, and is refused.

    Raises:
        InputError: as `read`, or the file cannot be read in pieces.
        UsageError: `columns` or `decimal` do not fit the file.
    """
    path = Path(path)
    known = find_format(path, format)
    if known.stream is None or str(path) == STREAM:
        able = " ".join(sorted(s for each in all_formats() if each.stream for s in each.suffixes))
        what = "a stream" if str(path) == STREAM else f"a {known.name} file"
        raise InputError(f"{path}: {what} is not read in pieces; {able} are")
    options = _layout_options(known, columns, decimal, path)
    try:
        return known.stream(path, **options)
    except OSError as error:
        raise unreadable(path, error) from error


def write_pieces(
    pieces: Iterator[Cloud],
    points: int,
    box: NDArray[np.float64],
    path: str | PathLike[str],
    *,
    format: str | None = None,
    encoding: str | None = None,
    overwrite: bool = False,
) -> list[str]:
    """Write a point cloud that comes in pieces; the file appears complete or not at all.

    Args:
        pieces: parts of the cloud with the same attributes and types, at least one.
        points: rows in all.
        box: (2, 3) least and largest finite coordinates.
        path, format, encoding, overwrite: as for `write`.

    Returns:
        Warnings: what the format cannot hold.

    Raises:
        InputError: the file cannot be written, or not in pieces.
        UsageError: the format has no such encoding.
    """
    path = Path(path)
    known, first = _writable(path, format)[0], next(pieces)
    write_rows = check_pieces(path, format=format)
    try:
        with atomic.atomic_write(path, overwrite=overwrite) as stream:
            writer = write_rows(first, points, box, stream, _choose_encoding(first.source, known, encoding, path))
            for piece in itertools.chain([first], pieces):
                writer.write(piece)
            warnings = writer.finish()
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from error
    return [f"{path}: {warning}" for warning in _losses(first, known) + warnings]


def check_pieces(path: Path, *, format: str | None = None) -> Callable[..., RowWriter]:
    """Find what writes a file in pieces.

    Raises:
        InputError: its format cannot be written so.
    """
    known = _writable(path, format)[0]
    if known.write_rows is None or str(path) == STREAM:
        able = " ".join(sorted(s for each in all_formats() if each.write_rows for s in each.suffixes))
        what = "a stream" if str(path) == STREAM else f"a {known.name} file"
        raise InputError(f"{path}: {what} is not written in pieces; {able} are")
    return known.write_rows


def write(
    cloud: Cloud,
    path: str | PathLike[str],
    *,
    format: str | None = None,
    encoding: str | None = None,
    overwrite: bool = False,
) -> list[str]:
    """Write a point cloud with all it holds; the file appears complete or not at all.

    The coordinates are written in the type they were read in, bit for bit; normals take the place they had in
    the file, or follow the coordinates.

    Args:
        cloud: the cloud.
        path: the target, or "-" for standard output.
        format: its format; by default the suffix of `path` tells it.
        encoding: one of the format's encodings, or ``"binary"`` for its plain binary one. By default the
            encoding that the cloud was read in, as far as the format has it.
        overwrite: whether an existing file may be replaced.

    Returns:
        Warnings: what the format cannot hold.

    Raises:
        InputError: the file cannot be written.
        UsageError: the format has no such encoding.
    """
    path = Path(path)
    known, write_cloud = _writable(path, format)
    chosen = _choose_encoding(cloud.source, known, encoding, path)
    if str(path) == STREAM:
        with tempfile.TemporaryFile(prefix="jetnormal-") as stream:  # most formats go back and forth in their file
            warnings = write_cloud(cloud, stream, chosen)
            stream.seek(0)
            shutil.copyfileobj(stream, sys.stdout.buffer)
            sys.stdout.buffer.flush()
    else:
        try:
            with atomic.atomic_write(path, overwrite=overwrite) as stream:
                warnings = write_cloud(cloud, stream, chosen)
        except InputError as error:  # a format does not know the name of its stream
            raise error if str(path) in str(error) else InputError(f"{path}: {error}") from error
    return [f"{path}: {warning}" for warning in _losses(cloud, known) + warnings]


def check_target(
    path: str | PathLike[str], *, format: str | None = None, encoding: str | None = None, overwrite: bool = False
) -> None:
    """Find out before a long computation whether `write` would refuse this path or encoding.

    Raises:
        InputError: the suffix is unknown or cannot hold normals, the file exists and may not be overwritten, or its
            folder is missing or not writable.
        UsageError: the format has no such encoding.
    """
    path = Path(path)
    _choose_encoding(Source(), _writable(path, format)[0], encoding, path)
    if str(path) != STREAM:
        atomic.check_target(path, overwrite)


def _writable(path: Path, format: str | None) -> tuple[Format, Any]:
    known = find_format(path, format)
    if known.write is None:
        raise InputError(f"{path}: the format {known.name} cannot hold normals; write .ply, .laz or .e57 instead")
    return known, known.write


def _choose_encoding(source: Source, known: Format, wanted: str | None, path: Path) -> str:
    if wanted is None:
        if source.format == known.name and source.encoding in known.encodings:
            return source.encoding
        # A text table says nothing about the encoding that a PLY or PCD file should have.
        keeps_text = source.format != "xyz" and source.encoding in known.encodings
        return source.encoding if keeps_text else known.encodings[0]
    if wanted in known.encodings:
        return wanted
    if wanted == "binary" and len(known.encodings) > 1:
        return known.encodings[0]
    raise UsageError(f"{path}: no encoding {wanted!r} for this suffix; choose from {', '.join(known.encodings)}")


def _losses(cloud: Cloud, target: Format) -> list[str]:
    """What belongs to the whole cloud and has no place in another format."""
    source = cloud.source
    if source.format == target.name:
        return []
    losses = list(source.extra.losses()) if hasattr(source.extra, "losses") else []
    if source.height is not None and source.height > 1:
        losses.append(f"the organization in {source.height} rows of {source.width} points is not kept")
    if source.viewpoint not in (None, AT_ORIGIN) and not target.keeps_viewpoint:
        losses.append("the viewpoint is not kept")
    return losses
