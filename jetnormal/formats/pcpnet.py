"""Files in PCPNet's layout: NAME.xyz, NAME.normals, NAME.pidx and lists of names.

NAME is that of a shape, and of what was done to its points (Guerrero et al., "PCPNet: Learning Local Shape Properties
from Raw Point Clouds", Eurographics 2018).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import check_coordinates
from jetnormal.errors import InputError, unreadable
from jetnormal.formats import read
from jetnormal.formats.atomic import atomic_write, make_folder

TEST_LIST = "testset_all.txt"
LIST_PREFIX = "testset_"
SENSOR_ATTRIBUTES = ("sensor_x", "sensor_y", "sensor_z")  # of NAME.ply, which scans have beside the other files


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
    """Find the shape and the category in the name of a cloud; a noise level of no category is one of its own."""
    for category in ("striped", "gradient"):  # the longer ending first
        if name.endswith(CATEGORIES[category].ending):
            return name.removesuffix(CATEGORIES[category].ending), category
    shape, infix, level = name.rpartition(NOISE_INFIX)
    if not infix:
        return name, "none"
    known = {category.ending: key for key, category in CATEGORIES.items()}
    return shape, known.get(infix + level, f"noise {level}")


def shape_of(name: str, category: str) -> str:
    """Return the shape that a cloud of a category was made from, as far as its name tells."""
    return split_name(name)[0].removesuffix(f"_{category}")


def category_list(category: str) -> str:
    """Return the name of the list of a category, of PCPNet's test set or any other."""
    return CATEGORIES[category].list_file if category in CATEGORIES else f"{LIST_PREFIX}{category}.txt"


def categorize(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the category of each cloud: by the list in the folder that names it, else by its own name.

    A list testset_CATEGORY.txt makes a category. A cloud that several lists name belongs to the one of PCPNet, else to
    the shortest one.
    """
    known = {category.list_file: key for key, category in CATEGORIES.items()}
    lists = {path.name: read_list(path) for path in directory.glob(f"{LIST_PREFIX}*.txt") if path.name != TEST_LIST}
    listed: dict[str, str] = {}
    for list_file in sorted(lists, key=lambda list_file: (list_file in known, -len(lists[list_file]), list_file)):
        category = known.get(list_file, list_file.removeprefix(LIST_PREFIX).removesuffix(".txt"))
        listed |= dict.fromkeys(lists[list_file], category)  # the later list has the last word
    return {name: listed.get(name) or split_name(name)[1] for name in names}


def clean_twin(directory: Path, name: str) -> str | None:
    """Find the cloud that a noisy one was made from, if it is in the folder with its normals."""
    shape, infix, _ = name.rpartition(NOISE_INFIX)
    present = infix and all(file_of(directory, shape, suffix).is_file() for suffix in ("xyz", "normals"))
    return shape if present else None


def cloud_names(directory: Path, list_file: str | None) -> list[str]:
    """Return the names of the clouds that a list names, one per line, or without a list of all that have normals.

    Raises:
        InputError: the list is missing, a cloud that it names lacks a file, or there are no clouds.
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
    """Return the names in a list of clouds, one per line.

    Raises:
        InputError: the list is missing.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such list of clouds")
    return path.read_text(encoding="utf-8", errors="replace").split()


def read_cloud(directory: Path, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64] | None]:
    """Read the points (N, 3), unit normals (N, 3) and, where there are any, the indices (Q,) to evaluate.

    Raises:
        InputError: a file is unreadable or does not match the others.
    """
    path = file_of(directory, name, "xyz")
    points = _read_numbers(path, columns=3)
    check_coordinates(points, f"{path}: ")
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
    queries = _read_numbers(path, columns=1)[:, 0]
    if not np.isin(queries, np.arange(len(points))).all():
        raise InputError(f"{path}: an index is not among the {len(points)} points")
    return points, normals / length, queries.astype(np.int64)


def write_cloud(
    directory: Path, name: str, points: NDArray[np.float64], normals: NDArray[np.float64], queries: NDArray[np.int64]
) -> None:
    """Write the three files of a cloud; numbers keep the nine digits that tell single precision apart."""
    np.savetxt(file_of(directory, name, "xyz"), points, fmt="%.9g")
    np.savetxt(file_of(directory, name, "normals"), normals, fmt="%.9g")
    np.savetxt(file_of(directory, name, "pidx"), queries, fmt="%d")


def read_sensors(directory: Path, name: str, count: int) -> NDArray[np.float64]:
    """Read where each of `count` points of a scan was seen from, (count, 3), from the attributes of NAME.ply.

    Raises:
        InputError: the file is missing, unreadable, lacks the attributes or does not match the others.
    """
    path = file_of(directory, name, "ply")
    if not path.is_file():
        raise InputError(f"{path}: no such file; the places of the sensors come from it")
    attributes = read(path).attributes
    if not all(attribute in attributes for attribute in SENSOR_ATTRIBUTES):
        raise InputError(f"{path}: lacks an attribute {', '.join(SENSOR_ATTRIBUTES)}")
    sensors = np.stack([attributes[attribute] for attribute in SENSOR_ATTRIBUTES], axis=1).astype(np.float64)
    if len(sensors) != count:
        raise InputError(f"{path}: {len(sensors)} sensors for {count} points")
    return sensors


def read_normals(path: Path) -> NDArray[np.float64]:
    """Read the normals of another program, (N, 3), which may be NaN.

    Raises:
        InputError: the file is unreadable.
    """
    return _read_numbers(path, columns=3, finite=False)


def write_normals(path: Path, normals: NDArray[np.floating[Any]], *, overwrite: bool = False) -> None:
    """Write normals (N, 3) with six decimals; missing folders are made.

    Raises:
        InputError: the file cannot be written, or exists and may not be overwritten.
    """
    make_folder(path.parent)
    with atomic_write(path, overwrite=overwrite) as stream:
        np.savetxt(stream, normals, fmt="%.6f")


def query_count(directory: Path, name: str, all_points: bool = False) -> int:
    """Count the points of a cloud that are evaluated, without parsing its files: lines of .pidx, else of .xyz.

    Args:
        directory: the folder.
        name: of the cloud.
        all_points: whether all points count, whatever .pidx says.

    Raises:
        InputError: the file is unreadable.
    """
    path = file_of(directory, name, "pidx")
    path = path if path.is_file() and not all_points else file_of(directory, name, "xyz")
    try:
        with path.open("rb") as lines:
            return sum(not line.isspace() for line in lines)
    except OSError as error:
        raise unreadable(path, error) from error


def file_of(directory: Path, name: str, suffix: str) -> Path:
    """Return the path of a file of a cloud; names contain dots, so `Path.with_suffix` would not do."""
    return directory / f"{name}.{suffix}"


def _read_numbers(path: Path, columns: int, finite: bool = True) -> NDArray[np.float64]:
    """Read a text file of numbers, (N, columns), N > 0, all of them finite unless said otherwise."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about a file without numbers, which is refused below
            numbers = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check the file") from error
    if numbers.size == 0 or numbers.shape[1] != columns or (finite and not np.isfinite(numbers).all()):
        raise InputError(f"{path}: must hold {columns}{' finite' if finite else ''} numbers per row")
    return numbers
