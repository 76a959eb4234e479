"""The estimator that looks at a whole cloud at a time, or at blocks of a large one, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction
from jetnormal.estimators.blocks import in_blocks
from jetnormal.geometry.patches import COLLINEAR
from jetnormal.geometry.pyramid import NEIGHBORS, Level, build_pyramid
from jetnormal.networks.cloudfit.network import CloudFit, Encoding
from jetnormal.support.device import in_order, torch_threads, worker_pool
from jetnormal.support.flops import matrix_products
from jetnormal.support.report import Advance

FIT_ROWS = 2048  # points fitted at a time by a thread: what they need stays in its cache


@dataclass(frozen=True)
class CloudEstimator:
    """A `CloudFit` network on a cloud of any size.

    Attributes:
        name: what it is called.
        network: ready for inference.
        iterations: of the fit; see `CloudFit.fit`.
        batch_size: points fitted at a time.
        threads: CPU threads; None for all cores.
        neighbors: of a point in each level of the pyramid, the point itself included.
    """

    name: str
    network: CloudFit
    iterations: int = 1
    batch_size: int = FIT_ROWS
    threads: int | None = None
    neighbors: int = NEIGHBORS + 1
    has_curvature: ClassVar[bool] = True
    min_points: ClassVar[int] = NETWORK_POINTS
    whole_cloud: ClassVar[bool] = True

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `estimators.base.Estimator`."""
        return in_blocks(points, queries, lambda part, asked: self._block(part, asked, advance), self.threads)

    def cost(self, points: NDArray[np.float64]) -> float:
        """See `estimators.base.Estimator`; without the compiled loops over edges."""
        pyramid = build_pyramid(points - points.mean(axis=0), len(self.network.config.channels))
        rows = torch.arange(len(points))
        return matrix_products(lambda: self.network.fit(self.network.encode(pyramid), rows)) / len(points)

    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """See `estimators.base.Estimator`: the transform is not of a patch."""
        return None

    @torch.inference_mode()
    def _block(
        self, points: NDArray[np.float64], queries: NDArray[np.int64], advance: Advance | None
    ) -> list[Prediction]:
        with torch_threads(self.threads):
            pyramid = build_pyramid(points - points.mean(axis=0), len(self.network.config.channels), self.threads)
            encoding = self.network.encode(pyramid)
        return self.fit_all(encoding, pyramid, torch.from_numpy(queries), advance)

    def fit_all(
        self, encoding: Encoding, pyramid: list[Level], queries: Tensor, advance: Advance | None = None
    ) -> list[Prediction]:
        """The fit for (Q,) queries of an encoded cloud, in chunks, a thread each."""
        sound = _spans_plane(pyramid, encoding.parents)
        parts = []
        chunks = queries.split(self.batch_size)
        with worker_pool(self.threads) as pool:
            for part in in_order(pool, lambda chunk: self._fit(encoding, sound[chunk], chunk), chunks):
                parts.append(part)
                if advance:
                    advance(len(part.normals))
        return parts

    @torch.inference_mode()
    def _fit(self, encoding: Encoding, sound: Tensor, queries: Tensor) -> Prediction:
        fit = self.network.fit(encoding, queries, self.iterations)
        nowhere = torch.where(sound, 1.0, torch.nan)[:, None]
        side = torch.where((fit.rough * fit.refined).sum(1, keepdim=True) < 0, -1.0, 1.0)
        return Prediction(
            normals=(fit.refined * nowhere).numpy(),
            rough=(fit.rough * side * nowhere).numpy(),
            confidence=(torch.sigmoid(fit.confidence) * sound).numpy(),
            curvatures=(fit.jet.curvatures()[0] / fit.unit[:, None] * nowhere).numpy(),
        )


def _spans_plane(pyramid: list[Level], parents: list[Tensor]) -> Tensor:
    """(N,) bool: whether the neighbors of a point, in some level, are neither collinear nor coincident."""
    ancestor = torch.arange(len(pyramid[0].positions))
    sound = torch.zeros(len(ancestor), dtype=torch.bool)
    for number, level in enumerate(pyramid):
        if number:
            ancestor = parents[number - 1][ancestor]
        variance = torch.from_numpy(level.variance)[ancestor]
        sound |= variance[:, 1] > COLLINEAR * variance[:, 2]
    return sound
