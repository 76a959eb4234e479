"""Arrays from .npy and .npz files that anyone may have written or damaged."""

from __future__ import annotations

import math
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
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
            _read_header(stream, path.stat().st_size, "the array")
            stream.seek(0)
            return {"arr_0": np.lib.format.read_array(stream, allow_pickle=False)}
    with _readable(path, "npz"), zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        return {name: _load(archive, f"{name}.npy") for name in names}


@dataclass(frozen=True)
class Described:
    """What the header of an array says.

    Attributes:
        shape, dtype: of the array.
        fortran: whether its first axis varies fastest in the file.
        begin: where its values begin, in bytes from the start of its member.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    begin: int

    @property
    def blank(self) -> NDArray[Any]:
        """An array of this shape and type that takes no memory."""
        return np.broadcast_to(np.zeros((), self.dtype), self.shape)


def describe_all(path: Path) -> dict[str, Described]:
    """Read the headers of the arrays of an .npz file.

    Raises:
        InputError: the file is missing or damaged.
    """
    with _readable(path, "npz"), zipfile.ZipFile(path) as archive:
        return {
            name.removesuffix(".npy"): _describe(archive, name) for name in archive.namelist() if name.endswith(".npy")
        }


def rows_of(path: Path, wanted: Mapping[str, Described], count: int, rows: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Read arrays of an .npz file side by side, piece by piece, compressed or not.

    Args:
        path: the file.
        wanted: the arrays, each of `count` rows; a grid (H, W, ...) has H W of them.
        count: rows of each.
        rows: of a piece, at most. Without rows, there is one piece.

    Raises:
        InputError: the file is damaged, or a grid lies column by column.
    """
    with _readable(path, "npz"), ExitStack() as opened:
        archive = opened.enter_context(zipfile.ZipFile(path))
        readers = {name: _Rows(archive, name, each, count, opened) for name, each in wanted.items()}
        for start in range(0, max(1, count), rows):
            size = min(rows, count - start)
            yield {name: reader.take(size) for name, reader in readers.items()}


class _Rows:
    """Reads an array in rows: from one place in its member or, where columns lie one after another, from one each."""

    def __init__(
        self, archive: zipfile.ZipFile, name: str, described: Described, count: int, opened: ExitStack
    ) -> None:
        shape, self._dtype = described.shape, described.dtype
        rest = shape[1:] if shape[0] == count else shape[2:]
        self._rest, parts = rest, 1
        if described.fortran and len(shape) > 1:
            if shape[0] != count:
                raise InputError(f"{name!r} is a grid that lies column by column; save it in the usual order")
            parts = math.prod(rest)
        self._item = self._dtype.itemsize * (1 if parts > 1 else math.prod(rest))
        self._streams = []
        for number in range(parts):
            # Sought at once: Python 3.12.1 and 3.13.0, for instance, seek from where any stream of a file read last.
            stream = opened.enter_context(archive.open(f"{name}.npy"))
            stream.seek(described.begin + number * count * self._item)
            self._streams.append(stream)

    def take(self, rows: int) -> NDArray[Any]:
        """Read the next so many rows."""
        parts = [np.frombuffer(_exactly(stream, rows * self._item), self._dtype) for stream in self._streams]
        if len(parts) == 1:
            return parts[0].reshape(rows, *self._rest)
        table = np.empty((rows, len(parts)), self._dtype, order="F")
        for column, part in zip(table.T, parts, strict=True):
            column[:] = part
        return table.reshape(rows, *self._rest, order="F")


def _exactly(stream: IO[bytes], size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise ValueError("an array is truncated")
    return data


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
    _describe(archive, member)
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _describe(archive: zipfile.ZipFile, member: str) -> Described:
    with archive.open(member) as stream:
        return _read_header(stream, archive.getinfo(member).file_size, member)


def _read_header(stream: IO[bytes], size: int, name: str) -> Described:
    """Read the header of an array; refuse one that declares more than there is, before memory is taken for it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a header is of an old form
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, fortran, dtype = read_header[version](stream)
    if dtype.hasobject:
        raise ValueError(f"{name} holds Python objects, which are not loaded")
    if math.prod(shape) * dtype.itemsize > size:
        raise ValueError(f"{name} declares a shape of {shape}, but is too short for it")
    return Described(shape, dtype, fortran, stream.tell())
