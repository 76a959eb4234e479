"""What a format's columns can hold: number types, several values per point, packed colors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.formats.columns import Columns, UniqueNames

COLORS = ("red", "green", "blue")


def to_storable(columns: Columns, types: frozenset[str], *, vectors: bool) -> tuple[Columns, list[str]]:
    """Convert columns to what a format can hold, without loss where possible.

    Args:
        columns: arrays of any type with first axis N; an object array holds a list per point.
        types: the format's types, such as ``{"u1", "f4"}``, with ``"O"`` if it has lists of them.
        vectors: whether a column may hold several numbers per point, shape (N, c). Where it may not, c
            columns ``name_0``, ``name_1``... are made of it.

    Returns:
        The columns, in native byte order, and a warning for each that changed or was dropped.
    """
    stored: Columns = {}
    warnings = []
    unique, unique_parts = UniqueNames(), UniqueNames(columns)
    for name, column in columns.items():
        lists = column.dtype == object
        values = column if not lists else _members(column) if "O" in types else _stack_lists(column)
        if values is None:
            warnings.append(f"attribute {name!r} holds lists of different lengths and is not kept")
        elif values.dtype.kind not in "biuf":
            warnings.append(f"attribute {name!r} of type {values.dtype} is not kept")
        elif 0 in values.shape[1:]:
            warnings.append(f"attribute {name!r} has no values and is not kept")
        else:
            fitting = _nearest_type(values, types)
            if not _same_numbers(fitting, values):
                warnings.append(f"attribute {name!r} of type {values.dtype} is rounded to {fitting.dtype}")
            if lists and "O" in types:
                stored[unique.add(name)] = _split(fitting, column)
                continue
            if fitting.ndim == 1 or vectors:
                stored[unique.add(name)] = fitting
                continue
            parts = fitting.reshape(len(fitting), int(np.prod(fitting.shape[1:]))).T
            warnings.append(f"attribute {name!r} is written as {len(parts)} columns {name}_0, {name}_1...")
            for index, part in enumerate(parts):
                stored[unique.add(unique_parts.add(f"{name}_{index}"))] = part
    return stored, warnings


def _same_numbers(converted: NDArray[Any], values: NDArray[Any]) -> bool:
    with np.errstate(all="ignore"):
        back = converted.astype(values.dtype)
    return np.array_equal(back, values, equal_nan=values.dtype.kind == "f")


def _stack_lists(values: NDArray[Any]) -> NDArray[Any] | None:
    """A column of lists as an array (N, c); None if their lengths differ."""
    if len({np.shape(row) for row in values}) != 1:
        return None
    return np.stack(list(values))


def _members(lists: NDArray[Any]) -> NDArray[Any]:
    """The members of all lists of a column, one after another (M,)."""
    rows = list(map(np.ravel, lists))
    full = [row for row in rows if len(row)]  # Python's [] would count as float64
    return np.concatenate(full or rows or [np.empty(0, np.float32)])


def _split(members: NDArray[Any], lists: NDArray[Any]) -> NDArray[Any]:
    """A column of lists like another, with these members (M,)."""
    column = np.empty(len(lists), object)
    ends = np.cumsum([np.size(row) for row in lists], dtype=np.int64)
    for index, row in enumerate(np.split(members, ends)[:-1]):
        column[index] = row  # assigned at once, lists of one length would be a matrix
    return column


def _nearest_type(values: NDArray[Any], types: frozenset[str]) -> NDArray[Any]:
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    if values.dtype.str[1:] in types:
        return values
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype.kind in "iu" and (not values.size or np.can_cast(_range_type(values), np.int32)):
        return values.astype(np.int32)
    return values.astype(np.float32 if values.dtype == np.float16 else np.float64)


def _range_type(values: NDArray[Any]) -> np.dtype[Any]:
    return np.result_type(np.min_scalar_type(values.min()), np.min_scalar_type(values.max()))


def unpack_colors(columns: Columns) -> Columns:
    """Replace PCL's packed ``rgb`` or ``rgba`` column (0xAARRGGBB) by one column per channel."""
    unpacked: Columns = {}
    unique = UniqueNames(columns)
    for name, values in columns.items():
        if name not in ("rgb", "rgba") or values.dtype.itemsize != 4 or values.ndim != 1 or "red" in columns:
            unpacked[name] = values
            continue
        packed = np.ascontiguousarray(values).view(np.uint32)
        channels = [*COLORS, "alpha"] if name == "rgba" else COLORS
        for channel, shift in zip(channels, (16, 8, 0, 24), strict=False):
            unpacked[unique.add(channel)] = (packed >> shift).astype(np.uint8)
    return unpacked


def pack_colors(columns: Columns) -> Columns:
    """Replace ``red green blue`` of 8 bits (and ``alpha``) by the packed column that PCL's tools understand.

    It is ``rgb`` in a float32 column, as in pcl::PointXYZRGB, or ``rgba`` in a uint32 column.
    """
    if "rgb" in columns or any(name not in columns or columns[name].dtype != np.uint8 for name in COLORS):
        return columns
    red, green, blue = (columns[name].astype(np.uint32) for name in COLORS)
    packed = red << 16 | green << 8 | blue
    has_alpha = "alpha" in columns and columns["alpha"].dtype == np.uint8 and "rgba" not in columns
    if has_alpha:
        packed |= columns["alpha"].astype(np.uint32) << 24
    replaced: Columns = {}
    for name, values in columns.items():
        if name == "red":
            replaced["rgba" if has_alpha else "rgb"] = packed if has_alpha else packed.view(np.float32)
        elif name not in COLORS and not (name == "alpha" and has_alpha):
            replaced[name] = values
    return replaced
