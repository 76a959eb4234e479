"""Files in PCPNet's layout: NAME.xyz, NAME.normals, NAME.pidx and lists of names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError


def cloud_names(directory: Path, list_file: str | None) -> list[str]:
    """Names of the clouds that a list names, one per line, or without a list of all that have normals.

    Raises:
        InputError: The list is missing, a cloud that it names lacks a file, or there are no clouds.
    """
    present = sorted(path.stem for path in directory.glob("*.normals") if _file(directory, path.stem, "xyz").is_file())
    path = directory / (list_file or "")
    names = present if list_file is None else read_list(path)
    missing = [name for name in names if name not in present]
    if missing:
        shown = ", ".join(missing[:5]) + (" ..." if len(missing) > 5 else "")
        raise InputError(f"{path}: listed clouds lack their .xyz or .normals file: {shown}")
    if not names:
        raise InputError(f"{path}: holds no clouds with normals")
    return names


def read_list(path: Path) -> list[str]:
    """Names in a list of clouds, one per line.

    Raises:
        InputError: The list is missing.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such list of clouds")
    return path.read_text(encoding="utf-8", errors="replace").split()


def read_cloud(directory: Path, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64] | None]:
    """Reads the points (N, 3), unit normals (N, 3) and, where there are any, the indices (Q,) to evaluate.

    Raises:
        InputError: A file is unreadable or does not match the others.
    """
    points = _read_numbers(_file(directory, name, "xyz"), columns=3)
    path = _file(directory, name, "normals")
    normals = _read_numbers(path, columns=3)
    if len(normals) != len(points):
        raise InputError(f"{path}: {len(normals)} normals for {len(points)} points")
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not length.all():
        raise InputError(f"{path}: row {int(np.argmin(length)) + 1} has no direction")
    path = _file(directory, name, "pidx")
    if not path.is_file():
        return points, normals / length, None
    queries = _read_numbers(path, columns=1)[:, 0].astype(np.int64)
    if queries.min() < 0 or queries.max() >= len(points):
        raise InputError(f"{path}: an index is not among the {len(points)} points")
    return points, normals / length, queries


def query_count(directory: Path, name: str) -> int:
    """Number of points of a cloud that are evaluated, without parsing its files: lines of .pidx, else of .xyz.

    Raises:
        InputError: The file is unreadable.
    """
    path = _file(directory, name, "pidx")
    path = path if path.is_file() else _file(directory, name, "xyz")
    try:
        with path.open("rb") as lines:
            return sum(not line.isspace() for line in lines)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error


def _file(directory: Path, name: str, suffix: str) -> Path:
    return directory / f"{name}.{suffix}"  # names contain dots, so no with_suffix


def _read_numbers(path: Path, columns: int) -> NDArray[np.float64]:
    """Reads a text file of finite numbers, (N, columns), N > 0."""
    try:
        numbers = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from error
    if numbers.size == 0 or numbers.shape[1] != columns or not np.isfinite(numbers).all():
        raise InputError(f"{path}: must hold {columns} finite numbers per row")
    return numbers
