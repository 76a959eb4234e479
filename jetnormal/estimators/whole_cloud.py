"""The estimator that looks at a whole cloud at a time, or at blocks of a large one, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction, joined
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.geometry.patches import COLLINEAR
from jetnormal.geometry.pyramid import NEIGHBORS, Level, build_pyramid
from jetnormal.networks.cloudfit.network import CloudFit, Encoding
from jetnormal.support.device import in_order, torch_threads, worker_pool
from jetnormal.support.flops import matrix_products
from jetnormal.support.report import Advance

WHOLE = 500_000  # points: a larger cloud is cut into blocks
CORE = 250_000  # points of a block, at most, whose normals are kept
HALO = 60.0  # width of what a block sees around its core, in root mean square distances of the 16 neighbors
HALO_SHARE = 1.5  # points of the halo for each point of the core, at most
SAMPLE = 1000  # points from which the spacing of a block is told
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
        queries = np.arange(len(points)) if queries is None else queries
        blocks = list(_blocks(points, np.arange(len(points)), len(points) if len(points) <= WHOLE else CORE))
        block_of = np.empty(len(points), dtype=np.int32)
        for number, core in enumerate(blocks):
            block_of[core] = number
        place = np.empty(len(points), dtype=np.int64)
        done, parts = [], []
        for number, core in enumerate(blocks):
            asked = np.flatnonzero(block_of[queries] == number)
            if len(asked) == 0:
                continue
            rows = core if len(blocks) == 1 else _with_halo(points, core, self.threads)
            rows = rows[spatial_order(points[rows])]
            place[rows] = np.arange(len(rows))
            asked = asked[np.argsort(place[queries[asked]])]
            done.append(asked)
            parts += self._block(points[rows], place[queries[asked]], advance)
        return joined(parts)[np.argsort(np.concatenate(done))]

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


def _blocks(points: NDArray[np.float64], rows: NDArray[np.int64], largest: int) -> Iterator[NDArray[np.int64]]:
    """Halves the (n,) rows of a cloud across the longest side of their box until none has more than `largest`."""
    if len(rows) <= largest:
        yield rows
        return
    inside = points[rows]
    axis = int(np.argmax(np.ptp(inside, axis=0)))
    order = np.argpartition(inside[:, axis], len(rows) // 2)
    for half in (order[: len(rows) // 2], order[len(rows) // 2 :]):
        yield from _blocks(points, rows[half], largest)


def _with_halo(points: NDArray[np.float64], core: NDArray[np.int64], threads: int | None) -> NDArray[np.int64]:
    """The rows of a block's core and of what lies around its box."""
    inside = points[core]
    sample = inside[:: max(1, len(core) // SAMPLE)]
    _, distances = NeighborIndex(inside, threads=threads).query(sample, min(NEIGHBORS + 1, len(inside)))
    width = HALO * float(np.median(np.sqrt(np.square(distances).mean(axis=1))))
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


def spatial_order(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """An order of (n, 3) points in which near ones are mostly close together (Morton), so that the cache has them."""
    low = points.min(axis=0)
    cells = ((points - low) * (0xFFFF / max(float(np.ptp(points, axis=0).max()), 1e-300))).astype(np.uint64)
    for shift, mask in ((32, 0xFFFF00000000FFFF), (16, 0x00FF0000FF0000FF), (8, 0xF00F00F00F00F00F),
                        (4, 0x30C30C30C30C30C3), (2, 0x9249249249249249)):  # fmt: skip
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.argsort(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)), kind="stable")


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
