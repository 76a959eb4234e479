"""k nearest neighbors.

The index is SciPy's k-d tree. Open3D's is no faster (100,000 points in spatial order, build and 50,000 queries, two
threads, seconds of SciPy / Open3D: k=17 0.060/0.070, k=61 0.170/0.173, k=257 0.74/0.95) and takes longer to import.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from jetnormal.support.device import available_cores

CHUNK_ENTRIES = 2_000_000  # candidates held at a time: about 100 MB of working memory
FEW = 1000  # queries that one thread answers sooner than several
TIE_TOLERANCE = 1e-12  # relative; covers rounding
DISK = 8  # neighbors tell how dense the points around one are
COLLINEAR = 1e-12  # ratio of variances below which points count as collinear: a millionth in width


class NeighborIndex:
    """Exact k nearest neighbors among fixed points, in float64.

    Neighbors ascend by (distance, index). Where several points tie for the k-th place, the smallest indices
    are taken, as long as at most k + 128 points tie; of a larger tie (thousands of copies of one point) the
    tree takes some, the same ones in every run. A point that is its own query need not come first: a
    duplicate with a smaller index precedes it.

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
        # Cells are cut in the middle: quicker to build than at the median, and as quick to search.
        self._tree = cKDTree(points - self._center, balanced_tree=False)

    def __len__(self) -> int:
        return self._tree.n

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
        rows = max(1, CHUNK_ENTRIES // k)
        for start in range(0, len(queries), rows):
            chunk = slice(start, start + rows)
            indices[chunk], distances[chunk] = self._nearest(queries[chunk], k)
        return indices, distances

    def _nearest(self, queries: NDArray[np.float64], k: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ask for spare candidates until no row's k-th place is tied with its last candidate, then trim."""
        found, far = self._candidates(queries, k + 1)
        indices, distances = found[:, :k], far[:, :k]
        pending = np.arange(len(queries))
        for wanted in (k + 24, 2 * k + 128):
            if far.shape[1] == len(self):
                break
            pending = pending[far[:, -1] <= far[:, k - 1] * (1 + TIE_TOLERANCE)]
            if len(pending) == 0:
                break
            found, far = self._candidates(queries[pending], wanted)
            indices[pending], distances[pending] = found[:, :k], far[:, :k]
        return indices, distances

    def _candidates(self, queries: NDArray[np.float64], count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """As many nearest points of every query, or all that there are, by ascending (distance, index)."""
        ranks = np.arange(1, min(count, len(self)) + 1)  # a list keeps the result two-dimensional
        distances, indices = self._query(queries, ranks)
        _sort_ties(indices, distances)
        return indices, distances

    def _query(self, queries: NDArray[np.float64], ranks: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Ask the tree, on several threads for many queries.

        The tree's own threads would go on with arrays that are gone after a Ctrl-C, and end the process by a signal.
        """
        if self._threads == 1 or len(queries) < FEW:
            return self._tree.query(queries, ranks)
        distances = np.empty((len(queries), len(ranks)))
        indices = np.empty((len(queries), len(ranks)), dtype=np.int64)

        def answer(rows: slice) -> None:
            distances[rows], indices[rows] = self._tree.query(queries[rows], ranks)

        ends = np.linspace(0, len(queries), self._threads + 1).astype(int)
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(answer, map(slice, ends[:-1], ends[1:])))
        return distances, indices


def _sort_ties(indices: NDArray[np.int64], distances: NDArray[np.float64]) -> None:
    """Sort each row by (distance, index), in place. Few need it: the tree sorts by distance."""
    rows = np.unique(np.nonzero(distances[:, 1:] == distances[:, :-1])[0])
    order = np.lexsort((indices[rows], distances[rows]), axis=1)
    indices[rows] = np.take_along_axis(indices[rows], order, axis=1)
    distances[rows] = np.take_along_axis(distances[rows], order, axis=1)


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
