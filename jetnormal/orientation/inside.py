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

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation import density
from jetnormal.orientation.places import Hull
from jetnormal.orientation.visibility import PIXEL_SPACINGS, axes_across, below_topmost, directions

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

BELOW_SPACINGS, BELOW_SIZE = 3.0, 0.02  # what lies deeper under the hull's faces lies below it
MIN_BELOW = 20  # points, or there is nothing below
DEEP = 0.06  # of the hull's size
ALONG, ACROSS = 0.97, 0.17  # cosines to a direction
BINS, BIN_COSINE = 200, 0.95  # of directions
LEAST_COSINE = 0.3  # a look along the surface tells nothing
SLACK, SLOPE_SLACK = 0.21, 0.7  # of a pixel, and as often its slope: a point so far below the topmost one is still seen
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
    samples = density.draw(points, normals)
    if samples is None:
        return None
    drawn, even = samples
    hull = Hull(even.points)
    if hull.flat:
        return None
    size = hull.size
    around, sights = density.places_around(even.points), directions()
    seen = np.stack([_seen_along(sight, even) for sight in sights])
    visible = seen.any(axis=0)
    exposure = (seen * np.abs(sights @ even.normals.T)).mean(axis=0)
    some = drawn.taken(np.arange(min(density.KEPT, len(drawn.points))))
    depth = hull.depth(even.points)
    below = depth > max(BELOW_SPACINGS * even.typical, BELOW_SIZE * size)
    level, upright, square = _level_upright_and_square(even.normals)
    return Evidence(
        open=is_open,
        slope=density.best_fit(some, hull.places(), size)[1],
        from_outside=max(density.best_fit(some, around, size)[0], density.gradient_fit(some)),
        misfit=density.misfit(
            even.taken(np.flatnonzero(visible)), around, np.tile(seen[:, visible], (len(density.FAR_AWAY), 1)), size
        ),
        exposed=_exposed(exposure, below),
        hidden=float(np.sqrt(min((_reaching(below, even.part) & ~visible).mean(), MOST_HIDDEN))),
        deep=float((depth > DEEP * size).mean()),
        level=level,
        upright=upright,
        square=square,
        behind=density.behind(some, size) if is_open else 0.0,
    )


def _seen_along(sight: Floats, sample: density.Sample) -> Bools:
    """Which points (n,) someone far away in a direction (3,) sees."""
    pixel = PIXEL_SPACINGS * sample.typical
    cosine = np.abs(sample.normals @ sight)
    steepness = np.sqrt(1 - np.minimum(cosine**2, 1)) / np.maximum(cosine, LEAST_COSINE)
    seen = below_topmost(sample.points, sight, pixel) <= (SLACK + SLOPE_SLACK * steepness) * pixel
    return np.asarray(seen & (cosine > LEAST_COSINE))


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
