"""Signs of the regions of a closed surface by winding numbers, where noise is too large for the agreement of neighbors.

Where noise is as large as the spacing, neighbors on both sides of a wall look like one sheet, and the agreement of
neighbors gives both sides the same sign. Gauss's formula tells them apart: on a surface whose normals are outward, the
winding number of the normals is 1/2, between 1 inside and 0 outside. A thin wall's far side alone gives nearly 1/2 if
it is right, and -1/2 if it is wrong, while flat surface around a place gives it nothing.

Lin et al., "Surface reconstruction from point clouds without normals by parametrizing the Gauss formula" (2022), solve
for a vector at each point. Here the directions are known, and the unknowns are the signs of regions, which their
agreement ties together as well: one linear system of a few thousand unknowns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from jetnormal.orientation.agreement import LeastSquares, Surface, relax
from jetnormal.orientation.kernels.fields import sum_solid_angles

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ON_SURFACE = 0.5  # winding number
WEIGHT = 3.0  # of a region's winding number over its couplings; of 1, 3 and 10 the best under high noise
PLACES = 4  # of a region, whose mean counts
NEAREST = 1e-12  # over the size of a component: what is nearer to a place counts as so far away
SOURCE_POINTS, SOURCES = 10, 16_384  # points in a source, or more where there were more sources in all
MAX_REGIONS = 4096  # with winding numbers; of more, the smaller follow their couplings
LEAST_SHARE = 0.5  # of the points, in these
ROUNDS, TOLERANCE = 4, 1e-3  # wrong signs make the mean wrong, and with it the areas
LEAST_MEAN = 0.1  # winding number of a surface that is mostly right
# Share of the points with positive winding numbers: 0.993 or more of noisy solids and plates, 0.95 to 0.989 of noisy
# scans with missing surface, of whose signs these numbers made up to 55 % wrong.
POSITIVE = 0.99


def settle_by_winding(
    surface: Surface, rows: Ints, region: Ints, coupling: Any, told: Floats, belief: Floats
) -> tuple[Floats, bool]:
    """Find signs of the regions of a closed component so that winding numbers are 1/2 on all of them.

    Of more than `MAX_REGIONS`, only the largest have winding numbers.

    Args:
        surface: N points; normals are consistent in every region.
        rows: (n,) the component's points.
        region: (n,) the region of each, in [0, M).
        coupling: sparse (M, M), how far regions agree.
        told: (M,) votes for the regions, as for `agreement.relax`.
        belief: (M,) signs, more right than wrong; by their mean winding number, noise makes areas look too large.

    Returns:
        The signs (M,), -1 to 1, and whether winding numbers are positive nearly everywhere then: where much of a
        surface is missing, they are not, whatever the signs.
    """
    sizes = np.bincount(region)
    among = np.sort(np.argsort(-sizes, kind="stable")[:MAX_REGIONS])
    number = np.full(len(sizes), -1)
    number[among] = np.arange(len(among))
    held = number[region] >= 0
    if held.sum() < LEAST_SHARE * len(rows):
        return belief, True
    weight = np.asarray(WEIGHT * float(abs(coupling).sum()) / len(rows) * sizes[among], dtype=np.float64)
    rows, region, sizes = rows[held], number[region[held]], sizes[among]
    with threadpool_limits(1, "blas"):  # whose sums depend on the number of threads
        windings = winding_matrix(surface.points[rows], surface.normals[rows], surface.spacing[rows] ** 2, region)
        for _ in range(ROUNDS):
            mean = float(sizes @ _windings(windings, belief[among])) / len(rows)
            if mean < LEAST_MEAN:
                break
            demand = LeastSquares(windings, weight * (ON_SURFACE / mean) ** 2, mean, among, len(number))
            belief = relax(coupling, told, demand, tolerance=TOLERANCE)
        positive = float(sizes @ (_windings(windings, belief[among]) > 0)) / len(rows)
    return belief, positive >= POSITIVE


def _windings(windings: NDArray[np.float32], belief: Floats) -> NDArray[np.float32]:
    """The winding number in each region (M,)."""
    return np.asarray(windings @ np.sign(belief).astype(np.float32))


def winding_matrix(points: Floats, normals: Floats, areas: Floats, region: Ints) -> NDArray[np.float32]:
    """Find the mean winding number in each region that the points of each other region give it (M, M), 0 for its own.

    Args:
        points, normals: (N, 3), N >= 2.
        areas: (N,) that the points stand for.
        region: (N,) in [0, M), none empty.
    """
    order = np.argsort(region, kind="stable")
    size = float(np.ptp(points, axis=0).max())
    points, areas = (points[order] - points.mean(axis=0)) / size, areas[order] / size**2  # near 1: float32 is enough
    sizes = np.bincount(region)
    ends = np.append(0, np.cumsum(sizes))
    rank = np.arange(len(order)) - np.repeat(ends[:-1], sizes)
    per_source = max(SOURCE_POINTS, -(-len(order) // SOURCES))
    starts = np.flatnonzero(rank % per_source == 0)
    area = np.add.reduceat(areas, starts)
    centers = np.add.reduceat(points * areas[:, None], starts) / area[:, None]
    moments = np.add.reduceat(normals[order] * areas[:, None], starts)
    count = np.minimum(PLACES, sizes)
    per_point, of_region = np.repeat(count, sizes), np.repeat(sizes, sizes)
    places = np.flatnonzero(rank * per_point // of_region != (rank - 1) * per_point // of_region)
    total = np.empty((len(sizes), len(sizes)), np.float32)
    sum_solid_angles(
        _single(points[places]), np.append(0, np.cumsum(count)), _single(centers.T), _single(moments.T),
        _single(np.maximum(area / 4, NEAREST**2)), np.searchsorted(starts, ends), np.empty(len(starts), np.float32),
        total,
    )  # fmt: skip
    np.fill_diagonal(total, 0)
    total /= (4 * np.pi * count).astype(np.float32)[:, None]
    return total


def _single(values: Floats) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
