"""Which file formats there are. A format is one module of this package.

How to add a format: write `jetnormal/formats/NAME.py` with

    def read(path: Path) -> Cloud: ...                                       # cloud_from_columns helps
    def write(cloud: Cloud, stream: BinaryIO, encoding: str) -> list[str]: ...  # columns_from_cloud, to_storable
    FORMATS = (Format("NAME", (".suffix",), read, write, encodings=("binary",)),)

`read` raises `InputError` for a damaged file; `write` returns what could not be kept. Nothing else needs to be told:
modules of this package that define `FORMATS` are found, tests/formats/test_formats.py sends clouds through every
format, and the messages of the command line list the suffix. If a library does the work, make it an extra in
pyproject.toml, name that in support/extras.py, and import it by `require` from there within the functions.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, JetnormalError
from jetnormal.formats.streams import CloudStream, RowWriter
from jetnormal.support.streams import STREAM


@dataclass(frozen=True)
class Format:
    """How the files of some suffixes are read and written.

    Attributes:
        name: of the format; suffixes with the same conventions share it.
        suffixes: in lower case, with their dots; none if only ``--format NAME`` tells it.
        read: makes a cloud of a file. Where `has_columns`, it takes the keyword arguments columns and decimal, too.
        write: cloud, stream, encoding -> what could not be kept. None if the format cannot hold normals.
        encodings: the first is the default.
        keeps_viewpoint: whether it has a place for `Source.viewpoint`.
        has_columns: whether the user may say what the columns mean.
        stream: opens a file to be read in pieces, with the arguments of `read`; None if that cannot be done.
        write_rows: first piece of a cloud, rows in all, their box (2, 3), stream, encoding -> what appends pieces, the
            first included; None if that cannot be done. It raises `InputError` for an encoding that needs all at once.
        stream_reads_all: whether `stream` has to look at the whole file before the first piece.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[..., Cloud]
    write: Callable[[Cloud, BinaryIO, str], list[str]] | None
    encodings: tuple[str, ...]
    keeps_viewpoint: bool = False
    has_columns: bool = False
    stream: Callable[..., CloudStream] | None = None
    write_rows: Callable[[Cloud, int, NDArray[np.float64], BinaryIO, str], RowWriter] | None = None
    stream_reads_all: bool = False


CONVERSIONS = {
    ".rcp": "export the project as E57 from Autodesk ReCap",
    ".rcs": "export the project as E57 from Autodesk ReCap",
    ".fls": "export the scans as E57 from FARO SCENE",
    ".lsproj": "export the scans as E57 from FARO SCENE",
    ".zfs": "export the scans as E57 from Z+F LaserControl",
    ".rxp": "export the scans as LAZ or E57 from RiSCAN PRO",
    ".rdbx": "export the points as LAZ from RIEGL's rdb2las or RiSCAN PRO",
    ".imp": "export the project as E57 from Leica Cyclone",
    ".tzf": "export the scans as E57 from Trimble RealWorks",
    ".gz": "unpack it first: gunzip FILE",
    ".zip": "unpack it first: unzip FILE",
    ".bin": "say what it is: `format=kitti` for rows of x, y, z and reflectance in float32",
    **dict.fromkeys(
        (".obj", ".off", ".stl", ".glb", ".gltf"),
        "a mesh has surfaces of its own; save its vertices as PLY to treat them as points",
    ),
}
"""What to do about files that are not read, by suffix."""


@cache
def all_formats() -> tuple[Format, ...]:
    """Find the formats of all modules in this package."""
    found: list[Format] = []
    package = importlib.import_module(__package__)
    for info in pkgutil.iter_modules(package.__path__):
        found += getattr(importlib.import_module(f"{__package__}.{info.name}"), "FORMATS", ())
    return tuple(found)


def suffixes() -> list[str]:
    """List the suffixes that can be read."""
    return sorted(suffix for known in all_formats() for suffix in known.suffixes)


def find_format(path: Path, name: str | None = None) -> Format:
    """Find the format of a file.

    Args:
        path: its suffix, in either case, tells the format.
        name: tells it instead: a suffix without its dot, or the name of a format that has no suffix.

    Raises:
        InputError: there is no such format.
    """
    suffix = path.suffix.lower() if name is None else f".{name.lower().removeprefix('.')}"
    for known in all_formats():
        if suffix in known.suffixes or (not known.suffixes and suffix == f".{known.name}"):
            return known
    if name is not None:
        names = sorted({s[1:] for s in suffixes()} | {known.name for known in all_formats() if not known.suffixes})
        raise InputError(f"{path}: unknown format {name!r}; there are {', '.join(names)}")
    if suffix in CONVERSIONS:
        raise InputError(f"{path}: {suffix} files are not read; {CONVERSIONS[suffix]}")
    if str(path) == STREAM:
        raise InputError("-: `format` tells what a stream holds: `format=ply`, for instance")
    raise InputError(f"{path}: unknown suffix {path.suffix!r}; supported are {' '.join(suffixes())}")


WRITE_ADVICE = "is the disk full? Free some space, or choose another output or format"


@contextmanager
def library_errors(
    path: Path | str, library: str, advice: str = "is it damaged? Export the file again"
) -> Iterator[None]:
    """Turn whatever a library raises about a file into an `InputError`, but for our own, the system's and memory's.

    Libraries raise what comes (KeyError, struct.error, their own classes, the panics of compiled code).
    """
    try:
        yield
    except (JetnormalError, OSError, MemoryError):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: {library} cannot handle it ({reason[:200]}); {advice}") from error
