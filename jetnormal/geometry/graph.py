"""The graph of a cloud: each point with its nearest neighbors, in the cloud's own unit of length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.geometry.neighbors import NeighborIndex

SPACING_NEIGHBORS = 16
SPACING_SAMPLE = 2000  # points from which the spacing is told


@dataclass(frozen=True)
class Graph:
    """N points with k neighbors each, the point itself among them.

    Attributes:
        positions: (N, 3) float64, in spacings of the cloud.
        neighbors: (N, k) int64 rows of `positions`, by ascending distance; a point is its own first neighbor.
    """

    positions: Tensor
    neighbors: Tensor

    def offsets(self, rows: slice | Tensor) -> Tensor:
        """Return (n, k, 3) float32 from some of the points to their neighbors."""
        return (self.positions[self.neighbors[rows]] - self.positions[rows][:, None]).float()


def build_graph(points: NDArray[np.float64], k: int, spacing: float, threads: int | None = None) -> Graph:
    """Connect each point with its k nearest ones, itself included; a smaller cloud is connected altogether.

    Args:
        points: (N, 3) finite coordinates, N >= 1.
        k: neighbors, at least 1.
        spacing: unit of length of the result, see `cloud_spacing`.
        threads: CPU threads of the search; None for all cores.
    """
    found, _ = NeighborIndex(points, threads=threads).query(points, min(k, len(points)))
    found[:, 0] = np.arange(len(points))  # of coincident points, another may come first
    return Graph(torch.from_numpy((points - points.mean(axis=0)) / spacing), torch.from_numpy(found))


def cloud_spacing(points: NDArray[np.float64], threads: int | None = None) -> float:
    """Find the typical distance between neighbors: the root mean square of the components of the offsets to the 16
    nearest points, its median over a sample of the cloud; 1 where most points coincide.

    The median leaves stray points and thinned regions aside.
    """
    sample = points[:: -(-len(points) // SPACING_SAMPLE)]
    k = min(SPACING_NEIGHBORS + 1, len(points))
    _, distances = NeighborIndex(points, threads=threads).query(sample, k)
    return float(np.median(np.sqrt(np.square(distances).mean(axis=1) / 3))) or 1.0
