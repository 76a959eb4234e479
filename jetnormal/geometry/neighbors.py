"""k nearest neighbors.

`NeighborIndex` uses one of two k-d trees: Open3D's (nanoflann) or SciPy's. A tree only proposes candidates; distances
and their order are computed here, by one formula, so that both give the same answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.open3d_loader import import_open3d

Search = Callable[[NDArray[np.float64], int], NDArray[np.int64]]

# Measured on two cores with 100k points, thousand queries per second, Open3D / SciPy:
# k=16 560/580, k=64 170/150, k=256 31/37, k=500 11/22.
OPEN3D_MAX_K = 128
CHUNK_ENTRIES = 2_000_000  # candidates held at a time: about 100 MB of working memory
TIE_TOLERANCE = 1e-12  # relative; covers the rounding in which the back ends differ


class NeighborIndex:
    """Exact k nearest neighbors among fixed points, in float64.

    Neighbors ascend by (distance, index). Where several points tie for the k-th place, the smallest indices
    are taken, as long as at most k + 128 points tie; of a larger tie (thousands of copies of one point) the
    back end takes some, the same ones in every run. A point that is its own query need not come first: a
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
        # The middle of the box, unlike the mean, does not depend on the order of the points.
        self._center = (points.min(axis=0) + points.max(axis=0)) / 2
        self._points = points - self._center
        self._columns = np.ascontiguousarray(self._points.T)
        self._threads = threads
        self._searches: dict[str, Search] = {}

    def __len__(self) -> int:
        return len(self._points)

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
        indices = np.empty((len(queries), k), dtype=np.int64)
        distances = np.empty((len(queries), k))
        search = self._search_for(k)
        pending = np.arange(len(queries))
        for wanted in (k + 1, k + 24, 2 * k + 128):
            found = search(queries[pending], min(wanted, len(self)))
            found, far = self._in_canonical_order(queries[pending], found)
            indices[pending], distances[pending] = found[:, :k], far[:, :k]
            if wanted >= len(self):
                break
            pending = pending[far[:, -1] <= far[:, k - 1] * (1 + TIE_TOLERANCE)]
            if len(pending) == 0:
                break
        return indices, distances

    def _in_canonical_order(
        self, queries: NDArray[np.float64], indices: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Compute the distances (Q, k) of candidates (Q, k) and sort each row by (distance, index)."""
        distances = np.zeros(indices.shape)
        for axis in range(3):
            difference = self._columns[axis][indices]
            difference -= queries[:, axis, None]
            difference *= difference
            distances += difference
        np.sqrt(distances, out=distances)
        step = np.diff(distances, axis=1)
        disordered = (step < 0) | ((step == 0) & (indices[:, 1:] < indices[:, :-1]))
        rows = np.flatnonzero(disordered.any(axis=1))  # few: the back ends sort by distance themselves
        order = np.lexsort((indices[rows], distances[rows]), axis=1)
        indices[rows] = np.take_along_axis(indices[rows], order, axis=1)
        distances[rows] = np.take_along_axis(distances[rows], order, axis=1)
        return indices, distances

    def _search_for(self, k: int) -> Search:
        """Choose the back end for k neighbors: Open3D up to OPEN3D_MAX_K if it is there, else SciPy."""
        open3d = import_open3d() if k <= OPEN3D_MAX_K else None
        name = "scipy" if open3d is None else "open3d"
        if name not in self._searches:
            self._searches[name] = (
                _scipy_search(self._points, self._threads)
                if open3d is None
                else _open3d_search(open3d, self._points, self._threads)
            )
        return self._searches[name]


def distinct(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the different points among finite points (N, 3).

    A neighborhood that holds only copies of one point would say nothing about the surface.

    Returns:
        The rows (M,) where each different point comes first, and for each row (N,) which of these it is a copy of.
    """
    order = np.lexsort(points.T)  # stable: copies keep their order
    starts = np.append(np.ones(min(1, len(points)), dtype=bool), np.any(np.diff(points[order], axis=0) != 0, axis=1))
    copy_of = np.empty(len(points), dtype=np.int64)
    copy_of[order] = np.cumsum(starts) - 1
    return order[starts], copy_of


def _checked(values: NDArray[Any], name: str) -> NDArray[np.float64]:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}, but must be (N, 3)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite: mask NaN and infinite rows first")
    return array


def _scipy_search(points: NDArray[np.float64], threads: int | None) -> Search:
    from scipy.spatial import cKDTree

    tree = cKDTree(points)

    def search(queries: NDArray[np.float64], k: int) -> NDArray[np.int64]:
        # A list of ranks keeps the result two-dimensional when k is 1.
        _, indices = tree.query(queries, k=np.arange(1, k + 1), workers=threads or -1)
        return np.asarray(indices, dtype=np.int64)

    return search


def _open3d_search(open3d: Any, points: NDArray[np.float64], threads: int | None) -> Search:
    core = open3d.core
    tree = core.nns.NearestNeighborSearch(core.Tensor.from_numpy(points))
    tree.knn_index()

    def search(queries: NDArray[np.float64], k: int) -> NDArray[np.int64]:
        utility = open3d.utility
        before = utility.get_max_threads()
        if threads:
            utility.set_max_threads(threads)
        try:
            indices, _ = tree.knn_search(core.Tensor.from_numpy(np.ascontiguousarray(queries)), k)
        finally:
            utility.set_max_threads(before)
        return indices.numpy().reshape(len(queries), k).copy()

    return search
