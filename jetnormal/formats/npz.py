"""Arrays from .npy and .npz files that anyone may have written or damaged."""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, ResourceError


def load_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """Read arrays by their names; nothing is unpickled.

    Raises:
        InputError: the file is missing, damaged, or lacks an array.
        ResourceError: it does not fit into memory.
    """
    with _readable(path, "npz"), zipfile.ZipFile(path) as archive:
        members = archive.namelist()
        missing = [name for name in names if f"{name}.npy" not in members]
        if not missing:
            return [_load(archive, f"{name}.npy") for name in names]
    raise InputError(f"{path}: lacks the array {missing[0]!r}")


def load_all(path: Path) -> dict[str, NDArray[Any]]:
    """Read the array of an .npy file, as ``arr_0``, or all arrays of an .npz file; nothing is unpickled.

    Raises:
        InputError: the file is missing or damaged.
        ResourceError: it does not fit into memory.
    """
    if not zipfile.is_zipfile(path):
        with _readable(path, "npy"), path.open("rb") as stream:
            _check_header(stream, path.stat().st_size, "the array")
            stream.seek(0)
            return {"arr_0": np.lib.format.read_array(stream, allow_pickle=False)}
    with _readable(path, "npz"), zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        return {name: _load(archive, f"{name}.npy") for name in names}


@contextmanager
def _readable(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; use a smaller file") from error
    except Exception as error:  # NumPy's and zipfile's parsers raise errors of a dozen kinds on damaged files
        raise InputError(f"{path}: not a readable .{kind} file ({type(error).__name__}: {str(error)[:200]})") from error


def _load(archive: zipfile.ZipFile, member: str) -> NDArray[Any]:
    with archive.open(member) as stream:
        _check_header(stream, archive.getinfo(member).file_size, member)
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _check_header(stream: IO[bytes], size: int, name: str) -> None:
    """Refuse an array that declares more than there is, before memory is taken for it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a header is of an old form
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = read_header[version](stream)
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"{name} declares a shape of {shape}, but is too short for it")
