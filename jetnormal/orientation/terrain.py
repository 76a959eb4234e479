"""Tell whether a cloud is terrain: ground seen from above, and what stands on it.

Terrain is wide, flat and mostly horizontal, and covers nearly all of its ground plan. Few parts of it lie above others:
a plate or a room has a second horizontal level, while trees above the ground are not horizontal. With consistent signs,
what is level looks to one side, while a flat object has a bottom. Trees may close the surface, so that the ground looks
down; but between their tops and the ground there is more, and nothing between the top of an object and its bottom.
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
# Consistently signed, 0.92 or more of the level points of terrain look to one side, and 0.53 to 0.70 of flat closed
# objects; among dense trees it was 0.61, but 0.1 to 0.17 of these points lay between the topmost and the lowest of
# their cell, and at most 0.04 in objects.
ONE_SIDE, BETWEEN = 0.8, 0.06
MIN_POINTS = 200


def is_terrain(points: Floats, normals: Floats) -> bool:
    """Tell terrain from objects, rooms and single views by its shape; z is the height.

    Args:
        points: (N, 3).
        normals: (N, 3) unit vectors with consistent signs, all or none of which may be wrong.
    """
    if len(points) < MIN_POINTS:
        return False
    from scipy.spatial import ConvexHull, QhullError

    low, high = np.quantile(points, [STRAYS, 1 - STRAYS], axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    points, slope = points[inside] - low, normals[inside, 2]
    level = np.abs(slope) > LEVEL
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
    if not (whole or ragged) or _stacked(key[level], points[level, 2], cell) > MAX_STACKED:
        return False
    up = float((slope[level] > 0).mean())
    return max(up, 1 - up) >= ONE_SIDE or _between(key[level], points[level, 2], cell) >= BETWEEN


def _between(key: NDArray[np.int64], height: Floats, cell: float) -> float:
    """Share of the points that lie more than a cell's side above the lowest and below the topmost of their cell."""
    place = np.unique(key, return_inverse=True)[1]
    low = np.full(int(place.max()) + 1, np.inf)
    high = -low
    np.minimum.at(low, place, height)
    np.maximum.at(high, place, height)
    return float(((height - low[place] > cell) & (high[place] - height > cell)).mean())


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
