"""Signs of the regions of closed surfaces, by what is seen of them, by couplings and by winding numbers.

Whoever sees a closed surface stands outside of it. A component whose two sides are both seen has no outside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import Surface, relax
from jetnormal.orientation.parts import Parts
from jetnormal.orientation.visibility import VIEWS, Votes, look
from jetnormal.orientation.winding import settle_by_winding

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FULL_VOTE = VIEWS / 4  # of a point that all views see from outside
MIN_SEEN = 0.04  # of the full votes, for a component; less comes through holes between points
OPEN_PURITY = 0.5  # |sum| over sum of a region's votes: nearly 1 on closed surfaces, 0.3 on a hemisphere
# Votes over couplings, if all agree. Couplings that do not contradict each other are hardly ever wrong, while a third
# of the votes are where scanners left holes: then votes only say which of the two solutions is outward.
LEAST_WEIGHT, MOST_WEIGHT = 0.001, 10.0
NOISY_WEIGHT = 1.0  # to begin with, where noise hides which side of a thin part a point is on; else the least
FEWEST_WRONG = 1e-3  # share; what is fewer makes nothing surer
ROUNDS = 3  # for the weight
DROWNED = 0.25  # roughness over spacing


def vote(surface: Surface, parts: Parts) -> tuple[Votes, Bools]:
    """Look at each component alone and, where both its sides are seen, among the others.

    Returns:
        The votes of the regions (M,), and which components (C,) are open.
    """
    votes = sum_votes(look(surface, parts.component, alone=True), parts)
    is_open = ~parts.speck & (_purity(votes, parts) < OPEN_PURITY)
    if not is_open.any() or len(parts.speck) == 1:
        return votes, is_open
    # The sides of a box may be scanned apart: each is open alone, but together they hide their inner sides.
    among, one_sided = vote_among(surface, parts)
    closed = is_open & one_sided
    mine = closed[parts.owner]
    votes = Votes(np.where(mine, among.outward, votes.outward), np.where(mine, among.total, votes.total), votes.upward)
    return votes, is_open & ~closed


def vote_among(surface: Surface, parts: Parts) -> tuple[Votes, Bools]:
    """Look at each component among the others, which may hide it.

    Returns:
        The votes of the regions (M,), and of which components (C,) one side is seen.
    """
    votes = sum_votes(look(surface, parts.component, alone=False), parts)
    seen = parts.by_component(votes.total) >= MIN_SEEN * FULL_VOTE * parts.sizes
    return votes, seen & (_purity(votes, parts) >= OPEN_PURITY)


def sum_votes(votes: Votes, parts: Parts) -> Votes:
    """Sum the votes of points over regions (M,)."""
    return Votes(parts.by_region(votes.outward), parts.by_region(votes.total), parts.by_region(votes.upward))


def _purity(votes: Votes, parts: Parts) -> Floats:
    """How far the views that see a region lie on one side of it (0 to 1), by component (C,)."""
    return _share(parts, np.abs(votes.outward), votes.total)


def weigh(surface: Surface, votes: Votes, parts: Parts, is_open: Bools) -> Floats:
    """Find signs of regions (M,), -1 to 1, from couplings and votes; where noise hides these, from winding numbers.

    A region with votes for both sides counts little.
    """
    strength = np.asarray(abs(parts.coupling).sum(axis=1)).ravel()
    total = parts.by_component(votes.total)
    scale = parts.by_component(strength) / 2 / np.where(total > 0, total, 1)
    scale[scale == 0] = 1
    told = votes.outward * (np.abs(votes.outward) / np.where(votes.total > 0, votes.total, 1)) ** 2 * scale[parts.owner]
    noisy = drowned(surface, parts)
    weight = _weight(parts, votes, told, np.where(noisy, NOISY_WEIGHT, LEAST_WEIGHT))
    belief = relax(parts.coupling, told * weight[parts.owner])
    for c in np.flatnonzero(noisy & ~is_open & ~parts.speck):
        mine, rows = np.flatnonzero(parts.owner == c), np.flatnonzero(parts.component == c)
        region, coupling = np.searchsorted(mine, parts.region[rows]), parts.coupling[mine][:, mine]
        found, whole = settle_by_winding(surface, rows, region, coupling, told[mine], belief[mine])
        belief[mine] = found if whole else belief[mine]
    return belief


def _weight(parts: Parts, votes: Votes, told: Floats, weight: Floats) -> Floats:
    """How much votes (M,) should count over couplings, by component (C,), from a first weight (C,).

    It is the ratio of the shares of each that are wrong, as in weighted least squares: what is wrong more often counts
    less. Wrong are those that contradict a solution, which depends on the weight, so they are found in rounds. A
    solution may follow votes through holes; but if a region is seen from both sides, some of its votes are wrong
    whatever its sign.
    """
    strength = np.asarray(abs(parts.coupling).sum(axis=1)).ravel()
    both_sides = _share(parts, (votes.total - np.abs(votes.outward)) / 2, votes.total)
    for _ in range(ROUNDS):
        signs = np.where(relax(parts.coupling, weight[parts.owner] * told) < 0, -1.0, 1.0)
        couplings = _share(parts, (strength - signs * (parts.coupling @ signs)) / 2, strength)
        denied = _share(parts, np.abs(told) * (signs * told < 0), np.abs(told))
        ratio = (couplings + FEWEST_WRONG) / (np.maximum(denied, both_sides) + FEWEST_WRONG)
        weight = np.clip(ratio, LEAST_WEIGHT, MOST_WEIGHT)
    return weight


def _share(parts: Parts, some: Floats, whole: Floats) -> Floats:
    """The share of values of regions (M,) in others, by component (C,)."""
    total = parts.by_component(whole)
    return parts.by_component(some) / np.where(total > 0, total, 1)


def drowned(surface: Surface, parts: Parts) -> Bools:
    """Which components (C,) have noise as large as the spacing, so that neighbors may lie on two sides of a wall."""
    return 2 * parts.by_component(parts.by_region(surface.roughness > DROWNED * surface.spacing)) > parts.sizes
