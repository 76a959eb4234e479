"""Carry the signs of a thinned cloud to the points of the whole cloud.

The nearest oriented point may lie on the other side of a thin part. So points are first joined to regions in which all
signs agree, as for a whole cloud. The oriented points in a region vote for its sign, and couplings between regions
carry it to regions that hold no oriented point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.orientation.agreement import Surface, couplings, regions, relax, revote

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEAREST = 8  # oriented points that tell the sign of what hangs together with none
HEARSAY = 0.01  # weight of the nearest oriented points over that of one that is the point itself
TOLD = 1.0  # what the oriented points say over what the couplings say, if all agree


@dataclass(frozen=True)
class Thinned:
    """An oriented part of a cloud.

    Attributes:
        points: (M, 3).
        normals: (M, 3) unit vectors with their final signs.
        sure: (M,) how probably each sign is right, 0.5 to 1 (`methods.Orientation.confidence`).
    """

    points: Floats
    normals: Floats
    sure: Floats

    @cached_property
    def index(self) -> NeighborIndex:
        """Of the points."""
        return NeighborIndex(self.points)

    def votes(self, points: Floats, normals: Floats) -> tuple[Floats, Bools, Floats]:
        """Ask the thinned cloud about directions (N, 3).

        Returns:
            Votes (N,) for their signs, which of the points it holds, and how probably the nearest sign is right (N,).
        """
        near, distances = self.index.query(points, min(NEAREST, len(self.points)))
        cosine = np.einsum("nd,nkd->nk", normals, self.normals[near])
        votes = HEARSAY * (cosine * np.abs(cosine) * self.sure[near]).mean(axis=1)
        is_own = distances[:, 0] == 0
        votes[is_own] = np.copysign(self.sure[near[is_own, 0]], cosine[is_own, 0])
        return votes, is_own, self.sure[near[:, 0]]


def carry_signs(points: Floats, normals: Floats, thinned: Thinned) -> tuple[Bools, Floats]:
    """Find the signs of points by those of a thinned cloud.

    Args:
        points: (N, 3) different, finite points; those that are in the thinned cloud as well count most.
        normals: (N, 3) directions of any sign; NaN where there is none.
        thinned: the oriented points.

    Returns:
        Which normals (N,) to flip, and how probably each sign is right (N,), 0.5 to 1; 0 where there is no direction. A
        sign that was a guess in the thinned cloud stays one, however well its neighbors agree.
    """
    flips, sure = np.zeros(len(points), dtype=np.bool_), np.zeros(len(points))
    rows = np.flatnonzero(np.isfinite(normals).all(axis=1))
    if not len(rows) or not len(thinned.points):
        return flips, sure
    told, is_own, right = thinned.votes(points[rows], normals[rows])
    if is_own.all():
        flips[rows], sure[rows] = told < 0, np.abs(told)
        return flips, sure
    surface = Surface(points[rows] - np.median(points[rows], axis=0), normals[rows].copy())
    turned, region = regions(surface)
    surface.turn(turned)
    told[turned] *= -1
    count = int(region.max()) + 1
    coupling = couplings(surface, region, np.zeros(len(rows), dtype=np.bool_))
    votes: Floats = np.bincount(region, told, count).astype(np.float64)
    total, strength = float(np.abs(votes).sum()), float(abs(coupling).sum()) / 2
    belief = relax(coupling, votes * (TOLD * strength / total if total > 0 and strength > 0 else 1))
    surface.turn((belief < 0)[region])
    agreed = revote(surface) * np.abs(belief)[region]
    sure[rows] = 0.5 + (np.bincount(region, right, count) / np.bincount(region) - 0.5)[region] * agreed
    flips[rows] = np.einsum("nd,nd->n", surface.normals, normals[rows]) < 0
    return flips, sure
