"""The numbers of a LAS file: coordinates as integers with a scale, attributes as dimensions that can hold them."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError
from jetnormal.formats.columns import Columns, as_unicode
from jetnormal.formats.storage import COLORS

TYPES = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "u8": 7, "i8": 8, "f4": 9, "f8": 10}
"""The codes of the types of extra dimensions."""
_LONGEST_NAME = 32
_LARGEST = 2**31 - 1
_FINEST_SCALE = 12  # decimals


def decimal_scale(values: NDArray[np.float64]) -> float:
    """Return the coarsest power of ten of which all are multiples; else the finest that 31 bits allow."""
    largest = float(np.abs(values).max(initial=0))
    finest, rounding = finest_scale(largest), float(np.finfo(np.float32).eps) * largest
    scale = max(1.0, finest)
    while scale > finest:
        scaled = values / scale
        off = np.abs(scaled - np.rint(scaled)).max(initial=0)
        if off < 1e-4 and off * scale <= rounding:
            break
        scale = _power_of_ten(round(np.log10(scale)) - 1)
    return scale


def finest_scale(largest: float) -> float:
    """Return the finest power of ten of which `largest` is a multiple that fits 31 bits."""
    exponent = -_FINEST_SCALE
    while largest / _power_of_ten(exponent) > _LARGEST:
        exponent += 1
    return _power_of_ten(exponent)


def _power_of_ten(exponent: int) -> float:
    return float(f"1e{exponent}")


def to_integers(
    values: NDArray[np.float64], scale: float, offset: float, dtype: np.dtype[Any]
) -> tuple[NDArray[np.int32], bool]:
    """Convert coordinates to a file's integers; tell whether these give the same ones as exactly as their type can."""
    scaled = np.rint((values - offset) / scale)
    if np.abs(scaled).max(initial=0) > _LARGEST:
        raise InputError(
            f"coordinates from {values.min():g} to {values.max():g} do not fit the LAS scale {scale:g} and offset "
            f"{offset:g} of the input; write another format"
        )
    largest = np.abs(values).max(initial=0)
    rounding = 4 * np.spacing(largest + abs(offset))
    if dtype == np.float32:
        rounding = max(rounding, float(np.spacing(np.float32(largest))) / 2)
    rounding = min(rounding, 1e-6 * largest)  # near zero, the offset has fewer decimals than the values
    exact = bool(np.abs(scaled * scale + offset - values).max(initial=0) <= rounding)
    return scaled.astype(np.int32), exact


def sort_columns(columns: Columns, point_format: Any, *, is_new: bool) -> tuple[Columns, Columns, list[str]]:
    """Find what the point format has a dimension for, what it has not, and what had to be changed to fit.

    Colors and intensities of other formats are spread over the 16 bits that LAS has for them.
    """
    there: Columns = {}
    others: Columns = {}
    warnings = []
    for name, given in columns.items():
        if name not in point_format.dimension_names:
            others[name] = given
            continue
        dimension, values = point_format.dimension_by_name(name), given
        if is_new and name in (*COLORS, "intensity"):
            values = _to_16_bits(values, is_color=name in COLORS)
        if not (fits(values, dimension) if dimension.is_standard else _fits_extra(values, dimension)):
            others[name] = given
            continue
        if values.dtype.kind != given.dtype.kind:
            warnings.append(f"attribute {name!r} is scaled to 16 bits")
        is_integer = dimension.kind.name != "FloatingPoint" and not dimension.is_scaled
        there[name] = values.astype(np.int64) if is_integer and values.dtype.kind == "f" else values
    return there, others, warnings


def _to_16_bits(values: NDArray[Any], *, is_color: bool) -> NDArray[Any]:
    if is_color and values.dtype == np.uint8:
        return values * np.uint16(257)
    if values.dtype.kind == "f" and values.size and values.min() >= 0 and values.max() <= 1:
        return np.rint(values * 65535).astype(np.uint16)
    return values


def fits(values: NDArray[Any], dimension: Any) -> bool:
    """Tell whether values can be stored in a standard dimension without a change."""
    if values.ndim != 1 or values.dtype.kind not in "uif":
        return False
    if dimension.kind.name == "FloatingPoint" or not values.size:
        return True
    low, high = dimension.min, dimension.max
    return bool((values >= low).all() and (values <= high).all() and (values == np.rint(values)).all())


def _fits_extra(values: NDArray[Any], dimension: Any) -> bool:
    """Whether values can be stored in an extra dimension of the input; others may have taken its name since."""
    shape = () if dimension.num_elements == 1 else (dimension.num_elements,)
    if values.shape[1:] != shape or values.dtype.kind not in "uif":
        return False
    if not dimension.is_scaled:
        return bool(np.can_cast(values.dtype, dimension.dtype.base, "same_kind"))
    limits = np.iinfo(dimension.dtype.base) if dimension.dtype.base.kind in "iu" else np.finfo(dimension.dtype.base)
    raw = (values - dimension.offsets) / dimension.scales
    return bool(((raw >= limits.min) & (raw <= limits.max)).all())


def declare(laspy: Any, header: Any, columns: Columns) -> list[str]:
    """Add extra dimensions of these names and types to a header; returns the names that they got there."""
    names: list[str] = []
    for name in columns:
        encoded = as_unicode(name).encode()
        short = encoded[:_LONGEST_NAME].decode(errors="ignore")
        number = 2
        while short in names or short in header.point_format.dimension_names:
            ending = f"_{number}"
            short = encoded[: _LONGEST_NAME - len(ending)].decode(errors="ignore") + ending
            number += 1
        names.append(short)
        header.point_format.add_extra_dimension(laspy.ExtraBytesParams(short, columns[name].dtype))
    return names


def describe(dimension: Any) -> bytes:
    """Return the 192 bytes that tell a reader the name and the type of an extra dimension."""
    code = TYPES[dimension.dtype.str[1:]]
    return struct.pack("<2xBB32s124x32s", code, 0, dimension.name.encode(), b"")
