"""Carry the signs of a thinned cloud to the points of the whole cloud.

The nearest oriented point may lie on the other side of a thin part. So points are first joined to regions in which all
signs agree, as for a whole cloud. The oriented points in a region tell its sign, and couplings between regions carry it
to regions that hold no oriented point. Oriented points keep their signs: they were settled with everything in view.

All this is local: it looks no farther than some regions. A cloud in memory is done block by block, in the blocks that
are the tiles of the same cloud on the disk.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.blocks import blocks
from jetnormal.geometry.neighbors import NeighborIndex, distinct, spatial_order
from jetnormal.orientation.agreement import Surface, couplings, regions, relax, revote

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SIGN_REACH = 20.0  # of regions of neighbors that agree, see `geometry.blocks.blocks`
NEAREST = 8  # oriented points that tell the sign of a region that holds none
HEARSAY = 0.01  # weight of what these say over what oriented points in the region say
TOLD = 2.0  # what oriented points say of their region over all that its couplings say


@dataclass(frozen=True)
class Thinned:
    """An oriented part of a cloud.

    Attributes:
        points: (M, 3).
        normals: (M, 3) unit vectors with their final signs.
        sure: (M,) how probably each sign is right, 0.5 to 1 (`methods.Orientation.confidence`).
    """

    points: Floats
    normals: NDArray[Any]
    sure: Floats

    @cached_property
    def index(self) -> NeighborIndex:
        """Of the points."""
        return NeighborIndex(self.points)

    def among(self, points: Floats) -> tuple[Ints, Ints]:
        """Find which of different points (N, 3) are in here: their rows (m,), and the rows that they have here (m,)."""
        inside = ((self.points >= points.min(axis=0)) & (self.points <= points.max(axis=0))).all(axis=1)
        mine = np.flatnonzero(inside)
        first, copy_of = distinct(np.concatenate([points, self.points[mine]]))
        rows = first[copy_of[len(points) :]]
        held = rows < len(points)
        return rows[held], mine[held]

    def nearby(self, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Ask the nearest points about directions (N, 3).

        Returns:
            Votes (N,) for their signs, -1 to 1, and how probably the sign of the nearest point is right (N,).
        """
        near, _ = self.index.query(points, min(NEAREST, len(self.points)))
        cosine = np.einsum("nd,nkd->nk", normals, self.normals[near])
        return (cosine * np.abs(cosine) * self.sure[near]).mean(axis=1), self.sure[near[:, 0]]


def carry_in_blocks(points: Floats, normals: NDArray[Any], thinned: Thinned) -> tuple[Bools, NDArray[np.float32]]:
    """Do what `carry_signs` does, block by block: a large cloud takes no more memory than a tile of it."""
    flips, sure = np.zeros(len(points), dtype=np.bool_), np.zeros(len(points), np.float32)
    for core, halo in blocks(points, SIGN_REACH):
        rows = np.concatenate([core, halo])
        turned, probable = carry_signs(points[rows], normals[rows].astype(np.float64), thinned)
        flips[core], sure[core] = turned[: len(core)], probable[: len(core)]
    return flips, sure


def carry_signs(points: Floats, normals: Floats, thinned: Thinned) -> tuple[Bools, Floats]:
    """Find the signs of points by those of a thinned cloud.

    Args:
        points: (N, 3) different, finite points; those that are in the thinned cloud as well have its signs.
        normals: (N, 3) unit vectors of any sign; NaN where there is none.
        thinned: the oriented points.

    Returns:
        Which normals (N,) to flip, and how probably each sign is right (N,), 0.5 to 1; 0 where there is no direction. A
        sign that was a guess in the thinned cloud stays one, however well its neighbors agree.
    """
    flips, sure = np.zeros(len(points), dtype=np.bool_), np.zeros(len(points))
    rows = np.flatnonzero(np.isfinite(normals).all(axis=1))
    if not len(rows) or not len(thinned.points):
        return flips, sure
    rows = rows[spatial_order(points[rows])]
    own, mine = thinned.among(points[rows])
    if len(own) == len(rows):
        agree = np.einsum("nd,nd->n", normals[rows[own]], thinned.normals[mine])
        flips[rows[own]], sure[rows[own]] = agree < 0, thinned.sure[mine]
        return flips, sure
    surface = Surface(points[rows] - np.median(points[rows], axis=0), normals[rows])
    turned, region = regions(surface)
    surface.turn(turned)
    coupling = couplings(surface, region, np.zeros(len(rows), dtype=np.bool_))
    told, right = _hear(points[rows], surface.normals, region, thinned, own, mine)
    strength = np.asarray(abs(coupling).sum(axis=1)).ravel()
    belief = relax(coupling, TOLD * np.where(strength > 0, strength, 1) * told)
    surface.turn((belief < 0)[region])
    turned[:] = False
    turned[own] = np.einsum("nd,nd->n", surface.normals[own], thinned.normals[mine]) < 0
    surface.turn(turned)
    agreed = revote(surface, own) * np.abs(belief)[region]
    sure[rows] = 0.5 + (right - 0.5)[region] * agreed
    sure[rows[own]] = thinned.sure[mine]
    flips[rows] = np.einsum("nd,nd->n", surface.normals, normals[rows]) < 0
    return flips, sure


def _hear(
    points: Floats, normals: Floats, region: NDArray[np.int32], thinned: Thinned, own: Ints, mine: Ints
) -> tuple[Floats, Floats]:
    """What the thinned cloud says about regions.

    Args:
        points, normals: (N, 3).
        region: (N,) in [0, R).
        own, mine: as from `Thinned.among`.

    Returns:
        Votes (R,) for their signs, -1 to 1, and how probably what was heard is right (R,).
    """
    count = int(region.max()) + 1
    sizes = np.bincount(region[own], minlength=count)
    agree = np.einsum("nd,nd->n", normals[own], thinned.normals[mine])
    told: Floats = np.bincount(region[own], np.copysign(thinned.sure[mine], agree), count).astype(np.float64)
    right: Floats = np.bincount(region[own], thinned.sure[mine], count).astype(np.float64)
    if not sizes.all():
        others = np.flatnonzero(sizes[region] == 0)
        votes, nearest = thinned.nearby(points[others], normals[others])
        told += HEARSAY * np.bincount(region[others], votes, count)
        right += np.bincount(region[others], nearest, count)
        sizes += np.bincount(region[others], minlength=count)
    return told / sizes, right / sizes
