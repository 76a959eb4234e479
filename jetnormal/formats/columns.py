"""Between a file's named columns and a `Cloud`: what all formats share."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError

Columns = dict[str, NDArray[Any]]

COORDINATES = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
_NORMAL_SPELLINGS = (
    NORMALS,
    ("normal_x", "normal_y", "normal_z"),
    ("normalx", "normaly", "normalz"),
    ("normal x", "normal y", "normal z"),
)


class UniqueNames:
    """Names of which none comes twice, in time that does not grow with their number."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)
        self._numbers: dict[str, int] = {}

    def add(self, name: str) -> str:
        """Take `name`, or `name_2`, `name_3`... where it is taken."""
        candidate, number = name, self._numbers.get(name, 1)
        while candidate in self._taken:
            number += 1
            candidate = f"{name}_{number}"
        self._numbers[name] = number
        self._taken.add(candidate)
        return candidate


def as_unicode(name: str) -> str:
    """Return a name as text that UTF-8 can encode: bytes of a file that were none are taken for Latin-1."""
    return "".join(chr(ord(c) - 0xDC00) if "\udc80" <= c <= "\udcff" else c for c in name)


def canonical_names(names: Collection[str], path: Path) -> dict[str, str]:
    """Find which of a file's columns are the coordinates and the normals, whatever their spelling and case.

    Returns:
        The file's names of them mapped to ``x y z`` and, where all three are there, ``nx ny nz``.

    Raises:
        InputError: if a coordinate is missing.
    """
    spelled = {name.lower(): name for name in reversed(list(names))} | {name: name for name in names}
    missing = [name for name in COORDINATES if name not in spelled]
    if missing:
        held = ", ".join(names) or "nothing"
        raise InputError(f"{path}: no column {missing[0]!r} among {held}; name the coordinates x, y and z")
    found = {spelled[name]: name for name in COORDINATES}
    for spelling in _NORMAL_SPELLINGS:
        if all(name in spelled for name in spelling):
            found |= {spelled[name]: normal for name, normal in zip(spelling, NORMALS, strict=True)}
            break
    return found


def cloud_from_columns(columns: Mapping[str, NDArray[Any]], source: Source, path: Path) -> Cloud:
    """Build a cloud from the per-point columns of a file, and complete `source` with their order and types.

    Raises:
        InputError: if a coordinate is missing or is not one number per point.
    """
    names = canonical_names(columns.keys(), path)
    special: Columns = {}
    attributes: Columns = {}
    order = []
    unique = UniqueNames(names.values())
    for name, values in columns.items():
        if name in names:
            if values.ndim != 1 or values.dtype.kind not in "fiu":
                raise InputError(f"{path}: column {name!r} must hold one number per point")
            special[names[name]] = values
            order.append(names[name])
        else:
            key = unique.add(name)
            attributes[key] = np.ascontiguousarray(values)
            order.append(key)
    points, point_dtype = _join([special[name] for name in COORDINATES])
    normals, normal_dtype = None, None
    if "nx" in special:
        normals, normal_dtype = _join([special[name] for name in NORMALS])
    source = replace(source, columns=tuple(order), point_dtype=point_dtype, normal_dtype=normal_dtype)
    return Cloud(points, normals, attributes, source)


def _join(columns: list[NDArray[Any]]) -> tuple[NDArray[np.float64], np.dtype[Any]]:
    joined = np.empty((len(columns[0]), 3))
    for axis, column in enumerate(columns):
        joined[:, axis] = column
    return joined, np.result_type(*columns).newbyteorder("=")


def columns_from_cloud(
    cloud: Cloud, normal_names: tuple[str, ...], new_normal_dtype: np.dtype[Any]
) -> tuple[Columns, list[str]]:
    """Lay out the per-point columns of a cloud for writing, in file order.

    Normals take the place they had in the file. New ones follow the coordinates: readers that go by position
    (MeshLab's and Open3D's XYZ, our own) expect ``x y z nx ny nz`` first, and MeshLab, CloudCompare and
    Open3D write PLY in that order; readers that go by name do not mind. New attributes come last.

    Args:
        cloud: the cloud.
        normal_names: what the format calls the normals.
        new_normal_dtype: their type where the file had none.

    Returns:
        The columns by name (arrays with first axis N), and a warning for each attribute that had to be
        renamed.
    """
    spelled = dict(zip(COORDINATES, COORDINATES, strict=True))
    columns = dict(zip(COORDINATES, _split(cloud.points, cloud.source.point_dtype), strict=True))
    if cloud.normals is not None:
        normals = _split(cloud.normals, cloud.source.normal_dtype or new_normal_dtype)
        spelled |= dict(zip(NORMALS, normal_names, strict=True))
        columns |= dict(zip(normal_names, normals, strict=True))
    renamed, warnings = {}, []
    unique = UniqueNames(columns)
    for name, values in cloud.attributes.items():
        clean = "_".join(name.split()) or "column"  # a blank would split a line of the header
        renamed[name] = unique.add(clean)
        columns[renamed[name]] = values
        if renamed[name] != name:
            warnings.append(f"attribute {name!r} is written as {renamed[name]!r}")
    return {name: columns[name] for name in _order(cloud, spelled, renamed)}, warnings


def _order(cloud: Cloud, spelled: dict[str, str], renamed: dict[str, str]) -> list[str]:
    """The names in the target in the order of the source; an attribute may bear the name of a normal."""
    known = [renamed.get(name) or spelled.get(name) for name in cloud.source.columns]
    order = [name for name in known if name is not None]
    if "x" not in order:
        order = [*COORDINATES, *order]
    new_normals = [spelled[name] for name in NORMALS if name in spelled and spelled[name] not in order]
    after = 1 + max(order.index(name) for name in COORDINATES)
    order[after:after] = new_normals
    placed = set(order)
    return order + [name for name in renamed.values() if name not in placed]


def _split(values: NDArray[np.float64], dtype: np.dtype[Any]) -> list[NDArray[Any]]:
    """The three columns in the file's type, or as float64 where that is an integer type they do not fit."""
    if dtype.kind in "iu":
        with np.errstate(invalid="ignore"):
            converted = values.astype(dtype)
        if not np.array_equal(converted, values):
            return list(values.T)
        return list(converted.T)
    return list(values.astype(dtype, copy=False).T)
