"""k nearest neighbors.

The index is a k-d tree of our own (`tree`). SciPy's takes twice as long for 12 to 128 neighbors and 1.4 times as long
for 450, and does not say which of equally near points it takes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.tree import DEPTH, LEAF, grow, search
from jetnormal.support.device import available_cores

FEW = 1000  # queries that one thread answers sooner than several
DISK = 8  # neighbors tell how dense the points around one are
COLLINEAR = 1e-12  # ratio of variances below which points count as collinear: a millionth in width


class NeighborIndex:
    """Exact k nearest neighbors among fixed points, in float64.

    Neighbors ascend by (distance, index), and of points that tie for the k-th place the smallest indices are taken. A
    point that is its own query need not come first: a duplicate with a smaller index precedes it.

    Args:
        points: (N, 3) finite coordinates, N >= 1, of any offset: they are centered in float64 first.
        threads: threads a query may use; None uses all cores. The answer does not depend on it.

    Raises:
        ValueError: the points are not finite (N, 3) numbers, or there are none.
    """

    def __init__(self, points: NDArray[Any], *, threads: int | None = None) -> None:
        points = _checked(points, "points")
        if len(points) == 0:
            raise ValueError("points is empty: there is nothing to search")
        # The median, unlike the mean, does not depend on the order of the points, nor on a few that are far away.
        self._center = np.median(points, axis=0)
        self._threads = threads or available_cores()
        points = points - self._center
        leaves = 1 << (-(-len(points) // LEAF) - 1).bit_length()
        order, boxes = np.arange(len(points)), np.empty((2, 2 * leaves, 3))
        grow(points, order, *boxes)
        self._tree = (np.ascontiguousarray(points.T), order, *boxes)

    def __len__(self) -> int:
        return len(self._tree[1])

    def query(self, queries: NDArray[Any], k: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Find the k nearest points of every query.

        Args:
            queries: (Q, 3) finite coordinates, in the same frame as the points.
            k: number of neighbors, 1 <= k <= N.

        Returns:
            Indices (Q, k) int64 and distances (Q, k) float64, in ascending (distance, index) order.

        Raises:
            ValueError: k is out of range, or the queries are not finite (Q, 3) numbers.
        """
        if not 1 <= k <= len(self):
            raise ValueError(f"k is {k}, but must lie between 1 and the number of points, {len(self)}")
        queries = _checked(queries, "queries") - self._center
        indices = np.empty((len(queries), k), dtype=np.int64)
        distances = np.empty((len(queries), k))

        def answer(rows: slice) -> None:
            work = np.empty(DEPTH, np.int64), np.empty(DEPTH), np.empty(LEAF)
            search(*self._tree, queries[rows], *work, indices[rows], distances[rows])

        if self._threads == 1 or len(queries) < FEW:
            answer(slice(None))
            return indices, distances
        ends = np.linspace(0, len(queries), self._threads + 1).astype(int)
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(answer, map(slice, ends[:-1], ends[1:])))
        return indices, distances


def distinct(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the different points among finite points (N, 3).

    A neighborhood that holds only copies of one point would say nothing about the surface.

    Returns:
        The rows (M,) where each different point comes first, and for each row (N,) which of these it is a copy of.
    """
    order = np.argsort(points[:, 2], kind="stable")  # copies keep their order
    z = points[order, 2]
    tied = z[1:] == z[:-1]  # few, mostly: to sort by all coordinates would take three times as long
    rows = np.append(False, tied) | np.append(tied, False) if len(z) else tied
    order[rows] = order[rows][np.lexsort(points[order[rows]].T)]
    starts = np.ones(len(points), dtype=np.bool_)
    after = 1 + np.flatnonzero(tied)
    starts[after] = np.any(points[order[after]] != points[order[after - 1]], axis=1)
    copy_of = np.empty(len(points), dtype=np.int64)
    copy_of[order] = np.cumsum(starts) - 1
    return order[starts], copy_of


def typical_spacing(points: NDArray[np.float64]) -> float:
    """Estimate the distance between neighboring points (N, 3), N >= 1, as if they were a regular grid on the surface.

    A disk that reaches to the k-th neighbor holds k grid cells: pi r^2 = k s^2. The result is the median of s, 0 for
    one point.
    """
    k = min(DISK, len(points) - 1)
    _, distances = NeighborIndex(points).query(points, k + 1)
    return float(np.median(distances[:, -1])) * float(np.sqrt(np.pi / max(1, k)))


def spatial_order(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Order (n, 3) points so that near ones are mostly close together (Morton), where the cache has them."""
    low = points.min(axis=0)
    cells = ((points - low) * (0xFFFF / max(float(np.ptp(points, axis=0).max()), 1e-300))).astype(np.uint64)
    for shift, mask in ((32, 0xFFFF00000000FFFF), (16, 0x00FF0000FF0000FF), (8, 0xF00F00F00F00F00F),
                        (4, 0x30C30C30C30C30C3), (2, 0x9249249249249249)):  # fmt: skip
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.argsort(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)), kind="stable")


def inverse_order(permutation: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the permutation (n,) that undoes another one, as `np.argsort` of it does, but quicker."""
    undone = np.empty_like(permutation)
    undone[permutation] = np.arange(len(permutation))
    return undone


def _checked(values: NDArray[Any], name: str) -> NDArray[np.float64]:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}, but must be (N, 3)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite: mask NaN and infinite rows first")
    return array
