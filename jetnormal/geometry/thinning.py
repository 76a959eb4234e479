"""Thin a cloud, the same way whoever thins it: all at once, or tile by tile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.cells import mixed_digits
from jetnormal.geometry.neighbors import NeighborIndex

Floats = NDArray[np.float64]

SPACING_NEIGHBORS = 8
CHUNK = 100_000  # points


def ranks(points: Floats, others: Floats, *, threads: int | None = None) -> Floats:
    """Rank points: those of a cloud with the least numbers are the cloud, thinned.

    This is the priority sampling of Duffield, Lund and Thorup, "Priority sampling for estimation of arbitrary subset
    sums" (2007): a random number over the distance of the eighth neighbor, so that the closer points are, the fewer of
    them stay. The digits of the coordinates tell the random number.

    Args:
        points: (N, 3), finite and different.
        others: (M, 3) what else is near them; different from the points.
        threads: CPU threads of the neighbor search; None for all cores.

    Returns:
        (N,) numbers; 0 for a point without neighbors.
    """
    index = NeighborIndex(np.concatenate([points, others]), threads=threads)
    count = min(SPACING_NEIGHBORS + 1, len(index))
    found: Floats = np.empty(len(points))
    for start in range(0, len(points), CHUNK):
        rows = slice(start, start + CHUNK)
        spacing = index.query(points[rows], count)[1][:, -1]
        chance = (mixed_digits(points[rows]) >> np.uint64(11)) * 2.0**-53
        found[rows] = np.divide(chance, spacing, out=np.zeros(len(chance)), where=spacing > 0)
    return found


def least(ranked: Floats, count: int) -> NDArray[np.int64]:
    """Find the rows of so many least ranks, in the order of the points; all rows if there are fewer."""
    if count >= len(ranked):
        return np.arange(len(ranked))
    return np.sort(np.argpartition(ranked, count)[:count])
