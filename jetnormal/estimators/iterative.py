"""The estimator of `IterNet`, which fits planes iteratively, on whole clouds or blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction
from jetnormal.estimators.blocks import in_blocks, radius_of
from jetnormal.estimators.patchwise import agreement
from jetnormal.geometry.graph import Graph, build_graph, cloud_spacing
from jetnormal.geometry.neighbors import COLLINEAR
from jetnormal.networks.iternet import IterNet
from jetnormal.support.device import in_order, worker_pool
from jetnormal.support.flops import matrix_products
from jetnormal.support.report import Advance

ROWS = 128  # points at a time by a thread: what they need stays in its cache, and in memory that is used again


@dataclass(frozen=True)
class IterEstimator:
    """An `IterNet` on a cloud of any size.

    The rough normals are those of the planes through all neighbors, from which the iterations start, and the
    confidence is how far the final ones agree with them.

    Attributes:
        name: what it is called.
        network: ready for inference.
        k: neighbors of a point besides itself; None for those of the network's configuration.
        iterations: None for those of the configuration.
        batch_size: points at a time.
        threads: CPU threads; None for all cores.
    """

    name: str
    network: IterNet
    k: int | None = None
    iterations: int | None = None
    batch_size: int = ROWS
    threads: int | None = None
    has_curvature: ClassVar[bool] = False
    min_points: ClassVar[int] = NETWORK_POINTS
    whole_cloud: ClassVar[bool] = True

    @property
    def neighbors(self) -> int:
        """Points in a neighborhood, the point itself included."""
        return 1 + (self.k or self.network.config.neighbors)

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `estimators.base.Estimator`."""
        spacing = cloud_spacing(points, self.threads)

        def block(part: NDArray[np.float64], asked: NDArray[np.int64]) -> list[Prediction]:
            return [self._block(part, spacing, torch.from_numpy(asked), advance)]

        return in_blocks(points, queries, block, self.reach, self.threads)

    @property
    def reach(self) -> float:
        """See `estimators.base.Estimator`: a hop for each iteration, and one for the first planes."""
        return (self._iterations + 1) * radius_of(self.neighbors)

    def cost(self, points: NDArray[np.float64]) -> float:
        """See `estimators.base.Estimator`; counted on some of the points."""
        graph = build_graph(points, self.neighbors, cloud_spacing(points))
        rows = slice(0, min(ROWS, len(points)))
        normals, weights = torch.ones(len(points), 3), torch.ones(len(points), graph.neighbors.shape[1])
        first = matrix_products(lambda: self.network.first(graph, rows))
        each = matrix_products(lambda: self.network.refit(graph, normals, weights[rows], rows))
        return (first + self._iterations * each) / rows.stop

    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """See `estimators.base.Estimator`: no patch is turned."""
        return None

    @property
    def _iterations(self) -> int:
        return self.iterations or self.network.config.iterations

    @torch.inference_mode()
    def _block(
        self, points: NDArray[np.float64], spacing: float, queries: Tensor, advance: Advance | None
    ) -> Prediction:
        """All iterations for some points of a block; earlier iterations also for the points that these depend on."""
        graph = build_graph(points, self.neighbors, spacing, self.threads)
        seen = [queries]
        for _ in range(self._iterations):
            seen.append(_reached(graph, seen[-1]))
        normals, weights = torch.zeros(len(points), 3), torch.zeros(graph.neighbors.shape)
        self._everywhere(graph, seen[-1], normals, weights, None)
        rough = normals.clone()
        for rows in seen[-2:0:-1]:
            self._everywhere(graph, rows, normals, weights, normals.clone())
        last = normals.clone()
        self._everywhere(graph, queries, last, weights, normals, advance)
        return _prediction(graph, queries, last[queries], rough[queries])

    def _everywhere(
        self,
        graph: Graph,
        rows: Tensor,
        normals: Tensor,
        weights: Tensor,
        before: Tensor | None,
        advance: Advance | None = None,
    ) -> None:
        """Compute the next normals and weights of (n,) points, in chunks on threads; without normals, the first."""

        @torch.inference_mode()  # a thread has its own mode
        def work(chunk: Tensor) -> int:
            if before is None:
                normals[chunk], weights[chunk] = self.network.first(graph, chunk)
            else:
                normals[chunk], weights[chunk] = self.network.refit(graph, before, weights[chunk], chunk)
            return len(chunk)

        with worker_pool(self.threads) as pool:
            for done in in_order(pool, work, rows.split(self.batch_size)):
                if advance:
                    advance(done)


def _reached(graph: Graph, rows: Tensor) -> Tensor:
    """(m,) points that are neighbors of some of the (n,) points at `rows`, themselves included, in ascending order."""
    reached = torch.zeros(len(graph.neighbors), dtype=torch.bool)
    reached[graph.neighbors[rows].flatten()] = True
    return reached.nonzero()[:, 0]


def _prediction(graph: Graph, queries: Tensor, normals: Tensor, rough: Tensor) -> Prediction:
    sound = torch.cat([_spans_plane(graph.offsets(rows)) for rows in queries.split(ROWS)])
    nowhere = torch.where(sound, 1.0, torch.nan)[:, None]
    side = torch.where((rough * normals).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return Prediction(
        normals=(normals * nowhere).numpy(),
        rough=(rough * side * nowhere).numpy(),
        confidence=(agreement(rough, normals).clamp(0, 1) * sound).numpy(),
        curvatures=None,
    )


def _spans_plane(offsets: Tensor) -> Tensor:
    """(n,) bool: whether the neighbors at (n, k, 3) are neither collinear nor coincident."""
    centered = (offsets - offsets.mean(1, keepdim=True)).double()
    covariance = centered.transpose(1, 2) @ centered
    trace = covariance.diagonal(dim1=1, dim2=2).sum(1)
    minors = (trace.square() - covariance.square().sum((1, 2))) / 2  # about the product of the two largest eigenvalues
    return minors > COLLINEAR * trace.square()
