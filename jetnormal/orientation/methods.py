"""The methods that choose the signs of normals. Directions stay the same bit for bit.

`global`, `view`, `inside` and `mst` need nothing but the points; `viewpoint`, `up` and `terrain` use what is known
about the scan; `none` leaves the signs as they are. The results of all others do not depend on the signs of the input.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jetnormal.geometry.neighbors import distinct, inverse_order, spatial_order
from jetnormal.orientation.agreement import Surface
from jetnormal.orientation.calibration import probability
from jetnormal.orientation.grazing import grazing_flips
from jetnormal.orientation.outcome import Outcome
from jetnormal.orientation.outward import turn_inward, turn_outward, turn_up
from jetnormal.orientation.single_view import View
from jetnormal.orientation.spanning_tree import grow_tree
from jetnormal.orientation.visibility import looks_down

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Method = Literal["global", "view", "mst", "viewpoint", "up", "terrain", "inside", "none"]


@dataclass(frozen=True)
class Orientation:
    """Normals with chosen signs.

    Attributes:
        normals: (N, 3) of the dtype that came in.
        confidence: (N,) float32 in [0.5, 1], how probably each sign is right (`calibration`): by the agreement of
            neighbors, regions and views; for "viewpoint" and "up", by the cosine between the normal and the sight
            line; 0 where no sign was chosen.
        open: (N,) whether a point was found on a surface that has no outside.
        view: the side from which the open surfaces were seen, found by "view"; None if there is none.
    """

    normals: NDArray[Any]
    confidence: NDArray[np.float32]
    open: Bools
    view: View | None = None


def choose_signs(
    points: NDArray[Any], normals: NDArray[Any], method: Method = "global", *, viewpoint: ArrayLike | None = None
) -> Orientation:
    """Give normals consistent signs.

    Rows with a non-finite point or normal, or a zero normal, stay as they are and do not take part.

    Args:
        points: (N, 3) coordinates, of any offset.
        normals: (N, 3) directions of any length and sign.
        method: how signs are chosen:
            "global": outward, for closed surfaces; the wall of a cavity looks into the cavity. A component that is
            seen from both sides (a terrain, a wall) is turned up.
            "view": as "global", but open surfaces look to the side from which one sensor saw them, if that can be
            found.
            "mst": consistent over a spanning tree of each component, whose extreme points then look out; one without
            an outside is turned up. An inner shell looks out of itself. Where noise is as large as the spacing, closed
            components get the signs of "global".
            "viewpoint": towards `viewpoint`; where the sight line grazes the surface, neighbors count as well.
            "up": n_z > 0, for airborne scans; where n_z is 0, n_y > 0, and where that is 0 too, n_x > 0.
            "terrain": up, walls and crowns away from what is behind them.
            "inside": towards places in the empty space inside of the hull, as for a room or a street.
            "none": as they are.
        viewpoint: for the method "viewpoint", the sensor's (x, y, z) in the frame of the points, or one for each
            point, (N, 3). A normal at a right angle to its sight line, or without one, is turned up.

    Raises:
        ValueError: shapes do not match, or the method is unknown or lacks its viewpoint.
    """
    if method not in get_args(Method):
        raise ValueError(f"unknown orientation method {method!r}: choose one of {', '.join(get_args(Method))}")
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != normals.shape:
        raise ValueError(f"points {points.shape} and normals {normals.shape} must both be (N, 3)")
    sights = _sights(points, viewpoint) if method == "viewpoint" else np.zeros((0, 3))
    result = Orientation(normals.copy(), np.zeros(len(points), np.float32), np.zeros(len(points), dtype=bool))
    if method == "none":
        return result
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(normals.astype(np.float64), axis=1)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(length) & (length > 0))
    del length
    flip = looks_down(normals[rows])  # turned up, all have a common start, whatever signs came in
    if method == "viewpoint":
        used = _turned_up(normals[rows])
        cosine = np.einsum("nd,nd->n", used, sights[rows])
        flip ^= cosine < 0
        seen = np.where(cosine < 0, -1.0, 1.0)[:, None] * used
        flip ^= grazing_flips(points[rows].astype(np.float64), seen, np.abs(cosine))
        result.confidence[rows] = np.where(sights[rows].any(axis=1), probability(np.abs(cosine), "sight"), 0)
    elif method == "up":
        result.confidence[rows] = probability(_turned_up(normals[rows])[:, 2], "sight")
    elif len(rows):
        turned, found = _spread(points[rows].astype(np.float64, copy=False), _turned_up(normals[rows]), method)
        flip ^= turned
        result.confidence[rows], result.open[rows] = found.sure, found.open
        result = replace(result, view=found.view)
    result.normals[rows[flip]] *= -1
    return result


def _sights(points: NDArray[Any], viewpoint: ArrayLike | None) -> Floats:
    """Unit vectors (N, 3) from points to where they were seen from; 0 where that is unknown."""
    known = np.asarray(np.nan if viewpoint is None else viewpoint, dtype=np.float64)
    if known.shape not in ((3,), points.shape) or (known.ndim == 1 and not np.isfinite(known).all()):
        raise ValueError(f"the method 'viewpoint' needs three finite coordinates, or {points.shape} of them")
    with np.errstate(invalid="ignore"):
        sights = known - points
        length = np.linalg.norm(sights, axis=1, keepdims=True)
    return np.divide(sights, length, out=np.zeros(points.shape), where=np.isfinite(length) & (length > 0))


def _turned_up(normals: NDArray[Any]) -> Floats:
    """Unit vectors (N, 3) along normals, none of which looks down."""
    units = normals.astype(np.float64)
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    units[looks_down(units)] *= -1
    return units


def _spread(points: Floats, normals: Floats, method: Method) -> tuple[Bools, Outcome]:
    """Which unit normals (N, 3) to flip, none of which looks down, and what was found; N >= 1. The points are moved."""
    middle = np.partition(points, len(points) // 2, axis=0)[len(points) // 2].copy()  # whatever strays are where
    points -= middle  # far from the origin, projections would be coarse
    first, copy_of = distinct(points)
    order = spatial_order(points[first])  # neighbors are near in memory, too
    first, copy_of = first[order], inverse_order(order)[copy_of]
    placed, directed = points[first], normals[first]
    copies = np.setdiff1d(np.arange(len(points)), first, assume_unique=True)
    of_copies = normals[copies]
    del points, normals, first, order  # the graph takes most memory
    surface = Surface(placed, directed)
    if method == "mst":
        found = grow_tree(surface)
    elif method == "terrain":
        found = turn_up(surface)
    elif method == "inside":
        found = turn_inward(surface)
    else:
        found = turn_outward(surface, views=method == "view")
    flips = looks_down(surface.normals)[copy_of]
    # Copies of a point follow the first one. In the graph, many of them would see nothing but each other.
    flips[copies] = np.einsum("nd,nd->n", of_copies, surface.normals[copy_of[copies]]) < 0
    return flips, replace(found, sure=_probability(found, method)[copy_of], open=found.open[copy_of])


def _probability(found: Outcome, method: Method) -> Floats:
    """The probability that each sign is right (N,)."""
    if method == "terrain":
        return probability(found.sure, method)
    outward = probability(found.sure, "outward")
    if found.tree is not None:
        return np.where(found.tree, probability(found.sure, "mst"), outward)
    view = found.view
    seen = probability(found.sure, "guess" if view is None else "view" if view.certain else "lean")
    return np.where(found.open, seen, outward)
