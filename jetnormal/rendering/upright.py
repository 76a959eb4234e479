"""Which way is up, told from the shape of a cloud or a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SAMPLE = 20_000  # points that are looked at
FLAT = 0.35  # height of a landscape, over its shorter side, at most
TALL = 2.5  # height of a pole, over its longer side, at least
VIEW_CONE = 0.9  # tangent of half the field of view of a depth camera, at most
NEAREST = 0.3  # distance of what a depth camera sees, in sizes of the scene, at least
FARTHEST = 30.0
BASE = 0.02  # height of the slab that holds the base of a standing object, over its height
BASE_LEAST = 0.02  # share of the points that the base of a standing object has, more than its top
BASE_RATIO = 1.5  # by which the base along y has more points than that along z where y is up


def guess_up(points: Floats) -> Floats:
    """Guess the direction (3,) that is up in the coordinates of points (N, 3), one of the axes.

    A depth camera looks along z with y down; a landscape is flat; an object stands on its base, along z or y. Where
    nothing tells, z is up.
    """
    points = points[:: max(1, len(points) // SAMPLE)]
    extent = np.percentile(points, 99, axis=0) - np.percentile(points, 1, axis=0)
    if _seen_by_camera(points, float(extent.max())):
        return np.array([0.0, -1.0, 0.0])
    flattest = int(np.argmin(extent))
    if extent[flattest] < FLAT * np.sort(extent)[1]:
        return np.eye(3)[flattest]
    if extent[2] > TALL * np.sort(extent)[1]:
        return np.eye(3)[2]
    base_y, base_z = (_base(points[:, axis]) for axis in (1, 2))
    return np.eye(3)[1] if base_y > max(BASE_LEAST, BASE_RATIO * base_z) else np.eye(3)[2]


def _seen_by_camera(points: Floats, size: float) -> bool:
    """Whether the points lie in the cone that a camera at the origin sees along z."""
    depth = points[:, 2]
    inside = (np.abs(points[:, :2]) < VIEW_CONE * depth[:, None]).all(axis=1)
    return bool(inside.mean() > 0.99 and NEAREST * size < np.median(depth) < FARTHEST * size)


def _base(heights: Floats) -> float:
    """The share of heights (N,) in the lowest slab, and more than in the highest one."""
    low, high = heights.min(), heights.max()
    slab = BASE * max(high - low, 1e-300)
    return float((heights < low + slab).mean() - (heights > high - slab).mean())
