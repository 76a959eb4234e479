"""Places in the empty space inside of a cloud's convex hull, and what they see of the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex, typical_spacing

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

STRAY_RADII = 6.0  # spacing of a stray point, over that of nine in ten
LARGEST_AREAS = 0.05  # of the points count as one area, that of the smallest of them
STRAYS = 0.005  # of the points may lie outside the box of places, on each side
CANDIDATES, PLACES = 600, 48
PLANES = 64  # at a time, which bounds the memory
OFF_HULL = 0.02  # of the hull's size: places on its faces are not inside
SIDE = 14  # pixels along the side of a picture; six pictures show all that is around a place
SLACK = 0.3  # of a pixel's width: a point this far behind the nearest one of its pixel is still seen
MIN_COSINE = 0.1  # a look along the surface shows nothing


def drawn_evenly(spacing: Floats, count: int) -> Ints:
    """Draw rows of points so that they are about as dense everywhere, none of them strays.

    This is the priority sampling of Duffield, Lund and Thorup (2007), with the area around a point as its weight.

    Args:
        spacing: (N,) distance between a point and its neighbors.
        count: of rows, or fewer.
    """
    area = np.minimum(spacing**2, np.quantile(spacing**2, 1 - LARGEST_AREAS))
    near = spacing <= STRAY_RADII * np.quantile(spacing, 0.9)
    chance = np.random.default_rng(0).random(len(spacing))
    rank = np.divide(chance, area, out=np.zeros(len(area)), where=area > 0)
    rows = np.argsort(np.where(near, rank, np.inf), kind="stable")[:count]
    return np.sort(rows[near[rows]])


@dataclass(frozen=True)
class Hull:
    """The convex hull of a cloud (N, 3)."""

    points: Floats

    @cached_property
    def _hull(self) -> Any:
        from scipy.spatial import ConvexHull, QhullError

        try:
            return ConvexHull(self.points)
        except QhullError:
            return None

    @property
    def flat(self) -> bool:
        """Whether all points lie in a plane, so that nothing is inside; then there is no size and no depth."""
        return self._hull is None

    @property
    def size(self) -> float:
        """The root of its area."""
        return float(np.sqrt(self._hull.area))

    def depth(self, places: Floats) -> Floats:
        """How far places (P, 3) lie below its nearest face (P,); negative outside."""
        outside = np.full(len(places), -np.inf)
        planes, homogeneous = self._hull.equations, np.vstack([places.T, np.ones(len(places))])
        for start in range(0, len(planes), PLANES):
            np.maximum(outside, (planes[start : start + PLANES] @ homogeneous).max(axis=0), out=outside)
        return -outside

    def places(self) -> Floats:
        """Find places inside (P, 3), from the half that is farther from all points; the middle if there is no room."""
        if self.flat:
            return self.points.mean(axis=0, keepdims=True)
        low, high = np.quantile(self.points, [STRAYS, 1 - STRAYS], axis=0)
        places = np.random.default_rng(1).uniform(low, high, (CANDIDATES, 3))
        places = places[self.depth(places) > OFF_HULL * self.size]
        if not len(places):
            return self.points.mean(axis=0, keepdims=True)
        distance = NeighborIndex(self.points).query(places, 1)[1][:, 0]
        clear = places[np.argsort(-distance, kind="stable")[: (len(places) + 1) // 2]]
        return clear[:: -(-len(clear) // PLACES)]


def principal_axes(points: Floats) -> Floats:
    """Find axes (3, 3), in columns, that turn with a cloud (N, 3): in them, it looks alike however it lies."""
    offsets = points - points.mean(axis=0)
    axes = np.linalg.eigh(np.einsum("ni,nj->ij", offsets, offsets))[1]
    turned = offsets @ axes
    return np.asarray(axes * np.where((turned**3).sum(axis=0) < 0, -1.0, 1.0))


def look_from(place: Floats, points: Floats, normals: Floats, spacing: float) -> Floats:
    """Look around from a place: no other point in the same pixel of a cube around it hides a point that it sees.

    Args:
        place: (3,).
        points, normals: (N, 3).
        spacing: of the points.

    Returns:
        The cosine between each normal and the direction to the place (N,), 0 where it is not seen.
    """
    sights = place - points
    distance = np.maximum(np.sqrt(np.square(sights).sum(axis=1)), 1e-300)
    face = np.abs(sights).argmax(axis=1)
    rows = np.arange(len(sights))
    depth = np.maximum(np.abs(sights[rows, face]), 1e-300)
    pixel = 2 * face + (sights[rows, face] > 0)
    for turn in (1, 2):
        across = (sights[rows, (face + turn) % 3] / depth + 1) / 2 * SIDE
        pixel = pixel * SIDE + np.minimum(across.astype(np.int64), SIDE - 1)
    nearest = np.full(6 * SIDE**2, np.inf)
    np.minimum.at(nearest, pixel, distance)
    slack = np.maximum(SLACK * 2 / SIDE * distance, 2 * spacing)
    cosine = (sights * normals).sum(axis=1) / distance
    seen = (distance <= nearest[pixel] + slack) & (np.abs(cosine) > MIN_COSINE)
    return np.where(seen, cosine, 0.0)


def seen_from_inside(points: Floats, normals: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Sum what places see of points that are evenly dense.

    Args:
        points, normals: (N, 3).
        places: (P, 3).

    Returns:
        For each point (N,), the sums over the places that see it of the cosine between its normal and the direction to
        the place, and of the cosine's size.
    """
    spacing = typical_spacing(points)
    cosines = np.stack([look_from(place, points, normals, spacing) for place in places])
    return cosines.sum(axis=0), np.abs(cosines).sum(axis=0)
