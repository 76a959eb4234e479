"""Distances between two surfaces, measured on samples of both."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex

Samples = tuple[NDArray[np.float64], NDArray[np.float64]]


class SurfaceDistance(NamedTuple):
    """Two surfaces compared, in both directions.

    Attributes:
        chamfer: L2 Chamfer distance: the mean squared distance from each sample of one surface to the nearest sample
            of the other, added up over both directions; in the square of the unit. It is not zero for two samples of
            the same surface, but about 2 / pi divided by the number of samples per area.
        normal_consistency: mean of |n.n'| between nearest samples, over both directions; 1 at best.
    """

    chamfer: float
    normal_consistency: float


def surface_distance(first: Samples, second: Samples) -> SurfaceDistance:
    """Compare two surfaces by samples of each: points (N, 3) and unit normals (N, 3)."""
    one_way, other_way = _one_way(first, second), _one_way(second, first)
    return SurfaceDistance(one_way[0] + other_way[0], (one_way[1] + other_way[1]) / 2)


def _one_way(source: Samples, target: Samples) -> tuple[float, float]:
    nearest, distance = NeighborIndex(target[0]).query(source[0], 1)
    cosine = np.einsum("nd,nd->n", source[1], target[1][nearest[:, 0]])
    return float(np.mean(distance**2)), float(np.mean(np.abs(cosine)))
