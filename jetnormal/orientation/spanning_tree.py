"""The method "mst": signs that are consistent along a spanning tree, corrected by the edges outside of the tree.

Hoppe et al., "Surface reconstruction from unorganized points" (1992), with regions instead of points: the coupling of
two regions is a sum over all edges between them, whose sign a single wrong edge hardly changes. Then branches that
contradict the rest are flipped, and each component is turned so that it looks outward at its extreme points.

Where noise is as large as the spacing, couplings join the two sides of walls, and no tree can do without such edges.
There, closed components take the signs of the method "global" (`closed`, `dipole_field`).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import Forest, Surface, region_forest, revote, rooted, spread_signs
from jetnormal.orientation.closed import drowned, vote, weigh
from jetnormal.orientation.dipole_field import contradicted
from jetnormal.orientation.outcome import Outcome
from jetnormal.orientation.parts import Parts, divide
from jetnormal.orientation.visibility import extremes_look_inward

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MENDED = 64  # branches at most
OUTLIER_RADIUS = 5.0  # neighborhood radius, over the median of all


def grow_tree(surface: Surface) -> Outcome:
    """Turn normals consistently along a spanning tree of regions; nothing is known to be open."""
    flips, parts = divide(surface)
    surface.turn(flips)
    forest = region_forest(parts.coupling)
    flips = mend(forest, parts.coupling, spread_signs(forest)[0])
    walled, outward = _behind_walls(surface, parts)
    surface.turn(np.where(walled[parts.owner], outward < 0, flips)[parts.region])
    sure = revote(surface)
    objects = np.where(walled, np.arange(len(walled), dtype=np.int32), -1)
    flips, strength = contradicted(surface, objects[parts.component])
    surface.turn(flips)
    stray = surface.radius > OUTLIER_RADIUS * np.median(surface.radius)
    crowd = np.bincount(parts.component, ~stray)
    stray &= crowd[parts.component] > 0
    inward = extremes_look_inward(surface, parts.component, stray)
    surface.turn((inward & ~walled)[parts.component])
    return Outcome(sure * strength, np.zeros(len(sure), dtype=np.bool_), tree=~walled[parts.component])


def _behind_walls(surface: Surface, parts: Parts) -> tuple[Bools, Floats]:
    """Which components (C,) are closed and have noise that hides walls, and outward signs of regions (M,) for these."""
    noisy = drowned(surface, parts) & ~parts.speck
    if not noisy.any():
        return noisy, np.zeros(len(parts.owner))
    votes, is_open = vote(surface, parts)
    return noisy & ~is_open, weigh(surface, votes, parts, is_open)


def mend(forest: Forest, coupling: Any, flips: Bools) -> Bools:
    """Flip branches that contradict the rest of their tree more than they agree with it, the worst first.

    One edge of the tree connects a branch with the rest. If this edge is wrong, so is the whole branch, and the other
    couplings between the branch and the rest show it.

    Args:
        forest: over M nodes.
        coupling: W, a symmetric sparse (M, M) matrix: how far nodes agree, negative where they contradict each other.
        flips: (M,) which nodes are flipped.

    Returns:
        (M,) which nodes are to be flipped; no fewer couplings agree.
    """
    from scipy.sparse import triu

    order, parent, _ = rooted(forest)
    levels = _levels(order, parent)
    pairs = triu(coupling, 1).tocoo()
    meeting = _meeting_points(parent, levels, pairs.row.astype(np.int64), pairs.col.astype(np.int64))
    signs = np.where(flips, -1.0, 1.0)
    least = -1e-9 * float(np.abs(pairs.data).sum())
    for _ in range(MENDED):
        agreement = pairs.data * signs[pairs.row] * signs[pairs.col]
        across = sum(np.bincount(ends, agreement, len(parent)) for ends in (pairs.row, pairs.col))
        across -= 2 * np.bincount(meeting, agreement, len(parent))  # both ends are in the branch
        for level in reversed(levels[1:]):
            np.add.at(across, parent[level], across[level])
        worst = int(np.argmin(across[:-1]))
        if not across[worst] < least:
            break
        signs[_branch(worst, parent, levels)] *= -1
    return signs < 0


def _levels(order: Ints, parent: Ints) -> list[Ints]:
    """The nodes, in an order from the top down, by their distance from the root."""
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    above = rank[parent[order]]  # never falls: the children of a level follow it in one run
    starts = [0, 1]
    while starts[-1] < len(order):
        starts.append(int(np.searchsorted(above, starts[-1])))
    return [order[start:end] for start, end in pairwise(starts)]


def _meeting_points(parent: Ints, levels: list[Ints], a: Ints, b: Ints) -> Ints:
    """The lowest common ancestors of nodes a (E,) and b (E,), by jumps of powers of two."""
    depth = np.empty(len(parent), dtype=np.int64)
    for number, level in enumerate(levels):
        depth[level] = number
    jumps = [parent]
    while 1 << len(jumps) < len(levels):
        jumps.append(jumps[-1][jumps[-1]])
    deeper = depth[a] >= depth[b]
    a, b = np.where(deeper, a, b), np.where(deeper, b, a)
    gap = depth[a] - depth[b]
    for power, jump in enumerate(jumps):
        a = np.where(gap >> power & 1, jump[a], a)
    for jump in reversed(jumps):
        apart = jump[a] != jump[b]
        a, b = np.where(apart, jump[a], a), np.where(apart, jump[b], b)
    return np.where(a == b, a, parent[a])


def _branch(node: int, parent: Ints, levels: list[Ints]) -> Ints:
    """A node and all below it."""
    inside = np.zeros(len(parent), dtype=bool)
    inside[node] = True
    for level in levels[1:]:
        inside[level] |= inside[parent[level]]
    return np.flatnonzero(inside[:-1])
