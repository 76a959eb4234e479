"""A large cloud in blocks, each with a halo around it, for estimators that look at whole clouds in bounded memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jetnormal.estimators.base import Prediction, joined
from jetnormal.geometry.cells import cut_into_cells, halvings, in_sample
from jetnormal.geometry.neighbors import NeighborIndex, spatial_order

WHOLE = 500_000  # points: a larger cloud is cut into blocks
CORE = 250_000  # points of a block, about, whose normals are kept
ROOM = 1.25  # times as many, at most, since a sample tells the blocks
HALO = 60.0  # width of what a block sees around its core, in root mean square distances of the 16 neighbors
HALO_NEIGHBORS = 16
HALO_SHARE = 1.5  # points of the halo for each point of the core, at most
SAMPLE = 1000  # points from which the spacing of a block is told


def in_blocks(
    points: NDArray[np.float64],
    queries: NDArray[np.int64] | None,
    estimate: Callable[[NDArray[np.float64], NDArray[np.int64]], list[Prediction]],
    threads: int | None = None,
) -> Prediction:
    """Estimate the queries of a cloud block by block.

    Args:
        points: (N, 3) of the cloud.
        queries: (Q,) rows of `points`; None for all.
        estimate: gives the predictions, in parts, of some rows of a block's points, which are in spatial order.
        threads: CPU threads of the neighbor search; None for all cores.
    """
    queries = np.arange(len(points)) if queries is None else queries
    is_block = len(queries) <= ROOM * CORE and len(points) <= (1 + HALO_SHARE) * ROOM * CORE  # with its halo
    if len(points) <= WHOLE or is_block:
        block_of = np.zeros(len(points), dtype=np.int64)
    else:
        times = halvings(len(points))
        block_of = cut_into_cells(points[in_sample(points, times)], times, CORE).of(points)
    place = np.empty(len(points), dtype=np.int64)
    done, parts = [], []
    for number in range(int(block_of.max()) + 1):
        core = np.flatnonzero(block_of == number)
        asked = np.flatnonzero(block_of[queries] == number)
        if len(asked) == 0:
            continue
        rows = core if len(core) == len(points) else with_halo(points, core, halo_width(points[core], threads))
        rows = rows[spatial_order(points[rows])]
        place[rows] = np.arange(len(rows))
        asked = asked[np.argsort(place[queries[asked]])]
        done.append(asked)
        parts += estimate(points[rows], place[queries[asked]])
    return joined(parts)[np.argsort(np.concatenate(done))]


def with_halo(points: NDArray[np.float64], core: NDArray[np.int64], width: float) -> NDArray[np.int64]:
    """The rows of a block's core, and of what lies around its box, nearer than a width."""
    inside = points[core]
    low, high = inside.min(axis=0), inside.max(axis=0)
    near = np.ones(len(points), dtype=bool)
    for axis in range(3):
        near &= (points[:, axis] >= low[axis] - width) & (points[:, axis] <= high[axis] + width)
    near[core] = False
    halo = np.flatnonzero(near)
    most = round(HALO_SHARE * len(core))
    if len(halo) > most:  # a dense region beside a sparse one
        outside = np.maximum(np.maximum(low - points[halo], points[halo] - high), 0)
        halo = halo[np.argpartition(np.square(outside).sum(axis=1), most)[:most]]
    return np.concatenate([core, halo])


def halo_width(inside: NDArray[np.float64], threads: int | None) -> float:
    """How far around the box of a core (n, 3) its halo reaches, where there is room for it."""
    sample = inside[:: max(1, len(inside) // SAMPLE)]
    _, distances = NeighborIndex(inside, threads=threads).query(sample, min(HALO_NEIGHBORS + 1, len(inside)))
    return HALO * float(np.median(np.sqrt(np.square(distances).mean(axis=1))))
