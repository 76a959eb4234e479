"""Parts of a cloud that are so far apart that the surface of one says nothing about that of another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAP = 30.0  # width of the gap over the size of a part beside it
FEWEST = 16  # points of a part
LEAST = 100  # points of a part that has less than half of the points
STRAYS = 0.1  # share of a part's points at each end that do not count for its size


def far_apart(points: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Divide a cloud at its widest gaps, as long as they are much wider than what they set apart.

    A stray point far from everything, or an object far from another, would otherwise take part in the neighborhoods of
    points that have nothing to do with it: the coarse levels of a pyramid have few points.

    Args:
        points: (N, 3) finite.

    Returns:
        Rows (n,) of each part, ascending, the largest part first.
    """
    parts, waiting = [], [np.arange(len(points))]
    while waiting:
        rows = waiting.pop()
        side = _widest_gap(points[rows])
        if side is None:
            parts.append(rows)
        else:
            waiting += [rows[side], rows[~side]]
    return sorted(parts, key=len, reverse=True)


def _widest_gap(points: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """(n,) which points lie on one side of the widest gap along an axis, if that sets a part apart."""
    for axis in range(3 if len(points) > FEWEST else 0):
        along = np.sort(points[:, axis])
        gaps = np.diff(along)
        before = int(np.argmax(gaps))
        side = points[:, axis] <= along[before]
        for part in (side, ~side):
            count = int(part.sum())
            is_part = count >= LEAST or (count >= FEWEST and 2 * count >= len(points))
            if is_part and gaps[before] > GAP * _size(points[part]):
                return side
    return None


def _size(points: NDArray[np.float64]) -> float:
    """The longest side of the box of a part, but for its strays."""
    stray = int(STRAYS * len(points))
    ordered = np.sort(points, axis=0)
    return float((ordered[len(points) - 1 - stray] - ordered[stray]).max())
