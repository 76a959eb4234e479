"""How the density of a cloud tells where its sensors stood.

A sensor sees surface at a distance r, at an angle a to its normal, with a density that goes as cos(a) / r^2. So the
spacing of points tells how well a place, or a sum of places, explains what was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import DISK, NeighborIndex, distinct, typical_spacing
from jetnormal.geometry.parts import far_apart
from jetnormal.geometry.vectors import unit
from jetnormal.orientation.places import STRAY_RADII, drawn_evenly, principal_axes
from jetnormal.orientation.visibility import directions

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DRAWN, KEPT = 24_000, 4_000  # points that are drawn, and those of them that are evenly dense
PATCHES = 100  # of these, in each of which chance makes little of the mean density
MIN_POINTS = 200
CONNECTED = 0.25  # of the points hang together at least, as walls and floors do; many objects beside each other do not
FAR_AWAY = (1.1, 2.0, 5.0)  # distances of places outside from the middle, over that of the farthest point
NEAR_AND_FAR = (0.5, 0.8, *FAR_AWAY)  # the same for places at one side
AHEAD = 0.5  # cosine to the middle of a side
EXTREME = 0.02  # of the points, in each tail of their spacings, count as the last of the others
LARGEST = 0.1  # of their areas count as the smallest of these
NEAREST, STEEPEST = 0.05, 0.1  # distance over the hull's size, and cosine: less counts as this
NEAREST_GIVEN = 0.03  # the same for what sensors give
LEAST_MISFIT = 0.01


@dataclass(frozen=True)
class Sample:
    """Some points of a cloud.

    Attributes:
        points: (n, 3).
        normals: (n, 3) unit normals.
        spacing: (n,) radii of their neighborhoods.
        part: (n,) number of the connected part that each belongs to.
    """

    points: Floats
    normals: Floats
    spacing: Floats
    part: NDArray[np.int64]

    @cached_property
    def typical(self) -> float:
        """Distance of neighboring points, typically."""
        return typical_spacing(self.points)

    @cached_property
    def contrast(self) -> _Spacing:
        """How dense the sample is where, as a logarithm."""
        return _Spacing.of(self)

    def taken(self, rows: NDArray[np.int64]) -> Sample:
        """Take some rows."""
        return Sample(self.points[rows], self.normals[rows], self.spacing[rows], self.part[rows])


def draw(points: Floats, normals: Floats) -> tuple[Sample, Sample] | None:
    """Draw points with a direction, none of them strays, in a frame that turns with the cloud.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) unit vectors; 0 where there is no direction.

    Returns:
        Points in random order, as dense as they are, and some of them that are about as dense everywhere; None if too
        few points hang together.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    rows = np.flatnonzero(normals.any(axis=1))
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:DRAWN]]
    rows = rows[np.sort(distinct(points[rows])[0])]
    together = far_apart(points[rows])[0]
    if len(together) < MIN_POINTS:
        return None
    points, normals = points[rows[together]], normals[rows[together]]
    neighbors, distances = NeighborIndex(points).query(points, DISK + 1)
    graph = csr_matrix((np.ones(neighbors.size), neighbors.ravel(), np.arange(len(points) + 1) * (DISK + 1)))
    part = connected_components(graph, directed=False)[1]
    if np.bincount(part).max() < CONNECTED * len(rows):
        return None
    spacing = distances[:, -1]
    near = spacing <= STRAY_RADII * np.quantile(spacing, 0.9)
    points, normals, spacing, part = points[near], normals[near], spacing[near], part[near]
    even = drawn_evenly(spacing, KEPT)
    frame = principal_axes(points[even])
    drawn = Sample((points - np.median(points[even], axis=0)) @ frame, normals @ frame, spacing, part)
    return drawn, drawn.taken(even)


def places_around(points: Floats, toward: Floats | None = None, distances: tuple[float, ...] = FAR_AWAY) -> Floats:
    """Return places (P, 3) in some directions from the middle of points, at each of some distances.

    Args:
        points: (n, 3).
        toward: (K, 3) directions; all of them by default.
        distances: over that of the farthest point.
    """
    toward = directions() if toward is None else toward
    middle = points.mean(axis=0)
    reach = np.linalg.norm(points - middle, axis=1).max()
    return np.concatenate([middle + toward * reach * share for share in distances])


@dataclass(frozen=True)
class _Spacing:
    """The logarithm of the spacing of points (n,), less its mean in each part, with weights.

    What is compared with it is centered alike: a cavity may be sampled more densely than what is around it.
    """

    weight: Floats
    part: NDArray[np.int64]
    logarithm: Floats

    @classmethod
    def of(cls, sample: Sample) -> _Spacing:
        weight = np.minimum(sample.spacing**2, np.quantile(sample.spacing**2, 1 - LARGEST))
        part = np.unique(sample.part, return_inverse=True)[1]
        logarithm = np.log(sample.spacing)
        clipped = np.clip(logarithm, *np.quantile(logarithm, [EXTREME, 1 - EXTREME]))
        return cls(weight, part, cls(weight, part, clipped).centered(clipped))

    def centered(self, values: Floats) -> Floats:
        """Values (n,) less their mean in each part."""
        return values - (np.bincount(self.part, self.weight * values) / np.bincount(self.part, self.weight))[self.part]

    @property
    def variance(self) -> float:
        return max(float((self.weight * self.logarithm**2).sum()), 1e-12)


def best_fit(sample: Sample, places: Floats, size: float) -> tuple[float, float]:
    """Find how the best of the places (P, 3) explains the logarithm of spacing: share of its variance, and slope."""
    spacing = sample.contrast
    best = (0.0, 0.0)
    for place in places:
        distance, cosine = _sight(sample.points, sample.normals, place)
        asked = np.log(np.maximum(distance, NEAREST * size)) - np.log(np.maximum(cosine, STEEPEST)) / 2
        asked = spacing.centered(asked)
        power = max(float((spacing.weight * asked**2).sum()), 1e-300)
        slope = max(float((spacing.weight * asked * spacing.logarithm).sum()) / power, 0.0)
        best = max(best, (slope**2 * power / spacing.variance, min(slope, 1.0)))
    return best


def behind(sample: Sample, size: float) -> float:
    """Find how much more of the variance of the logarithm of spacing places at the back explain than those in front."""
    axis = unit(sample.normals.mean(axis=0), np.array([0.0, 0, 1]))
    toward = directions()[directions() @ axis > AHEAD]
    front, back = (
        best_fit(sample, places_around(sample.points, side * toward, NEAR_AND_FAR), size)[0] for side in (1, -1)
    )
    return back - front


def gradient_fit(sample: Sample) -> float:
    """Find the share of the variance of the logarithm of spacing that a gradient explains."""
    spacing = sample.contrast
    root = np.sqrt(spacing.weight)
    axes = np.stack([root * spacing.centered(axis) for axis in sample.points.T], axis=1)
    found = root * spacing.logarithm
    rest = found - axes @ np.linalg.lstsq(axes, found, rcond=1e-9)[0]
    return 1 - float((rest**2).sum()) / spacing.variance


def misfit(sample: Sample, places: Floats, seen: Bools, size: float) -> float:
    """Find how far the mean densities of patches are from the best sum of what sensors at places (P, 3) give.

    Args:
        seen: (P, n) what each place sees.

    Returns:
        The logarithm of the relative error.
    """
    from scipy.optimize import nnls
    from scipy.sparse import csr_matrix

    if not len(sample.points):
        return 0.0
    spacing = np.clip(sample.spacing, *np.quantile(sample.spacing, [EXTREME, 1 - EXTREME]))
    area = (spacing / np.median(sample.spacing)) ** 2
    given = np.empty((len(area), len(places)))
    for k, place in enumerate(places):
        distance, cosine = _sight(sample.points, sample.normals, place)
        given[:, k] = seen[k] * cosine / np.maximum(distance / size, NEAREST_GIVEN) ** 2 * area
    patch = NeighborIndex(sample.points[:PATCHES]).query(sample.points, 1)[0][:, 0]
    count = np.bincount(patch, minlength=PATCHES)
    share = 1 / np.sqrt(count[patch] * len(patch))  # the mean of each patch, times the root of its share of the points
    means = csr_matrix((share, (patch, np.arange(len(patch)))), (PATCHES, len(patch))) @ given
    means = means[:, means.any(axis=0)]
    try:
        error = float(nnls(means, np.sqrt(count / len(patch)))[1]) if means.size else 1.0
    except RuntimeError:  # it did not converge
        error = 1.0
    return float(np.log(max(error, LEAST_MISFIT)))


def _sight(points: Floats, normals: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) of points from a place, and the cosines (n,) between their normals and the line of sight."""
    sights = place - points
    distance = np.maximum(np.sqrt(np.square(sights).sum(axis=1)), 1e-300)
    return distance, np.abs((sights * normals).sum(axis=1)) / distance
