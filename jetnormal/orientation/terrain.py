"""Tell whether a cloud is terrain: ground seen from above, and what stands on it.

Terrain is wide, flat and mostly horizontal, and covers nearly all of its ground plan. Few parts of it lie above others:
a plate or a room has a second horizontal level, while trees above the ground are not horizontal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STRAYS = 0.01  # of the points may lie outside, on each side
LEVEL = 0.7  # cosine to the vertical of what is level
MIN_LEVEL_SHARE = 0.5  # of the points; walls and trees are the others
POINTS_PER_CELL = 8.0  # level ones, of the ground plan
# Share of the hull of the ground plan that is covered, and height over its longer side. A scan is cut off anywhere, and
# covers all of its plan, while a view of an object ends in a silhouette.
WHOLE, MAX_HEIGHT = 0.9, 0.35
RAGGED, MAX_RAGGED_HEIGHT = 0.6, 0.2
MAX_STACKED = 0.67  # of the cells that hold level points have some at two heights: under trees half, in a box 0.8
MIN_POINTS = 200


def is_terrain(points: Floats, normals: Floats) -> bool:
    """Tell terrain from objects, rooms and single views by its shape; z is the height.

    Args:
        points: (N, 3).
        normals: (N, 3) unit vectors of any sign.
    """
    if len(points) < MIN_POINTS:
        return False
    from scipy.spatial import ConvexHull, QhullError

    low, high = np.quantile(points, [STRAYS, 1 - STRAYS], axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    points, level = points[inside] - low, np.abs(normals[inside, 2]) > LEVEL
    width, depth, height = high - low
    if not min(width, depth) > 0 or level.mean() < MIN_LEVEL_SHARE:
        return False
    try:
        plan = ConvexHull(points[:, :2]).volume
    except QhullError:  # all on a line
        return False
    cell = np.sqrt(plan * POINTS_PER_CELL / level.sum())
    column = np.floor(points[:, :2] / cell).astype(np.int64)
    key = column[:, 0] * (int(depth / cell) + 2) + column[:, 1]
    covered, steepness = len(np.unique(key)) * cell * cell / plan, height / max(width, depth)
    whole = covered >= WHOLE and steepness <= MAX_HEIGHT
    ragged = covered >= RAGGED and steepness <= MAX_RAGGED_HEIGHT
    return bool((whole or ragged) and _stacked(key[level], points[level, 2], cell) <= MAX_STACKED)


def _stacked(key: NDArray[np.int64], height: Floats, cell: float) -> float:
    """Share of the cells with points at heights that a gap of a cell's side separates; single points do not count."""
    order = np.lexsort((height, key))
    key, height = key[order], height[order]
    same = key[1:] == key[:-1]
    jump = np.flatnonzero(same & (np.diff(height) > cell))
    starts = np.searchsorted(key, key[jump])
    ends = np.searchsorted(key, key[jump], side="right")
    both = (jump - starts >= 1) & (ends - jump - 1 >= 2)  # at least two points below and two above
    return len(np.unique(key[jump[both]])) / max(1, len(np.unique(key)))
