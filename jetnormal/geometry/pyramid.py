"""A cloud at several resolutions: an even finest level, then thinned levels of averaged positions.

Scanners sample in lines, and merged scans hold the same place many times. Nearest neighbors then tell of the sampling
and not of the surface. So the finest level leaves points out until it is even (`_even`), and what is found there is
carried to the points that were left out.

Everything is computed from distances between points, so that a rotated, moved, scaled or permuted cloud has the
rotated, moved, scaled or permuted pyramid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.moments import Moments, moments_of
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.support.compiled import compiled

NEIGHBORS = 16
PARENTS = 4
SPACING = 6  # a point and its SPACING nearest neighbors hold one point of the next level or more
LEAST_GROWTH = 0.1  # of the scale from level to level
AVERAGED = 8  # neighbors whose mean is the position of a point of the next level
LINE = 0.12  # ratio of the middle to the largest variance of the neighbors, below which they lie in a line
SAME = 0.02  # of the scale: points nearer than that are one place
PASSES = 4  # of thinning, at most: each leaves about a fifth of a line
LEAST_EVEN = 256  # points: a cloud is not thinned below

_Found = tuple[NDArray[np.int32], NDArray[np.float64]]  # neighbors and their distances, (n, 16) each


@dataclass(frozen=True)
class Neighborhood:
    """Points, each with neighbors among the points of a level.

    Attributes:
        positions: (n, 3) float64.
        neighbors: (n, k) int32 nearest points of the level, by ascending distance.
        scale: (n,) float32 root mean square distance of the neighbors; 1 for a single point.
        normals: (n, 3) float32 unit normals of the neighbors' planes, their signs arbitrary.
        variance: (n, 3) float32 variances of the neighbors along their principal axes, ascending, of sum 1.
        centroid: (n, 3) float32 mean offset of the neighbors, in units of `scale`.
    """

    positions: NDArray[np.float64]
    neighbors: NDArray[np.int32]
    scale: NDArray[np.float32]
    normals: NDArray[np.float32]
    variance: NDArray[np.float32]
    centroid: NDArray[np.float32]


@dataclass(frozen=True)
class Level(Neighborhood):
    """One resolution of a cloud; a point's 16 neighbors are other points, the farthest repeated where there are fewer.

    Attributes:
        chosen: (m,) int64 which points have a successor in the next level, in its order; empty in the last.
        parents: (n, 4) int32 points of the next level near each point, the nearest first, the last repeated.
    """

    chosen: NDArray[np.int64]
    parents: NDArray[np.int32]


@dataclass(frozen=True)
class Pyramid:
    """A cloud at several resolutions.

    Attributes:
        levels: the finest first.
        kept: (n,) int64 rows of the cloud that are the points of the finest level, ascending.
        left_out: (r,) int64 the other rows, ascending.
        carried: (r,) the points left out, each with its 16 nearest points of the finest level.
    """

    levels: list[Level]
    kept: NDArray[np.int64]
    left_out: NDArray[np.int64]
    carried: Neighborhood


def build_pyramid(points: NDArray[np.float64], levels: int, threads: int | None = None) -> Pyramid:
    """Thin a cloud to an even finest level, and this level by level to about a quarter.

    A level keeps a maximal set of points such that none is among the six nearest of another: it is even where the
    cloud is. Each point that is kept moves to the mean of itself and its eight nearest neighbors, which removes noise.

    Args:
        points: (N, 3) finite, different points, N >= 2.
        levels: number of levels.
        threads: for the neighbor search; None for all cores.
    """
    kept, index, found, moments = _even(points, threads)
    cloud, points = points, points[kept]
    pyramid: list[Level] = []
    for number in range(levels):
        if number:
            found = _other_neighbors(NeighborIndex(points, threads=threads), points)
            moments = moments_of(points, points, found[0])
        (neighbors, distances), (scale, normals, variance, centroid) = found, moments
        if pyramid:  # in a small level the same points may have been averaged twice
            scale = np.maximum(scale, LEAST_GROWTH * pyramid[-1].scale[pyramid[-1].chosen])
        last = number == levels - 1
        rank = np.argsort(_priority(distances), kind="stable")
        keep = np.zeros(len(points), dtype=np.bool_)
        if not last:
            _spread_out(neighbors, SPACING, rank, keep)
        chosen = np.flatnonzero(keep)
        parents = np.zeros((len(keep), PARENTS), np.int32)
        _find_parents(neighbors, keep, np.cumsum(keep, dtype=np.int32), parents)
        pyramid.append(Level(points, neighbors, scale, normals, variance, centroid, chosen, parents))
        if not last:
            nearest = points[neighbors[chosen, :AVERAGED]]
            points = (points[chosen] + nearest.sum(1)) / (1 + nearest.shape[1])
    left_out = np.setdiff1d(np.arange(len(cloud)), kept, assume_unique=True)
    return Pyramid(pyramid, kept, left_out, _neighborhood(cloud[left_out], pyramid[0], index))


def _even(points: NDArray[np.float64], threads: int | None) -> tuple[NDArray[np.int64], NeighborIndex, _Found, Moments]:
    """Leave points out where samples lie in lines or nearly coincide.

    A point whose neighbors lie in a line must not have another of the thinned cloud among its six nearest, and
    any point none nearer than SAME. A pass shortens the line that the neighbors make up to fivefold, so that
    after a few of them the neighbors come from the lines beside it as well.

    Returns:
        The rows of the points that are kept, ascending, their index, their neighbors and their moments.
    """
    kept = np.arange(len(points))
    index = NeighborIndex(points, threads=threads)
    neighbors, distances = _other_neighbors(index, points)
    moments = moments_of(points, points, neighbors)
    for _ in range(PASSES):
        scale, _, variance, _ = moments
        lined = variance[:, 1] < LINE * variance[:, 2]
        reach = np.where(lined, distances[:, SPACING - 1], SAME * scale)
        crowded = np.flatnonzero(distances[:, 0] <= reach)
        if len(kept) < LEAST_EVEN or not len(crowded):
            break
        order = crowded[np.argsort(_priority(distances[crowded]), kind="stable")]
        keep = np.ones(len(kept), dtype=np.bool_)
        _leave_out(neighbors, distances, reach, order, keep)
        kept = kept[keep]
        remaining = points[kept]
        index = NeighborIndex(remaining, threads=threads)
        neighbors, distances, stale = _without(index, remaining, keep, neighbors, distances)
        renewed = moments_of(remaining[stale], remaining, neighbors[stale])
        scale, normals, variance, centroid = (values[keep] for values in moments)
        for values, new in zip((scale, normals, variance, centroid), renewed, strict=True):
            values[stale] = new
        moments = scale, normals, variance, centroid
    return kept, index, (neighbors, distances), moments


@compiled
def _leave_out(
    neighbors: NDArray[np.int32],
    distances: NDArray[np.float64],
    reach: NDArray[np.float64],
    order: NDArray[np.int64],
    taken: NDArray[np.bool_],
) -> None:
    """Leave out points of this order of all that are taken: each that has a neighbor within its reach which stays."""
    for i in order:
        taken[i] = False
    for i in order:
        free = True
        for k in range(neighbors.shape[1]):
            if distances[i, k] > reach[i]:
                break
            free = free and not taken[neighbors[i, k]]
        taken[i] = free


def _without(
    index: NeighborIndex,
    points: NDArray[np.float64],
    keep: NDArray[np.bool_],
    neighbors: NDArray[np.int32],
    distances: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.int64]]:
    """The neighbors of the kept `points`, of this index, after others were left out, and which were asked for again."""
    number = np.cumsum(keep, dtype=np.int32) - np.int32(1)
    neighbors, distances = neighbors[keep], distances[keep]
    stale = np.flatnonzero(~keep[neighbors].all(axis=1))
    neighbors = number[neighbors]
    if len(stale):
        neighbors[stale], distances[stale] = _others_of(index, points, stale)
    return neighbors, distances, stale


def _neighborhood(points: NDArray[np.float64], level: Level, index: NeighborIndex) -> Neighborhood:
    """Points that are not in a level, with their neighbors there; the index is of the level."""
    k = min(NEIGHBORS, len(level.positions))
    if len(points):
        found, _ = index.query(points, k)
        neighbors = np.pad(found.astype(np.int32), ((0, 0), (0, NEIGHBORS - k)), mode="edge")
    else:
        neighbors = np.zeros((0, NEIGHBORS), np.int32)
    return Neighborhood(points, neighbors, *moments_of(points, level.positions, neighbors))


def _other_neighbors(index: NeighborIndex, points: NDArray[np.float64]) -> _Found:
    """(n, 16) nearest other points and their distances; where there are fewer, the farthest is repeated."""
    return _others_of(index, points, np.arange(len(points)))


def _others_of(index: NeighborIndex, points: NDArray[np.float64], rows: NDArray[np.int64]) -> _Found:
    """`_other_neighbors` of some rows of the points of an index."""
    k = min(NEIGHBORS + 1, len(points))
    found, distances = index.query(points[rows], k)
    neighbors = found.astype(np.int32)
    # averaged positions may coincide, and then another point may come before the point itself
    for row in np.flatnonzero(found[:, 0] != rows):
        at = np.flatnonzero(found[row] == rows[row])
        neighbors[row, 1 : at[0] + 1 if len(at) else 1] = found[row, : at[0] if len(at) else 0]
    neighbors, distances = neighbors[:, 1:], distances[:, 1:]
    missing = NEIGHBORS + 1 - k
    if missing or k == 1:
        if k == 1:
            return np.zeros((1, NEIGHBORS), np.int32), np.zeros((1, NEIGHBORS))
        neighbors = np.concatenate([neighbors, np.repeat(neighbors[:, -1:], missing, axis=1)], axis=1)
        distances = np.concatenate([distances, np.repeat(distances[:, -1:], missing, axis=1)], axis=1)
    return np.ascontiguousarray(neighbors), np.ascontiguousarray(distances)


def _priority(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) numbers in [0, 1) that look random and depend on ratios of distances alone."""
    last = distances[:, -1]
    ratio = distances.sum(axis=1) / np.where(last > 0, last, 1)
    return np.asarray((ratio * 997) % 1)


@compiled
def _spread_out(neighbors: NDArray[np.int32], spacing: int, order: NDArray[np.int64], taken: NDArray[np.bool_]) -> None:
    """Take the points in this order, each unless one of its nearest neighbors, so many, was taken before."""
    for i in order:
        free = True
        for k in range(min(spacing, neighbors.shape[1])):
            free = free and not taken[neighbors[i, k]]
        taken[i] = free


@compiled
def _find_parents(
    neighbors: NDArray[np.int32], keep: NDArray[np.bool_], count: NDArray[np.int32], parents: NDArray[np.int32]
) -> None:
    """Write the numbers, among the kept points, of those that are each point itself or its nearest neighbors.

    count (n,): how many of the points up to each are kept. parents (n, 4): zeros at first.
    """
    for i in range(len(keep)):
        found = 0
        if keep[i]:
            parents[i, 0] = count[i] - 1
            found = 1
        for j in neighbors[i]:
            if found < PARENTS and keep[j]:
                parents[i, found] = count[j] - 1
                found += 1
        for column in range(max(found, 1), PARENTS):
            parents[i, column] = parents[i, column - 1]
