"""Files of several scans, each in the frame of its own scanner: E57, PTX."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import AT_ORIGIN, Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.columns import COORDINATES, NORMALS, Columns, cloud_from_columns
from jetnormal.formats.streams import CloudStream, memory_of

SCAN = "scan"
"""The attribute that counts the scans from 0."""
_FEWEST_POINTS = 100  # fewer may lie in a row by chance
_RASTER_CORRELATION = 0.99  # 0.9999 in a real scan, 0.4 in one whose rows and columns mean nothing


@dataclass(frozen=True)
class Pose:
    """Where a scanner stood, and how it was turned: global = rotation @ local + translation.

    Attributes:
        rotation: (3, 3).
        translation: (3,), the position of the scanner.
    """

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    translation: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def is_moved(self) -> bool:
        """Whether the scanner's frame is another than the common one."""
        return bool(self.translation.any()) or not np.array_equal(self.rotation, np.eye(3))

    def to_global(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points (N, 3) from the scanner's frame into the common one."""
        return self.turn(points) + self.translation if self.translation.any() else self.turn(points)

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points (N, 3) from the common frame into the scanner's."""
        shifted = points - self.translation if self.translation.any() else points
        return Pose(self.rotation.T).turn(shifted)

    def turn(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn directions (N, 3) from the scanner's frame into the common one."""
        return directions if np.array_equal(self.rotation, np.eye(3)) else directions @ self.rotation.T


class Scan(NamedTuple):
    """The points of one scan: columns with ``x y z`` and perhaps ``nx ny nz`` in the scanner's frame."""

    columns: Columns
    pose: Pose
    invalid: int = 0
    """How many rows of the file the scanner did not measure; they are left out."""


@dataclass(frozen=True)
class ScansExtra:
    """What a file of scans held besides its points' numbers.

    Attributes:
        poses: of the scans.
        details: what only the format understands.
    """

    poses: tuple[Pose, ...]
    details: Any = None

    def losses(self) -> list[str]:
        """Name what other formats cannot hold."""
        moved = sum(bool(pose.translation.any()) for pose in self.poses)
        lost = [f"the positions of the scanner in {moved} scans are not kept"] if moved else []
        return lost + (list(self.details.losses()) if hasattr(self.details, "losses") else [])


def cloud_from_scans(scans: Sequence[Scan], source: Source, path: Path, details: Any = None) -> Cloud:
    """Join scans into a cloud in the common frame, with the scanner's position for each point.

    If no scanner stands elsewhere than in the origin, the file may just not tell where it stood. A raster of angles
    around the origin shows that it stood there (`_is_raster`); otherwise the origin is the cloud's viewpoint, which is
    believed as far as the surfaces bear it out.

    Raises:
        InputError: there is no scan, or it lacks coordinates.
    """
    if not scans:
        raise InputError(f"{path}: holds no scans; is this the right file?")
    names = list(dict.fromkeys(name for scan in scans for name in scan.columns))
    lengths = [len(scan.columns["x"]) for scan in scans]
    notes = [f"{sum(scan.invalid for scan in scans):,} points that were not measured are left out"]
    notes = notes if any(scan.invalid for scan in scans) else []
    moved = [_in_common_frame(scan) for scan in scans]
    columns: Columns = {}
    for name in names:
        lacking = sum(name not in part for part in moved)
        if lacking:
            notes.append(f"{lacking} of {len(scans)} scans have no {name!r}; their points have 0 or NaN instead")
        columns[name] = _join([part.get(name) for part in moved], lengths)
    columns[SCAN] = np.repeat(np.arange(len(scans), dtype=np.uint16 if len(scans) < 2**16 else np.uint32), lengths)
    extra = ScansExtra(tuple(scan.pose for scan in scans), details)
    source = replace(source, extra=extra, notes=tuple(notes))
    if any(scan.pose.translation.any() for scan in scans) or all(_is_raster(scan.columns) for scan in scans):
        source = replace(source, sensors=np.repeat([scan.pose.translation for scan in scans], lengths, axis=0))
    else:
        source = replace(source, viewpoint=AT_ORIGIN)
    return cloud_from_columns(columns, source, path)


def stream_of_scans(
    scans: Callable[[], Iterator[Scan]], source: Source, path: Path, details: Any = None
) -> CloudStream:
    """Join scans into a cloud that comes in pieces, as `cloud_from_scans`; one scan is in memory at a time.

    Args:
        scans: reads the file, which is done once for what all scans have in common, and then for the points.
        source, path, details: as for `cloud_from_scans`.

    Raises:
        InputError: as `cloud_from_scans`.
    """
    heads, points, on_rasters = [], 0, True
    for scan in scans():
        heads.append(scan._replace(columns={name: values[:0].copy() for name, values in scan.columns.items()}))
        points += len(scan.columns["x"])
        on_rasters &= _is_raster(scan.columns)
    empty = cloud_from_scans(heads, source, path, details)
    knows_sensors = on_rasters or empty.source.sensors is not None

    def pieces(rows: int) -> Iterator[Cloud]:
        for number, scan in enumerate(scans()):
            for start in range(0, len(scan.columns["x"]), rows):
                part = scan._replace(columns={n: values[start : start + rows] for n, values in scan.columns.items()})
                cloud = cloud_from_scans([*heads[:number], part, *heads[number + 1 :]], source, path, details)
                places = np.tile(scan.pose.translation, (len(cloud), 1)) if knows_sensors else None
                about = replace(cloud.source, sensors=places, viewpoint=None if knows_sensors else AT_ORIGIN)
                yield replace(cloud, source=about)
        if not points:
            yield empty

    return CloudStream(points, memory_of(next(pieces(1))), pieces)


def _is_raster(columns: Columns) -> bool:
    """Whether rows and columns are steps of elevation and azimuth around the origin, as a scanner makes them."""
    if "row" not in columns or "column" not in columns or len(columns["x"]) < _FEWEST_POINTS:
        return False
    x, y, z = (columns[name].astype(np.float64) for name in COORDINATES)
    elevation = np.arctan2(z, np.hypot(x, y))
    steps, index = np.unique(columns["column"], return_inverse=True)
    directions = np.exp(1j * np.arctan2(y, x))
    around = np.bincount(index, directions.real) + 1j * np.bincount(index, directions.imag)
    azimuth = np.unwrap(np.angle(around))  # of each column: a scan may go all the way round
    return _correlate(columns["row"], elevation) and _correlate(steps, azimuth)


def _correlate(steps: NDArray[Any], angles: NDArray[np.float64]) -> bool:
    steps = steps - steps.mean()
    angles = angles - angles.mean()
    size = np.sqrt((steps @ steps) * (angles @ angles))
    return bool(size > 0 and abs(steps @ angles) > _RASTER_CORRELATION * size)


def _in_common_frame(scan: Scan) -> Columns:
    moved = dict(scan.columns)
    for names, move in ((COORDINATES, scan.pose.to_global), (NORMALS, scan.pose.turn)):
        if all(name in moved for name in names) and scan.pose.is_moved:
            table = move(np.stack([moved[name] for name in names], axis=1).astype(np.float64))
            moved |= dict(zip(names, table.T, strict=True))
    return moved


def _join(parts: Sequence[NDArray[Any] | None], lengths: Sequence[int]) -> NDArray[Any]:
    dtype = np.result_type(*(part.dtype for part in parts if part is not None))
    blank = np.nan if dtype.kind == "f" else 0
    return np.concatenate(
        [
            np.full(count, blank, dtype) if part is None else part.astype(dtype, copy=False)
            for part, count in zip(parts, lengths, strict=True)
        ]
    )


def split_scans(cloud: Cloud) -> list[tuple[Pose, NDArray[np.int64]]]:
    """Find the poses and the rows of a cloud's scans; a cloud from another kind of file is one scan."""
    extra, scans = cloud.source.extra, cloud.attributes.get(SCAN)
    everything = np.arange(len(cloud))
    if isinstance(extra, ScansExtra) and scans is not None and scans.ndim == 1 and scans.dtype.kind in "iu":
        known = len(extra.poses)
        if not len(scans) or (scans.min() >= 0 and scans.max() < known):
            return [(pose, everything[scans == index]) for index, pose in enumerate(extra.poses)]
    viewpoint = cloud.source.viewpoint
    if viewpoint is None or not np.isfinite(viewpoint[:3]).all():
        return [(Pose(), everything)]
    return [(Pose(translation=np.array(viewpoint[:3])), everything)]


def rotation_of(quaternion: Sequence[float]) -> NDArray[np.float64]:
    """Turn a quaternion w x y z of any length but 0 into a rotation (3, 3); the identity for one of length 0."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64) / (np.linalg.norm(quaternion) or 1)
    if not any((w, x, y, z)):
        return np.eye(3)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn a rotation (3, 3) into its quaternion w x y z with w >= 0."""
    # eigenvector of Bar-Itzhack's matrix (2000), which is well-conditioned for every angle
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    found = np.linalg.eigh(matrix / 3)[1][:, -1]
    return np.asarray(found if found[0] >= 0 else -found)
