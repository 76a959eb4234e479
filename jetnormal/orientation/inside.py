"""Whether a cloud was scanned from inside, as rooms and streets are, or from outside, as objects are.

Nothing in a wall tells from which side it was seen. What tells is the cloud as a whole:

* Density: a sensor sees surface at a distance r, at an angle a to its normal, with a density that goes as cos(a) / r^2.
  So the density tells where a sensor may have stood: inside of the cloud's convex hull or outside.
  Outside, a sum of sensors explains how dense an object is; of a room, hardly any does.
* What lies below the faces of the hull: of an object, it can be seen from outside; in a room, walls hide it. The wall
  of a cavity is hidden as well, but hangs together with nothing else, while furniture stands on the floor.
* How much of the surface is level, upright, and square to other upright surface.

None of them decides alone. Two logistic regressions weigh them, one for closed surfaces and one for open ones. They
were fitted to simulated scans of rooms, flats and streets, and to clouds of objects, many of them hollow;
`benchmarks/inside.py` fits them again, and measures them on other clouds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import DISK, NeighborIndex, distinct, typical_spacing
from jetnormal.geometry.parts import far_apart
from jetnormal.geometry.vectors import unit
from jetnormal.orientation.places import STRAY_RADII, Hull, drawn_evenly, principal_axes
from jetnormal.orientation.visibility import PIXEL_SPACINGS, axes_across, below_topmost, directions

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DRAWN, KEPT = 24_000, 4_000  # points that are drawn, and those of them that are evenly dense
PATCHES = 100  # of these, in each of which chance makes little of the mean density
MIN_POINTS = 200
CONNECTED = 0.25  # of the points hang together at least, as walls and floors do; many objects beside each other do not
BELOW_SPACINGS, BELOW_SIZE = 3.0, 0.02  # what lies deeper under the hull's faces lies below it
MIN_BELOW = 20  # points, or there is nothing below
DEEP = 0.06  # of the hull's size
FAR_AWAY = (1.1, 2.0, 5.0)  # distances of places outside from the middle, over that of the farthest point
NEAR_AND_FAR = (0.5, 0.8, *FAR_AWAY)  # the same for places at one side
AHEAD = 0.5  # cosine to the middle of a side
EXTREME = 0.02  # of the points, in each tail of their spacings, count as the last of the others
LARGEST = 0.1  # of their areas count as the smallest of these
ALONG, ACROSS = 0.97, 0.17  # cosines to a direction
BINS, BIN_COSINE = 200, 0.95  # of directions
NEAREST, STEEPEST = 0.05, 0.1  # distance over the hull's size, and cosine: less counts as this
NEAREST_GIVEN = 0.03  # the same for what sensors give
LEAST_COSINE = 0.3  # a look along the surface tells nothing
SLACK, SLOPE_SLACK = 0.21, 0.7  # of a pixel, and as often its slope: a point so far below the topmost one is still seen
LEAST_MISFIT = 0.01
MOST_HIDDEN = 0.02  # share of the points; parts of an object that overlap hide more
MOST_SQUARE = 0.35  # share of points; only boxes have more, furniture stands at any angle
AT_HULL = 0.02  # of the points at the hull belong to a part that reaches it
# Of `Evidence`, for closed surfaces and for open ones. The constants hold the prior probability of a scan from inside,
# 1/12.
CLOSED = {"slope": 5.43, "from_outside": -3.2, "misfit": 3.71, "hidden": 8.21, "deep": -4.27, "square": 13.04}
OPEN = {
    "slope": 2.83,
    "from_outside": -2.35,
    "misfit": 1.36,
    "exposed": -4.6,
    "level": 3.04,
    "upright": -3.55,
    "square": 11.47,
    "behind": 4.79,
}
OF_CLOSED, OF_OPEN = -1.26, 1.2  # constants


@dataclass(frozen=True)
class Evidence:
    """What tells scans from inside and from outside apart. Shares are of the points.

    Attributes:
        open: whether the surfaces have no outside.
        slope: of the logarithm of the spacing over what the best place inside asks for; 1 if a sensor stood there.
        from_outside: the share of the variance of that logarithm that the best place outside explains, or a gradient.
        misfit: logarithm of the relative error of the density as a sum of what sensors outside would give, where these
            see anything.
        exposed: how much is seen from outside of what lies below the hull, over what is seen of the rest.
        hidden: root of the share that nobody outside sees and that hangs together with what is at the hull, up to a
            bound. The wall of a cavity does not, while what stands in a room stands on its floor.
        deep: share that lies deep below the hull.
        level: share that faces in the commonest direction or against it.
        upright: share at a right angle to that direction.
        square: upright share, times how nearly all of it faces along two directions at a right angle.
        behind: how much more of the variance of the logarithm of spacing places at the backs of open surfaces explain
            than places at their fronts; 0 for closed ones.
    """

    open: bool
    slope: float
    from_outside: float
    misfit: float
    exposed: float
    hidden: float
    deep: float
    level: float
    upright: float
    square: float
    behind: float

    @property
    def probability(self) -> float:
        """That the cloud was scanned from inside."""
        weights, constant = (OPEN, OF_OPEN) if self.open else (CLOSED, OF_CLOSED)
        score = constant + sum(weight * getattr(self, name) for name, weight in weights.items())
        return float(1 / (1 + np.exp(-score)))


def find_evidence(points: Floats, normals: Floats, is_open: bool) -> Evidence | None:
    """Look at a cloud from inside and outside; None if too few points hang together, or all lie in a plane.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) unit vectors, whose signs tell the fronts of open surfaces, and nothing of closed ones; 0 where
            there is no direction.
        is_open: whether the surfaces have no outside (`methods.Orientation`).
    """
    samples = _drawn(points, normals)
    if samples is None:
        return None
    drawn, even = samples
    hull = Hull(even.points)
    if hull.flat:
        return None
    size = hull.size
    around, sights = _places_around(even.points), directions()
    seen = np.stack([_seen_along(sight, even) for sight in sights])
    visible = seen.any(axis=0)
    exposure = (seen * np.abs(sights @ even.normals.T)).mean(axis=0)
    some = drawn.taken(np.arange(min(KEPT, len(drawn.points))))
    depth = hull.depth(even.points)
    below = depth > max(BELOW_SPACINGS * even.typical, BELOW_SIZE * size)
    level, upright, square = _level_upright_and_square(even.normals)
    return Evidence(
        open=is_open,
        slope=_best_fit(some, hull.places(), size)[1],
        from_outside=max(_best_fit(some, around, size)[0], _gradient_fit(some)),
        misfit=_misfit(
            even.taken(np.flatnonzero(visible)), around, np.tile(seen[:, visible], (len(FAR_AWAY), 1)), size
        ),
        exposed=_exposed(exposure, below),
        hidden=float(np.sqrt(min((_reaching(below, even.part) & ~visible).mean(), MOST_HIDDEN))),
        deep=float((depth > DEEP * size).mean()),
        level=level,
        upright=upright,
        square=square,
        behind=_behind(some, size) if is_open else 0.0,
    )


@dataclass(frozen=True)
class _Sample:
    """Points (n, 3), their unit normals (n, 3), the radii (n,) of their neighborhoods, and the part (n,) of each."""

    points: Floats
    normals: Floats
    spacing: Floats
    part: NDArray[np.int64]

    @cached_property
    def typical(self) -> float:
        return typical_spacing(self.points)

    def taken(self, rows: NDArray[np.int64]) -> _Sample:
        return _Sample(self.points[rows], self.normals[rows], self.spacing[rows], self.part[rows])


def _drawn(points: Floats, normals: Floats) -> tuple[_Sample, _Sample] | None:
    """Draw points with a direction, none of them strays, in a frame that turns with the cloud.

    Returns:
        Points in random order, as dense as they are, and some of them that are about as dense everywhere.
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
    drawn = _Sample((points - np.median(points[even], axis=0)) @ frame, normals @ frame, spacing, part)
    return drawn, drawn.taken(even)


def _places_around(points: Floats) -> Floats:
    """Places outside (P, 3): in all directions, near and far."""
    middle = points.mean(axis=0)
    reach = np.linalg.norm(points - middle, axis=1).max()
    return np.concatenate([middle + directions() * reach * share for share in FAR_AWAY])


def _seen_along(sight: Floats, sample: _Sample) -> Bools:
    """Which points (n,) someone far away in a direction (3,) sees."""
    pixel = PIXEL_SPACINGS * sample.typical
    cosine = np.abs(sample.normals @ sight)
    steepness = np.sqrt(1 - np.minimum(cosine**2, 1)) / np.maximum(cosine, LEAST_COSINE)
    seen = below_topmost(sample.points, sight, pixel) <= (SLACK + SLOPE_SLACK * steepness) * pixel
    return np.asarray(seen & (cosine > LEAST_COSINE))


@dataclass(frozen=True)
class _Spacing:
    """The logarithm of the spacing of points (n,), less its mean in each part, with weights.

    What is compared with it is centered alike: a cavity may be sampled more densely than what is around it.
    """

    weight: Floats
    part: NDArray[np.int64]
    logarithm: Floats

    @classmethod
    def of(cls, sample: _Sample) -> _Spacing:
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


def _best_fit(sample: _Sample, places: Floats, size: float) -> tuple[float, float]:
    """How the best of the places (P, 3) explains the logarithm of spacing: share of its variance, and slope."""
    spacing = _Spacing.of(sample)
    best = (0.0, 0.0)
    for place in places:
        distance, cosine = _sight(sample.points, sample.normals, place)
        asked = np.log(np.maximum(distance, NEAREST * size)) - np.log(np.maximum(cosine, STEEPEST)) / 2
        asked = spacing.centered(asked)
        power = max(float((spacing.weight * asked**2).sum()), 1e-300)
        slope = max(float((spacing.weight * asked * spacing.logarithm).sum()) / power, 0.0)
        best = max(best, (slope**2 * power / spacing.variance, min(slope, 1.0)))
    return best


def _behind(sample: _Sample, size: float) -> float:
    """How much more of the variance of the logarithm of spacing places at the back explain than those in front."""
    axis = unit(sample.normals.mean(axis=0), np.array([0.0, 0, 1]))
    middle = sample.points.mean(axis=0)
    toward = directions()[directions() @ axis > AHEAD]
    reach = np.linalg.norm(sample.points - middle, axis=1).max()
    offsets = np.concatenate([toward * reach * share for share in NEAR_AND_FAR])
    front, back = (_best_fit(sample, middle + side * offsets, size)[0] for side in (1, -1))
    return back - front


def _gradient_fit(sample: _Sample) -> float:
    """The share of the variance of the logarithm of spacing that a gradient explains."""
    spacing = _Spacing.of(sample)
    root = np.sqrt(spacing.weight)
    axes = np.stack([root * spacing.centered(axis) for axis in sample.points.T], axis=1)
    found = root * spacing.logarithm
    rest = found - axes @ np.linalg.lstsq(axes, found, rcond=1e-9)[0]
    return 1 - float((rest**2).sum()) / spacing.variance


def _misfit(sample: _Sample, places: Floats, seen: Bools, size: float) -> float:
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


def _exposed(exposure: Floats, below: Bools) -> float:
    """How much is seen of the points below the hull, over what is seen of the others; 1 if there is nothing below.

    Args:
        exposure: (n,) mean over far places of the cosine to the normal, 0 for those that do not see the point.
        below: (n,) which points lie below the hull.
    """
    if below.sum() <= MIN_BELOW or below.all():
        return 1.0
    return float(exposure[below].mean() / max(exposure[~below].mean(), 1e-9))


def _reaching(below: Bools, part: NDArray[np.int64]) -> Bools:
    """Which points (n,) belong to parts (n,) that reach the hull; all, if none lies at it."""
    if below.all():
        return np.ones(len(below), dtype=np.bool_)
    at_hull = np.bincount(part[~below], minlength=int(part.max()) + 1) / (~below).sum()
    return np.asarray(at_hull[part] > AT_HULL)


def _level_upright_and_square(normals: Floats) -> tuple[float, float, float]:
    """The shares of unit normals (n, 3) that lie along the commonest direction, and at a right angle to it.

    The third is the length of the sum of unit vectors at four times the angle of the upright ones around it.
    """
    bins = directions(BINS)[: BINS // 2]
    axis = bins[(np.abs(normals @ bins.T) > BIN_COSINE).sum(axis=0).argmax()]
    near = normals[np.abs(normals @ axis) > BIN_COSINE]
    if len(near):
        axis = np.linalg.eigh(np.einsum("ni,nj->ij", near, near))[1][:, 2]
    cosine = np.abs(normals @ axis)
    upright = normals[cosine < ACROSS]
    side, other, _ = axes_across(axis)
    around = np.arctan2(upright @ other, upright @ side)
    square = min(float(np.abs(np.exp(4j * around).sum())) / len(normals), MOST_SQUARE)
    return float((cosine > ALONG).mean()), len(upright) / len(normals), square
