"""A point cloud in memory: float64 points, optional normals, and everything else its file held."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, ShapeError

LARGEST_COORDINATE = 1e150  # that can be computed with: squares of differences must be finite
AT_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The pose (`Source.viewpoint`) of a sensor in the origin that is not turned; files that know of no other have it."""


@dataclass(frozen=True)
class Source:
    """What a file said about itself, so that writing the cloud again loses nothing.

    Attributes:
        format: ``"ply"``, ``"pcd"``, ``"xyz"``, or ``""`` for a cloud made in memory.
        encoding: the format's own word, such as ``"ascii"``, ``"binary_big_endian"``,
            ``"binary_compressed"``.
        comments: the comment lines, without their markers.
        viewpoint: the sensor pose of a PCD file: x y z and the quaternion w x y z.
        width: columns of an organized cloud, else the number of points or None.
        height: rows of an organized cloud, else 1 or None.
        columns: names of the per-point columns in file order. Coordinates are called ``x y z`` and normals
            ``nx ny nz`` whatever the file calls them; every other name is a key of ``Cloud.attributes``.
        point_dtype: type of the coordinates in the file. Writing converts ``Cloud.points`` back to it.
        normal_dtype: type of the normals in the file, None where it had none.
        extra: what only the codec of this format understands. What it holds beyond the points and another format
            cannot keep, it names by a method ``losses() -> list[str]``, if it has one.
        sensors: (N, 3) float64, where the scanner stood that saw each point, in the cloud's coordinates; None where
            that is not known for sure. A row may be NaN.
        notes: what the reader has to tell the user, such as how many invalid points were left out.
    """

    format: str = ""
    encoding: str = ""
    comments: tuple[str, ...] = ()
    viewpoint: tuple[float, ...] | None = None
    width: int | None = None
    height: int | None = None
    columns: tuple[str, ...] = ()
    point_dtype: np.dtype[Any] = np.dtype(np.float64)
    normal_dtype: np.dtype[Any] | None = None
    extra: Any = None
    sensors: NDArray[np.float64] | None = field(default=None, compare=False, repr=False)
    notes: tuple[str, ...] = ()


@dataclass(repr=False)
class Cloud:
    """N points and what is known about each of them.

    Attributes:
        points: (N, 3) float64 coordinates; rows may be NaN or infinite (see `valid`).
        normals: (N, 3) float64, or None.
        attributes: per-point arrays, first axis N, each with its own dtype, in file order. A ragged list per
            point is an object array of arrays.
        source: what the file said about itself.

    What a masked array hides is NaN.

    Raises:
        ShapeError: an array does not have one row per point.
        InputError: points or normals are no real numbers, or the name of an attribute is no text.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64] | None = None
    attributes: dict[str, NDArray[Any]] = field(default_factory=dict)
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        self.points = _rows_of_three(self.points, "points")
        if self.normals is not None:
            self.normals = _rows_of_three(self.normals, "normals")
            if len(self.normals) != len(self):
                raise ShapeError(f"{len(self.normals)} normals for {len(self)} points")
        self.attributes = {name: _attribute(name, values) for name, values in self.attributes.items()}
        for name, values in self.attributes.items():
            if np.ndim(values) == 0 or len(values) != len(self):
                raise ShapeError(f"attribute {name!r} has shape {np.shape(values)} for {len(self)} points")
        sensors = self.source.sensors
        if sensors is not None and np.shape(sensors) != self.points.shape:
            raise ShapeError(f"the sensors have shape {np.shape(sensors)} for {len(self)} points")

    def __repr__(self) -> str:
        held = ["normals"] if self.normals is not None else []
        held += [f"attributes {', '.join(self.attributes)}"] if self.attributes else []
        return f"<Cloud: {len(self):,} points{' with ' if held else ''}{' and '.join(held)}>"

    def __len__(self) -> int:
        return len(self.points)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) bool: the points whose three coordinates are finite."""
        return np.asarray(np.isfinite(self.points).all(axis=1))


def check_coordinates(points: NDArray[np.float64], where: str = "") -> None:
    """Refuse finite points (N, 3) that cannot be computed with.

    Args:
        points: the points.
        where: what precedes the message, such as the name of their file.

    Raises:
        InputError: a coordinate is beyond 1e150.
    """
    largest = max(points.max(initial=0), -points.min(initial=0))
    if largest > LARGEST_COORDINATE:
        raise InputError(f"{where}coordinates as large as {largest:.3g} cannot be computed with; remove those points")


def unmasked(values: Any) -> NDArray[Any]:
    """Return an array as it is, a masked one with NaN where it hides a value; integers are float64 then."""
    if not np.ma.is_masked(values):
        return np.asarray(values)
    known = values.astype(np.float64) if values.dtype.kind in "iub" else values
    return np.asarray(known.filled(np.nan))


def _attribute(name: Any, values: Any) -> NDArray[Any]:
    try:
        name.encode("utf-8", "surrogateescape")  # as readers decode the names in a file
    except (AttributeError, UnicodeEncodeError):
        raise InputError(f"the name of an attribute is a text, not {name!r}") from None
    try:
        return unmasked(values)
    except ValueError:  # lists of unequal lengths
        raise ShapeError(f"attribute {name!r} is no array with a row for each point") from None


def _rows_of_three(values: Any, name: str) -> NDArray[np.float64]:
    array = unmasked(values)
    try:
        if array.dtype.kind not in "fiubO":
            raise TypeError
        array = np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be real numbers, not an array of {array.dtype}") from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise ShapeError(f"{name} must have shape (N, 3), not {array.shape}")
    return array
