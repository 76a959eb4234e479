"""A cloud at several resolutions: thinned levels of averaged positions, their neighbor lists, normals and scales.

Everything is computed from distances between points, so that a rotated, moved, scaled or permuted cloud has the
rotated, moved, scaled or permuted pyramid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.support.compiled import compiled

NEIGHBORS = 16
PARENTS = 4
SPACING = 6  # a point and its SPACING nearest neighbors hold one point of the next level or more
LEAST_GROWTH = 0.1  # of the scale from level to level
AVERAGED = 8  # neighbors whose mean is the position of a point of the next level


@dataclass(frozen=True)
class Level:
    """One resolution of a cloud.

    Attributes:
        positions: (n, 3) float64.
        neighbors: (n, 16) int32 nearest other points of the level, by ascending distance; where there are fewer, the
            farthest is repeated.
        scale: (n,) float32 root mean square distance of the neighbors; 1 for a single point.
        normals: (n, 3) float32 unit normals of the neighbors' planes, their signs arbitrary.
        variance: (n, 3) float32 variances of the neighbors along their principal axes, ascending, of sum 1.
        centroid: (n, 3) float32 mean offset of the neighbors, in units of `scale`.
        chosen: (m,) int64 which points have a successor in the next level, in its order; empty in the last.
        parents: (n, 4) int32 points of the next level near each point, the nearest first, the last repeated.
    """

    positions: NDArray[np.float64]
    neighbors: NDArray[np.int32]
    scale: NDArray[np.float32]
    normals: NDArray[np.float32]
    variance: NDArray[np.float32]
    centroid: NDArray[np.float32]
    chosen: NDArray[np.int64]
    parents: NDArray[np.int32]


def build_pyramid(points: NDArray[np.float64], levels: int, threads: int | None = None) -> list[Level]:
    """Thins a cloud level by level to about a quarter.

    A level keeps a maximal set of points such that none is among the eight nearest of another: it is even where the
    cloud is. Each point that is kept moves to the mean of itself and its eight nearest neighbors, which removes noise.

    Args:
        points: (N, 3) finite, different points, N >= 2.
        levels: number of levels; the first is the cloud.
        threads: for the neighbor search; None for all cores.
    """
    pyramid: list[Level] = []
    for number in range(levels):
        neighbors, distances = _other_neighbors(points, threads)
        scale, normals, variance, centroid = _moments(points, neighbors)
        if pyramid:  # in a small level the same points may have been averaged twice
            scale = np.maximum(scale, LEAST_GROWTH * pyramid[-1].scale[pyramid[-1].chosen])
        last = number == levels - 1
        rank = np.argsort(_priority(distances), kind="stable")
        keep = np.zeros(len(points), dtype=np.bool_) if last else _spread_out(neighbors[:, :SPACING], rank)
        chosen = np.flatnonzero(keep)
        parents = _parents(neighbors, keep)
        pyramid.append(Level(points, neighbors, scale, normals, variance, centroid, chosen, parents))
        if not last:
            nearest = points[neighbors[chosen, :AVERAGED]]
            points = (points[chosen] + nearest.sum(1)) / (1 + nearest.shape[1])
    return pyramid


def _other_neighbors(points: NDArray[np.float64], threads: int | None) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """(n, 16) nearest other points and their distances; where there are fewer, the farthest is repeated."""
    k = min(NEIGHBORS + 1, len(points))
    found, distances = NeighborIndex(points, threads=threads).query(points, k)
    neighbors = found.astype(np.int32)
    # averaged positions may coincide, and then another point may come before the point itself
    for row in np.flatnonzero(found[:, 0] != np.arange(len(points))):
        at = np.flatnonzero(found[row] == row)
        neighbors[row, 1 : at[0] + 1 if len(at) else 1] = found[row, : at[0] if len(at) else 0]
    neighbors, distances = neighbors[:, 1:], distances[:, 1:]
    missing = NEIGHBORS + 1 - k
    if missing or k == 1:
        if k == 1:
            return np.zeros((1, NEIGHBORS), np.int32), np.zeros((1, NEIGHBORS))
        neighbors = np.concatenate([neighbors, np.repeat(neighbors[:, -1:], missing, axis=1)], axis=1)
        distances = np.concatenate([distances, np.repeat(distances[:, -1:], missing, axis=1)], axis=1)
    return np.ascontiguousarray(neighbors), distances


def _priority(distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) numbers in [0, 1) that look random and depend on ratios of distances alone."""
    last = distances[:, -1]
    ratio = distances.sum(axis=1) / np.where(last > 0, last, 1)
    return np.asarray((ratio * 997) % 1)


@compiled
def _spread_out(neighbors: NDArray[np.int32], order: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Takes the points in this order, each unless one of its neighbors was taken before."""
    taken = np.zeros(len(order), np.bool_)
    for i in order:
        free = True
        for j in neighbors[i]:
            free = free and not taken[j]
        taken[i] = free
    return taken


@compiled
def _parents(neighbors: NDArray[np.int32], keep: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(n, 4) numbers among the kept points of those that are the point itself or its nearest neighbors."""
    number = np.cumsum(keep).astype(np.int32) - np.int32(1)
    parents = np.zeros((len(keep), PARENTS), np.int32)
    for i in range(len(keep)):
        count = 0
        if keep[i]:
            parents[i, 0] = number[i]
            count = 1
        for j in neighbors[i]:
            if count < PARENTS and keep[j]:
                parents[i, count] = number[j]
                count += 1
        for column in range(max(count, 1), PARENTS):
            parents[i, column] = parents[i, column - 1]
    return parents


@compiled
def _principal(m: NDArray[np.float64], values: NDArray[np.float64], normal: NDArray[np.float64]) -> None:
    """Ascending eigenvalues of a symmetric (3, 3) matrix of trace about 1, and a unit eigenvector of the smallest.

    The largest eigenvalue is by the trigonometric solution of the cubic (Smith, 1961); the vector is the longest cross
    product of two rows of m - value I, all of which are orthogonal to it.
    """
    mean = (m[0, 0] + m[1, 1] + m[2, 2]) / 3
    a, b, c = m[0, 0] - mean, m[1, 1] - mean, m[2, 2] - mean
    d, e, f = m[0, 1], m[0, 2], m[1, 2]
    p = np.sqrt((a * a + b * b + c * c + 2 * (d * d + e * e + f * f)) / 6)
    values[:] = mean
    if p > 1e-200:
        half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2 * p * p * p)
        values[2] = mean + 2 * p * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3)
        # the smaller two from their sum and product: the cubic's own solution would lose half the digits
        together = 3 * mean - values[2]
        determinant = m[0, 0] * (m[1, 1] * m[2, 2] - f * f) - d * (d * m[2, 2] - f * e) + e * (d * f - m[1, 1] * e)
        product = determinant / values[2]
        values[1] = (together + np.sqrt(max(together * together - 4 * product, 0.0))) / 2
        values[0] = product / values[1] if values[1] > 1e-200 else 0.0
    longest = 0.0
    normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    for row in range(3):
        other = (row + 1) % 3
        u0, u1, u2 = m[row, 0], m[row, 1], m[row, 2]
        v0, v1, v2 = m[other, 0], m[other, 1], m[other, 2]
        if row == 0:
            u0, v1 = u0 - values[0], v1 - values[0]
        elif row == 1:
            u1, v2 = u1 - values[0], v2 - values[0]
        else:
            u2, v0 = u2 - values[0], v0 - values[0]
        x, y, z = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        square = x * x + y * y + z * z
        if square > longest and square > 1e-60:
            longest = square
            length = np.sqrt(square)
            normal[0], normal[1], normal[2] = x / length, y / length, z / length


@compiled
def _moments(
    points: NDArray[np.float64], neighbors: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Scale, normal, variances and centroid of each neighborhood, the point itself included."""
    count = len(points)
    k = neighbors.shape[1]
    scale = np.empty(count, np.float32)
    normals = np.empty((count, 3), np.float32)
    variance = np.empty((count, 3), np.float32)
    centroid = np.empty((count, 3), np.float32)
    mean, values, normal = np.empty(3), np.empty(3), np.empty(3)
    covariance = np.empty((3, 3))
    for i in range(count):
        mean[:] = 0
        covariance[:] = 0
        for j in neighbors[i]:
            for a in range(3):
                d = points[j, a] - points[i, a]
                mean[a] += d
                for b in range(a + 1):
                    covariance[a, b] += d * (points[j, b] - points[i, b])
        square = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
        size = np.sqrt(square / k) if square > 0 else 1.0
        scale[i] = size
        for a in range(3):
            centroid[i, a] = mean[a] / (k * size)
            for b in range(a + 1):
                covariance[a, b] = (covariance[a, b] - mean[a] * mean[b] / (k + 1)) / (size * size)
                covariance[b, a] = covariance[a, b]
        _principal(covariance, values, normal)
        total = max(values[0] + values[1] + values[2], 1e-30)
        for a in range(3):
            normals[i, a] = normal[a]
            variance[i, a] = max(values[a], 0.0) / total
    return scale, normals, variance, centroid
