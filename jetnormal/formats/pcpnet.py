"""Files in PCPNet's layout: NAME.xyz, NAME.normals, NAME.pidx and lists of names.

NAME is that of a shape, and of what was done to its points (Guerrero et al., "PCPNet: Learning Local Shape Properties
from Raw Point Clouds", Eurographics 2018).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError

TEST_LIST = "testset_all.txt"


@dataclass(frozen=True)
class Category:
    """One of the six parts of PCPNet's test set.

    Attributes:
        list_file: names its clouds.
        ending: what the names of its clouds have after that of the shape.
    """

    list_file: str
    ending: str


CATEGORIES = {
    "none": Category("testset_no_noise.txt", ""),
    "low": Category("testset_low_noise.txt", "_noise_white_1.25e-03"),
    "medium": Category("testset_med_noise.txt", "_noise_white_6.00e-03"),
    "high": Category("testset_high_noise.txt", "_noise_white_1.20e-02"),
    "gradient": Category("testset_vardensity_gradient.txt", "_ddist_minmax"),
    "striped": Category("testset_vardensity_striped.txt", "_ddist_minmax_layers"),
}
NOISE_INFIX = "_noise_white_"


def split_name(name: str) -> tuple[str, str]:
    """The shape and the category that the name of a cloud tells; a noise level of no category is one of its own."""
    for category in ("striped", "gradient"):  # the longer ending first
        if name.endswith(CATEGORIES[category].ending):
            return name.removesuffix(CATEGORIES[category].ending), category
    shape, infix, level = name.rpartition(NOISE_INFIX)
    if not infix:
        return name, "none"
    known = {category.ending: key for key, category in CATEGORIES.items()}
    return shape, known.get(infix + level, f"noise {level}")


def categorize(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """The category of each cloud: by the category list in the folder that names it, else by its own name."""
    listed: dict[str, str] = {}
    for key, category in CATEGORIES.items():
        if (directory / category.list_file).is_file():
            listed |= dict.fromkeys(read_list(directory / category.list_file), key)
    return {name: listed.get(name) or split_name(name)[1] for name in names}


def clean_twin(directory: Path, name: str) -> str | None:
    """Name of the cloud that a noisy one was made from, if it is in the folder with its normals."""
    shape, infix, _ = name.rpartition(NOISE_INFIX)
    present = infix and all(file_of(directory, shape, suffix).is_file() for suffix in ("xyz", "normals"))
    return shape if present else None


def cloud_names(directory: Path, list_file: str | None) -> list[str]:
    """Names of the clouds that a list names, one per line, or without a list of all that have normals.

    Raises:
        InputError: The list is missing, a cloud that it names lacks a file, or there are no clouds.
    """
    labeled = (path.stem for path in directory.glob("*.normals"))
    present = sorted(name for name in labeled if file_of(directory, name, "xyz").is_file())
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
    points = _read_numbers(file_of(directory, name, "xyz"), columns=3)
    path = file_of(directory, name, "normals")
    normals = _read_numbers(path, columns=3)
    if len(normals) != len(points):
        raise InputError(f"{path}: {len(normals)} normals for {len(points)} points")
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if not length.all():
        raise InputError(f"{path}: row {int(np.argmin(length)) + 1} has no direction")
    path = file_of(directory, name, "pidx")
    if not path.is_file():
        return points, normals / length, None
    queries = _read_numbers(path, columns=1)[:, 0].astype(np.int64)
    if queries.min() < 0 or queries.max() >= len(points):
        raise InputError(f"{path}: an index is not among the {len(points)} points")
    return points, normals / length, queries


def write_cloud(
    directory: Path, name: str, points: NDArray[np.float64], normals: NDArray[np.float64], queries: NDArray[np.int64]
) -> None:
    """Writes the three files of a cloud; numbers keep the nine digits that tell single precision apart."""
    np.savetxt(file_of(directory, name, "xyz"), points, fmt="%.9g")
    np.savetxt(file_of(directory, name, "normals"), normals, fmt="%.9g")
    np.savetxt(file_of(directory, name, "pidx"), queries, fmt="%d")


def query_count(directory: Path, name: str, all_points: bool = False) -> int:
    """Number of points of a cloud that are evaluated, without parsing its files: lines of .pidx, else of .xyz.

    Args:
        directory: the folder.
        name: of the cloud.
        all_points: whether all points count, whatever .pidx says.

    Raises:
        InputError: The file is unreadable.
    """
    path = file_of(directory, name, "pidx")
    path = path if path.is_file() and not all_points else file_of(directory, name, "xyz")
    try:
        with path.open("rb") as lines:
            return sum(not line.isspace() for line in lines)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error


def file_of(directory: Path, name: str, suffix: str) -> Path:
    """A file of a cloud; names contain dots, so `Path.with_suffix` would not do."""
    return directory / f"{name}.{suffix}"


def _read_numbers(path: Path, columns: int) -> NDArray[np.float64]:
    """Reads a text file of finite numbers, (N, columns), N > 0."""
    try:
        numbers = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from error
    if numbers.size == 0 or numbers.shape[1] != columns or not np.isfinite(numbers).all():
        raise InputError(f"{path}: must hold {columns} finite numbers per row")
    return numbers
