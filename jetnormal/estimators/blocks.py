"""Estimators that look at whole clouds, in bounded memory: a large cloud is cut into blocks (`geometry.blocks`).

The estimator says how far the halo reaches. This module says how much memory the points that are computed together
take, for blocks of a cloud in memory and for tiles of one on the disk.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jetnormal.estimators.base import Prediction, joined, scattered
from jetnormal.geometry.blocks import CORE, HALO_SHARE, SPACING_NEIGHBORS, TOGETHER, blocks
from jetnormal.geometry.neighbors import inverse_order, spatial_order

BYTES = 1200  # of memory for each point that is looked at, at the peak
UNEVEN = 2.0  # how much farther apart than the median the points of a part of a block may be


def core_that_fits(memory: int) -> int:
    """Find how many points the core of a block may have, so that it takes so many bytes of memory with its halo."""
    return min(CORE, int(memory / bytes_of(1)))


def bytes_of(core: int) -> int:
    """Tell how many bytes of memory a block with a core of so many points takes with its halo, at most."""
    return round(core * (1 + HALO_SHARE) * BYTES)


def bytes_together(points: int) -> int:
    """Tell how many bytes of memory a cloud of so many points takes, in one look or in blocks."""
    return min(points, TOGETHER) * BYTES


def in_blocks(
    points: NDArray[np.float64],
    queries: NDArray[np.int64] | None,
    estimate: Callable[[NDArray[np.float64], NDArray[np.int64]], list[Prediction]],
    reach: float,
    threads: int | None = None,
) -> Prediction:
    """Estimate a cloud block by block, or some points of one that is looked at as a whole.

    Args:
        points: (N, 3) of the cloud.
        queries: (Q,) rows of `points`: whoever asks for some has cut the cloud already. None for all.
        estimate: gives the predictions, in parts, of some rows of a block's points, which are in spatial order.
        reach: of the estimator, see `base.Estimator`.
        threads: CPU threads of the neighbor search; None for all cores.
    """
    if queries is not None or len(points) <= TOGETHER:
        return _block(points, np.arange(len(points)) if queries is None else queries, estimate)
    parts = (
        (core, _block(points[np.concatenate([core, halo])], np.arange(len(core)), estimate))
        for core, halo in blocks(points, reach, threads)
    )
    return scattered(parts, len(points))


def _block(
    points: NDArray[np.float64],
    queries: NDArray[np.int64],
    estimate: Callable[[NDArray[np.float64], NDArray[np.int64]], list[Prediction]],
) -> Prediction:
    """The prediction for queries (Q,), rows of the points (n, 3) of a block."""
    near = spatial_order(points)
    asked = inverse_order(near)[queries]
    order = np.argsort(asked, kind="stable")
    return joined(estimate(points[near], asked[order]))[inverse_order(order)]


def radius_of(neighbors: int) -> float:
    """Tell how far away the last of so many neighbors on a surface may be, in the unit of `base.Estimator.reach`."""
    return UNEVEN * float(np.sqrt(2 * neighbors / SPACING_NEIGHBORS))
