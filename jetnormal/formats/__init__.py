"""Point-cloud files: which suffix means which format, reading, and writing without losing anything."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError, ResourceError, UsageError
from jetnormal.formats import atomic, pcd, ply, ply_header, text


class Codec(NamedTuple):
    """How one suffix is read and written."""

    format: str
    read: Callable[[Path], Cloud]
    write: Callable[[Cloud, BinaryIO, str], list[str]]
    """Cloud, stream, encoding -> what could not be kept."""
    encodings: tuple[str, ...]
    """The first is the default."""


def _text(suffix: str) -> Codec:
    return Codec("xyz", text.read, partial(text.write, suffix=suffix), text.ENCODINGS)


CODECS: dict[str, Codec] = {
    ".ply": Codec("ply", ply.read, ply.write, ply_header.ENCODINGS),
    ".pcd": Codec("pcd", pcd.read, pcd.write, pcd.ENCODINGS),
    **{suffix: _text(suffix) for suffix in (".xyz", ".txt", ".asc", ".csv", ".pts")},
}


def read(path: str | PathLike[str]) -> Cloud:
    """Reads a point cloud; the suffix, in either case, tells the format.

    Rows whose coordinates are not finite are kept (`Cloud.valid` tells them).

    Raises:
        InputError: if the file is missing, damaged, of an unknown suffix, or holds no coordinates.
        ResourceError: if it does not fit into memory.
    """
    path = Path(path)
    codec = _codec(path)
    try:
        return codec.read(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; split the file or use a larger machine") from error


def write(
    cloud: Cloud, path: str | PathLike[str], *, encoding: str | None = None, overwrite: bool = False
) -> list[str]:
    """Writes a point cloud with all it holds; the file appears complete or not at all.

    The coordinates are written in the type they were read in, bit for bit; normals take the place they had in
    the file, or follow the coordinates.

    Args:
        cloud: the cloud.
        path: the target, whose suffix tells the format.
        encoding: one of the format's encodings, or ``"binary"`` for its plain binary one. By default the
            encoding that the cloud was read in, as far as the format has it.
        overwrite: whether an existing file may be replaced.

    Returns:
        Warnings: what the format cannot hold.

    Raises:
        InputError: if the file cannot be written.
        UsageError: if the format has no such encoding.
    """
    path = Path(path)
    codec = _codec(path)
    chosen = _choose_encoding(cloud.source, codec, encoding, path)
    with atomic.atomic_write(path, overwrite=overwrite) as stream:
        warnings = codec.write(cloud, stream, chosen)
    return [f"{path}: {warning}" for warning in _losses(cloud, codec.format) + warnings]


def check_target(path: str | PathLike[str], *, encoding: str | None = None, overwrite: bool = False) -> None:
    """Finds out before a long computation whether `write` would refuse this path or encoding.

    Raises:
        InputError: if the suffix is unknown, the file exists and may not be overwritten, or its folder is
            missing or not writable.
        UsageError: if the format has no such encoding.
    """
    path = Path(path)
    _choose_encoding(Source(), _codec(path), encoding, path)
    atomic.check_target(path, overwrite)


def _codec(path: Path) -> Codec:
    codec = CODECS.get(path.suffix.lower())
    if codec is None:
        raise InputError(f"{path}: unknown suffix {path.suffix!r}; supported are {' '.join(sorted(CODECS))}")
    return codec


def _choose_encoding(source: Source, codec: Codec, wanted: str | None, path: Path) -> str:
    if wanted is None:
        if source.format == codec.format and source.encoding in codec.encodings:
            return source.encoding
        # A text table says nothing about the encoding that a PLY or PCD file should have.
        keeps_text = source.format != "xyz" and source.encoding in codec.encodings
        return source.encoding if keeps_text else codec.encodings[0]
    if wanted in codec.encodings:
        return wanted
    if wanted == "binary" and len(codec.encodings) > 1:
        return codec.encodings[0]
    raise UsageError(f"{path}: no encoding {wanted!r} for this suffix; choose from {', '.join(codec.encodings)}")


def _losses(cloud: Cloud, target: str) -> list[str]:
    """What belongs to the whole cloud and has no place in another format."""
    source = cloud.source
    if source.format == target:
        return []
    losses = []
    if isinstance(source.extra, ply.PlyExtra) and source.extra.elements:
        losses.append(f"{ply.describe_elements(source.extra.elements)} is not kept")
    if source.height is not None and source.height > 1:
        losses.append(f"the organisation in {source.height} rows of {source.width} points is not kept")
    if source.viewpoint not in (None, pcd.IDENTITY):
        losses.append("the viewpoint is not kept")
    return losses
