"""Compiled loops over the points of patches. They run in one thread and release the interpreter lock."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled


def farthest_points(points: NDArray[np.float32], kept: NDArray[np.int64]) -> None:
    """Fill kept (B, m), whose first column is given, with indices of points (B, n, 3)."""
    _farthest_points(points, np.empty((4, points.shape[1]), np.float32), kept)


@compiled
def _farthest_points(points: NDArray[np.float32], work: NDArray[np.float32], kept: NDArray[np.int64]) -> None:
    """`farthest_points` with memory to work in, (4, n)."""
    patches, count = kept.shape
    n = points.shape[1]
    x, y, z, distance = work[0], work[1], work[2], work[3]
    for b in range(patches):
        for i in range(n):
            x[i], y[i], z[i] = points[b, i, 0], points[b, i, 1], points[b, i, 2]
            distance[i] = np.inf
        for m in range(1, count):
            newest = kept[b, m - 1]
            x0, y0, z0 = x[newest], y[newest], z[newest]
            for i in range(n):  # a loop of its own is vectorized, the search for the largest is not
                dx, dy, dz = x[i] - x0, y[i] - y0, z[i] - z0
                distance[i] = min(distance[i], dx * dx + dy * dy + dz * dz)
            farthest = 0
            for i in range(1, n):
                if distance[i] > distance[farthest]:
                    farthest = i
            kept[b, m] = farthest


def smallest(scores: NDArray[np.float32], found: NDArray[np.int64]) -> None:
    """Fill found (R, k) with the columns of the k smallest of each row of scores (R, n), ascending.

    Of equals, the first is taken. This is faster than a general selection where k is much smaller than n.
    """
    _smallest(scores, np.empty(found.shape[1], np.float32), found)


@compiled
def _smallest(scores: NDArray[np.float32], kept: NDArray[np.float32], found: NDArray[np.int64]) -> None:
    """`smallest` with memory to work in, (k,)."""
    rows, k = found.shape
    n = scores.shape[1]
    for r in range(rows):
        count = 0
        for i in range(n):
            score = scores[r, i]
            if count == k:
                if not score < kept[k - 1]:
                    continue
                place = k - 1
            else:
                place = count
                count += 1
            while place > 0 and score < kept[place - 1]:
                kept[place] = kept[place - 1]
                found[r, place] = found[r, place - 1]
                place -= 1
            kept[place] = score
            found[r, place] = i
