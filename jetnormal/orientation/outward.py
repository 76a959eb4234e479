"""The method "global": normals look outward, out of the solid.

1. Neighbors that surely agree are joined to regions (`agreement.regions`); regions that touch are coupled.
2. Each connected component is looked at from all around (`visibility.look`): whoever sees a closed surface stands
   outside of it. A component whose two sides are both seen, alone and among the others, is open: it has no outside.
3. Signs follow from couplings and votes by one linear system. Couplings that agree with each other count far more than
   votes: through holes that scanners left, the inside of a surface is seen, while couplings are hardly ever wrong.
   Where noise is as large as the spacing, couplings join the two sides of walls; there winding numbers count as well
   (`winding`).
4. A component inside the solid part of another is the wall of a cavity, and is turned inward.
5. An open surface is turned up.
6. Where noise is not small against the spacing, the field of all normals (`dipole_field`) corrects single points.
7. Specks, which have fewer points than a surface needs, and single points off a surface take the sign of the surface
   beside them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.orientation.agreement import Surface, region_forest, revote, spread_signs
from jetnormal.orientation.closed import FULL_VOTE, sum_votes, vote, vote_among, weigh
from jetnormal.orientation.dipole_field import contradicted
from jetnormal.orientation.kernels.fields import solid_angles
from jetnormal.orientation.outcome import Outcome
from jetnormal.orientation.parts import Parts, divide
from jetnormal.orientation.places import Hull, drawn_evenly, principal_axes, seen_from_inside
from jetnormal.orientation.single_view import View, as_seen
from jetnormal.orientation.visibility import Votes, look

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LEVEL = 0.3  # cosine to the vertical; what is steeper is a wall
STRAY_RADII = 1.5  # neighborhood radius, over the mean of the neighbors'
INSIDE_POINTS = 12_000  # are looked at from inside
FAR_WEIGHT = 3.0  # of what is seen from far away, over what is seen from inside
PLACES, SOURCES = 16, 4096  # points of a component that tell whether it is inside, and that tell it of others
# The votes for up of a region count up to as many sure edges as lie along its side. In a smooth sheet, several times
# that many join two regions; in the noisy crease between a wall and the ground, fewer.
MAX_UPRIGHT = 30.0


def turn_outward(surface: Surface, *, views: bool = False) -> Outcome:
    """Turn the normals of a surface outward, and those of open surfaces up.

    Args:
        surface: its normals are turned.
        views: whether open surfaces are turned to the side from which they were seen, if it can be found
            (`single_view`).
    """
    flips, parts = divide(surface)
    surface.turn(flips)
    votes, is_open = vote(surface, parts)
    belief = weigh(surface, votes, parts, is_open)
    belief = np.where(_in_matter(surface, parts, belief, is_open)[parts.owner], -belief, belief)
    view = None
    if is_open.any():
        view = as_seen(surface, parts, is_open[parts.component]) if views else None
        view = view if view is not None and (view.found or view.several) else None
        if view is None:
            belief = np.where(is_open[parts.owner], _upright(votes, parts), belief)
        elif view.found:  # else it was seen from several sides, and looks outward as other objects do
            belief = np.where(is_open[parts.owner], view.belief, belief)
    return _finished(surface, parts, belief, is_open, view)


def turn_up(surface: Surface) -> Outcome:
    """Turn the normals of terrain up; its walls and trees look away from what is behind them."""
    flips, parts = divide(surface)
    surface.turn(flips)
    votes = sum_votes(look(surface, parts.component, alone=True), parts)
    outcome = _finished(surface, parts, _upright(votes, parts), ~parts.speck)
    surface.turn(surface.normals[:, 2] < -LEVEL)
    return outcome


def turn_inward(surface: Surface) -> Outcome:
    """Turn the normals of a scan that was taken from inside, as of a room or a street, to the places inside.

    Places in the empty space inside of the hull (`places`) vote, as those far away do for an object. Where these see
    one side only, it is the back, as of the walls of a house, and they vote against it. With the opposite normals, the
    winding number of the surface is 1/2 as on a solid, so these are weighed.
    """
    flips, parts = divide(surface)
    surface.turn(flips)
    none = np.zeros(len(parts.speck), dtype=np.bool_)
    inside = sum_votes(_look_inside(surface), parts)
    backs, closed = vote_among(surface, parts)
    share = FAR_WEIGHT * inside.total.sum() / max(backs.total.sum(), 1e-300) * closed[parts.owner]
    opposite = replace(inside, outward=share * backs.outward - inside.outward, total=share * backs.total + inside.total)
    belief = -weigh(surface, opposite, parts, none)
    return _finished(surface, parts, belief, none)


def _look_inside(surface: Surface) -> Votes:
    """Look at a part of the points (N,), evenly dense, from places inside."""
    rows = drawn_evenly(surface.spacing, INSIDE_POINTS)
    points, normals = surface.points[rows], surface.normals[rows]
    frame = principal_axes(points)
    points, normals = points @ frame, normals @ frame
    outward, total = np.zeros((2, len(surface.points)))
    outward[rows], total[rows] = seen_from_inside(points, normals, Hull(points).places())
    return Votes(outward, total, np.zeros(len(total)))


def _finished(surface: Surface, parts: Parts, belief: Floats, is_open: Bools, view: View | None = None) -> Outcome:
    """Turn regions by their signs (M,), then single points in them that are wrong."""
    surface.turn((belief < 0)[parts.region])
    sure = revote(surface) * np.abs(belief)[parts.region]
    objects = np.where(parts.speck, -1, np.arange(len(parts.speck), dtype=np.int32))
    flips, strength = contradicted(surface, objects[parts.component])
    surface.turn(flips)
    sure *= strength
    open_points = is_open[parts.component]
    _follow(surface, parts.speck[parts.component] | _beside(surface), sure, open_points)
    return Outcome(sure, open_points, view)


def _in_matter(surface: Surface, parts: Parts, belief: Floats, is_open: Bools) -> Bools:
    """Which components (C,) lie in the solid part of others, by the winding number of these, the largest first."""
    flips = np.zeros(len(parts.speck), dtype=np.bool_)
    candidates = np.flatnonzero(~(parts.speck | is_open))
    if len(candidates) < 2:
        return flips
    order = np.argsort(parts.component, kind="stable")
    starts = np.cumsum(parts.sizes) - parts.sizes
    low = np.minimum.reduceat(surface.points[order], starts)
    high = np.maximum.reduceat(surface.points[order], starts)
    candidates = candidates[np.argsort(-np.linalg.norm(high - low, axis=1)[candidates], kind="stable")]
    sign = np.where(belief < 0, -1, 1)[parts.region]
    for rank, c in enumerate(candidates):
        larger = candidates[:rank]
        around = larger[((low[larger] <= low[c]) & (high[larger] >= high[c])).all(axis=1)]
        places = surface.points[_some(order, starts, parts.sizes, int(c), PLACES)]
        winding = np.zeros(len(places))
        for other in around:
            rows = _some(order, starts, parts.sizes, int(other), SOURCES)
            area = surface.spacing[rows] ** 2 * (parts.sizes[other] / len(rows))
            moments = surface.normals[rows] * (area * sign[rows])[:, None]
            winding += (-1 if flips[other] else 1) * solid_angles(places, surface.points[rows], moments, area / 4)
        flips[c] = np.median(winding) > 0.5
    return flips


def _some(order: Ints, starts: Ints, sizes: Ints, component: int, count: int) -> Ints:
    """Up to about `count` points of a component, evenly taken from the order."""
    return order[starts[component] : starts[component] + sizes[component] : -(-int(sizes[component]) // count)]


def _upright(votes: Votes, parts: Parts) -> Floats:
    """Find signs of regions (M,), -1 to 1, by what is seen from above.

    Links and votes for up form one spanning tree, so the clearest part of a sheet decides for all of it. By a mean of
    all votes, the signs would change where it overhangs.
    """
    from scipy.sparse import bmat, csr_matrix

    told = np.clip(votes.upward / FULL_VOTE, -MAX_UPRIGHT, MAX_UPRIGHT)
    coupling = parts.coupling
    column = csr_matrix(told)
    flips, _ = spread_signs(region_forest(bmat([[coupling, column.T], [column, None]], format="csr")))
    signs = np.where(flips[:-1] ^ flips[-1], -1.0, 1.0)
    support = signs * (coupling @ signs + told)
    total = np.asarray(abs(coupling).sum(axis=1)).ravel() + np.abs(told)
    return signs * np.clip(support / np.where(total > 0, total, 1), 1e-3, 1)


def _beside(surface: Surface) -> Bools:
    """Which points (N,) lie off a surface: they are farther from their neighbors than these are from theirs.

    The mirror test takes such a point and the surface for the two sides of a plate.
    """
    if not surface.neighbors.shape[1]:
        return np.zeros(len(surface.points), dtype=np.bool_)
    return np.asarray(surface.radius > STRAY_RADII * surface.radius[surface.neighbors].mean(axis=1))


def _follow(surface: Surface, followers: Bools, sure: Floats, is_open: Bools) -> None:
    """Give some points (N,) the sign, and what else is known, of the surface beside them."""
    rows, known = np.flatnonzero(followers), np.flatnonzero(~followers)
    if not len(rows) or not len(known):
        return
    near = known[NeighborIndex(surface.points[known]).query(surface.points[rows], min(4, len(known)))[0]]
    cosine = np.einsum("nd,nkd->nk", surface.normals[rows], surface.normals[near])
    agreement = (cosine * sure[near]).mean(axis=1)
    flips = np.zeros(len(followers), dtype=np.bool_)
    flips[rows] = agreement < 0
    surface.turn(flips)
    sure[rows], is_open[rows] = np.abs(agreement), is_open[near[:, 0]]
