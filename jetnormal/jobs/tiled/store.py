"""The folder of tiles: what is on disk while a large cloud is computed. A JSON file or array is complete or not there.

.lock                held while a process computes the tiles
job.json             what is computed: the input and the options
room.json            points of a tile, and of the thinned cloud
plan.json            the tiles; there once all points are in them
00012.points         (n, 3) float64, in the order of the input
00012.rows           (n,) int64, which rows of the input they are
00012.sensors        (n, 3) float64, where each was seen from, if that is known for each
00012.found.npy      (n,) FOUND, the estimator's directions
00012.sample.npy     (s,) SAMPLE, rows of the tile that may go into the thinned cloud
00012.json           what the estimator said
thinned.npz          the thinned cloud with signs
decision.json        how they were chosen
00012.signed.npy     (n,) SIGNED, the signs of the directions
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError
from jetnormal.formats.atomic import atomic_write

Floats = NDArray[np.float64]

FOUND = np.dtype([("normal", "f4", 3), ("confidence", "f4"), ("curvatures", "f4", 2)])
SAMPLE = np.dtype([("row", "i8"), ("rank", "f8")])
SIGNED = np.dtype([("flip", "?"), ("sure", "f4")])
_RAW = {"points": (np.dtype(np.float64), (3,)), "rows": (np.dtype(np.int64), ()), "sensors": (np.dtype("f8"), (3,))}


@dataclass(frozen=True)
class Store:
    """The files of a folder of tiles, by the number of the tile."""

    folder: Path

    def clear(self, *kept: str) -> None:
        """Remove all files but some."""
        for path in self.folder.iterdir():
            if path.name not in kept:
                path.unlink()

    def append(self, kind: str, tile: int, values: NDArray[Any]) -> None:
        """Append rows to the points, rows or sensors of a tile."""
        with self._path(tile, kind).open("ab") as stream:
            stream.write(np.ascontiguousarray(values, _RAW[kind][0]).tobytes())

    def raw(self, kind: str, tile: int) -> NDArray[Any]:
        """Map the points, rows or sensors of a tile into memory."""
        dtype, shape = _RAW[kind]
        path = self._path(tile, kind)
        count = path.stat().st_size // (dtype.itemsize * int(np.prod(shape)))
        return np.memmap(path, dtype, "r", shape=(count, *shape)) if count else np.empty((0, *shape), dtype)

    def has(self, kind: str, tile: int) -> bool:
        """Tell whether a tile has an array."""
        return self._path(tile, f"{kind}.npy").exists()

    def save(self, kind: str, tile: int, values: NDArray[Any]) -> None:
        """Write an array of a tile."""
        with self._fresh(f"{tile:05}.{kind}.npy") as stream:
            np.save(stream, values, allow_pickle=False)

    def load(self, kind: str, tile: int) -> NDArray[Any]:
        """Map an array of a tile into memory."""
        loaded: NDArray[Any] = np.load(self._path(tile, f"{kind}.npy"), mmap_mode="r", allow_pickle=False)
        return loaded

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write what is known of all tiles, or of one."""
        with self._fresh(f"{name}.json") as stream:
            stream.write(json.dumps(content).encode())

    def read_json(self, name: str) -> dict[str, Any] | None:
        """Read it; None if it is not there.

        Raises:
            InputError: it is damaged.
        """
        path = self.folder / f"{name}.json"
        if not path.exists():
            return None
        try:
            return dict(json.loads(path.read_bytes()))
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: damaged ({error}); remove {self.folder} and start anew") from error

    def write_arrays(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write arrays under their names."""
        with self._fresh(f"{name}.npz") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]

    def read_arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Read arrays that are there."""
        with np.load(self.folder / f"{name}.npz", allow_pickle=False) as held:
            return {key: held[key] for key in held.files}

    def stamp(self, name: str) -> tuple[int, int]:
        """Tell the arrays of a name from those that another run wrote there: their time and size."""
        state = (self.folder / f"{name}.npz").stat()
        return state.st_mtime_ns, state.st_size

    def _path(self, tile: int, kind: str) -> Path:
        return self.folder / f"{tile:05}.{kind}"

    def _fresh(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A file that takes its name when it is complete; two workers may write the same at a time."""
        return atomic_write(self.folder / name, overwrite=True)
