"""The estimator of networks that look at balls of several sizes around a point: `PCPNet` and `NestiNet`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction, joined
from jetnormal.geometry.balls import BallIndex
from jetnormal.networks.nestinet import NestiNet
from jetnormal.networks.pcpnet import PCPNet
from jetnormal.support.device import in_order, worker_pool
from jetnormal.support.flops import matrix_products
from jetnormal.support.report import Advance

BATCH = 16  # queries


@dataclass(frozen=True)
class BallEstimator:
    """A network on the balls around each point.

    There is only one step, so the rough normals are the normals themselves. The confidence is the network's own, see
    `PCPNet.estimate` and `NestiNet.estimate`.

    Attributes:
        name: what it is called.
        network: ready for inference.
        batch_size: queries at a time.
        device: where the network runs.
        threads: CPU threads; None for all cores.
    """

    name: str
    network: PCPNet | NestiNet
    batch_size: int = BATCH
    device: str = "cpu"
    threads: int | None = None
    has_curvature: ClassVar[bool] = False
    min_points: ClassVar[int] = NETWORK_POINTS
    whole_cloud: ClassVar[bool] = False
    reach: ClassVar[float] = math.inf

    @property
    def neighbors(self) -> int:
        """Points of a ball, at most."""
        return self.network.config.points

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `estimators.base.Estimator`."""
        queries = np.arange(len(points)) if queries is None else queries
        index = BallIndex(points)
        batches = [queries[start : start + self.batch_size] for start in range(0, len(queries), self.batch_size)]
        parts = []
        with worker_pool(self.threads) as pool:
            for part in in_order(pool, lambda batch: self._predict(index, batch), batches):
                parts.append(part)
                if advance:
                    advance(len(part.normals))
        return joined(parts)

    def cost(self, points: NDArray[np.float64]) -> float:
        """See `estimators.base.Estimator`; counted on one query."""
        return matrix_products(lambda: self._predict(BallIndex(points), np.arange(1)))

    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """See `estimators.base.Estimator`; none, for the rotation of the balls is not meant to meet the normal."""
        return None

    @torch.inference_mode()
    def _predict(self, index: BallIndex, queries: NDArray[np.int64]) -> Prediction:
        config = self.network.config
        balls = index.balls(queries, config.radii, config.points, config.principal_axes)
        found, confidence = self.network.estimate(balls.points.to(self.device), balls.counts.to(self.device))
        nowhere = torch.where(balls.spans_plane, 1.0, torch.nan)[:, None]
        normals = ((balls.frame @ found.cpu()[..., None])[..., 0] * nowhere).numpy()
        return Prediction(normals, normals, (confidence.cpu() * balls.spans_plane).numpy(), None)
