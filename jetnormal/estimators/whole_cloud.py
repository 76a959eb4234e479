"""The estimator of `CloudFit`, which sees a whole cloud at once, or blocks of a large one, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction, no_finite_normals
from jetnormal.estimators.blocks import in_blocks
from jetnormal.geometry.neighbors import COLLINEAR
from jetnormal.geometry.pyramid import NEIGHBORS, Pyramid, build_pyramid
from jetnormal.networks.cloudfit.config import CloudFitConfig
from jetnormal.networks.cloudfit.curvature import add_equations, principal
from jetnormal.networks.cloudfit.inference import Found, Inference
from jetnormal.support.device import available_cores
from jetnormal.support.report import Advance

if TYPE_CHECKING:
    from jetnormal.networks.cloudfit.network import CloudFit

REACH_LEVELS = 2  # whose hops tell how far a point sees
CURVATURE_LEVELS = 3  # whose normals take part in the curvature
CURVATURE_ROWS = 8192  # points that a thread takes at a time


@dataclass(frozen=True)
class CloudEstimator:
    """A `CloudFit` network on a cloud of any size.

    Attributes:
        name: what it is called.
        config: of the network.
        find: the network, a function of pyramid and threads that returns the normals of all points.
        threads: CPU threads; None for all cores.
        neighbors: of a point in each level of the pyramid, the point itself included.
    """

    name: str
    config: CloudFitConfig
    find: Callable[[Pyramid, int | None], Found]
    threads: int | None = None
    neighbors: int = NEIGHBORS + 1
    has_curvature: ClassVar[bool] = True
    min_points: ClassVar[int] = NETWORK_POINTS
    whole_cloud: ClassVar[bool] = True

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `estimators.base.Estimator`."""

        def estimate(block: NDArray[np.float64], asked: NDArray[np.int64]) -> list[Prediction]:
            prediction = self._block(block)[asked]
            if advance:
                advance(len(asked))
            return [prediction]

        return in_blocks(points, queries, estimate, self.reach, self.threads)

    @property
    def reach(self) -> float:
        """See `estimators.base.Estimator`: the hops of the two finest levels, from a point to its farthest neighbor.

        At each level, these are a hop for each layer and each vote, and those to and from the coarser level. What
        coarser levels see beyond hardly matters: with 25, where each level voted once, normals of a noisy solid and of
        a terrestrial scan, a million points each, differed from those without blocks by 0.0003 degrees (rms); with 10,
        by 0.03.
        """
        layers = zip(self.config.up_layers, self.config.down_layers, strict=True)
        hops = [up + down + self.config.votes(level) + 2 for level, (up, down) in enumerate(layers)]
        return float(sum(np.sqrt(2) * 2**level * count for level, count in enumerate(hops[:REACH_LEVELS])))

    def cost(self, points: NDArray[np.float64]) -> float:
        """See `estimators.base.Estimator`; without the compiled loops over edges."""
        import torch

        from jetnormal.networks.cloudfit.network import CloudFit
        from jetnormal.support.flops import matrix_products

        network = CloudFit(self.config).for_inference()
        pyramid = build_pyramid(points - points.mean(axis=0), len(self.config.channels))
        with torch.inference_mode():
            return matrix_products(lambda: network(pyramid)) / len(points)

    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """See `estimators.base.Estimator`: the transform is not of a patch."""
        return None

    def _block(self, points: NDArray[np.float64]) -> Prediction:
        """The prediction for all points of a block."""
        points = points - np.median(points, axis=0)  # a few that are far away take no digit from the others
        pyramid = build_pyramid(points, len(self.config.channels), self.threads)
        found = self.find(pyramid, self.threads)
        if not np.isfinite(found.normals).all(axis=1).any():
            raise no_finite_normals(self.name)
        ancestors = _ancestors(pyramid)
        curvatures = _curvatures(points, found, pyramid, ancestors, self.threads)
        sound = _spans_plane(pyramid, ancestors)
        nowhere = np.where(sound, np.float32(1), np.float32(np.nan))[:, None]
        behind = np.einsum("ij,ij->i", found.rough, found.normals) < 0
        rough = np.where(behind[:, None], -found.rough, found.rough)
        confidence = sound / (1 + np.exp(-found.confidence))
        return Prediction(found.normals * nowhere, rough * nowhere, confidence, curvatures * nowhere)


def cloud_estimator(name: str, path: Path, device: str = "cpu", threads: int | None = None) -> CloudEstimator:
    """Make the estimator of a model file: by NumPy on the CPU, by PyTorch on a CUDA device.

    Raises:
        ModelError: the file is damaged, or holds another network.
    """
    if device == "cpu":
        inference = Inference.load(path)
        return CloudEstimator(name, inference.config, inference, threads)
    from jetnormal.networks.checkpoint import load_model
    from jetnormal.networks.cloudfit.network import CloudFit

    network = load_model(path)
    assert isinstance(network, CloudFit)
    return CloudEstimator(name, network.config, on_device(network, device), threads)


def on_device(network: CloudFit, device: str) -> Callable[[Pyramid, int | None], Found]:
    """Return a network in PyTorch as the `find` of an estimator."""
    import torch

    from jetnormal.support.device import torch_threads

    network = network.to(device)

    def find(pyramid: Pyramid, threads: int | None) -> Found:
        with torch_threads(threads), torch.inference_mode():
            said = network(pyramid)
            normals, rough, confidence = (t.cpu().numpy() for t in (said.normals, said.rough, said.confidence))
            return Found(normals, rough, confidence, [nodes.normals.cpu().numpy() for nodes in said.levels])

    return find


def _ancestors(pyramid: Pyramid) -> list[NDArray[np.int64]]:
    """For each level, the (N,) point of it that stands for each point of the cloud."""
    first = np.empty(len(pyramid.kept) + len(pyramid.left_out), dtype=np.int64)
    first[pyramid.kept] = np.arange(len(pyramid.kept))
    first[pyramid.left_out] = pyramid.carried.neighbors[:, 0]
    ancestors = [first]
    for level in pyramid.levels[:-1]:
        ancestors.append(level.parents[ancestors[-1], 0].astype(np.int64))
    return ancestors


def _spans_plane(pyramid: Pyramid, ancestors: list[NDArray[np.int64]]) -> NDArray[np.bool_]:
    """(N,) whether the neighbors of a point, in some level, are neither collinear nor coincident."""
    sound = np.zeros(len(ancestors[0]), dtype=np.bool_)
    for level, ancestor in zip(pyramid.levels, ancestors, strict=True):
        sound |= (level.variance[:, 1] > COLLINEAR * level.variance[:, 2])[ancestor]
    return sound


def _curvatures(
    points: NDArray[np.float64],
    found: Found,
    pyramid: Pyramid,
    ancestors: list[NDArray[np.int64]],
    threads: int | None,
) -> NDArray[np.float32]:
    """(N, 2) principal curvatures from the normals of the finest levels, see `curvature.principal`."""
    neighbors = []
    for level in pyramid.levels[:CURVATURE_LEVELS]:
        own = np.arange(len(level.positions), dtype=np.int32)[:, None]
        neighbors.append(np.concatenate([own, level.neighbors], axis=1))

    def fit(start: int) -> NDArray[np.float32]:
        rows = slice(start, start + CURVATURE_ROWS)
        sums = np.zeros((len(points[rows]), 6))
        for level, normals, ancestor, near in zip(pyramid.levels, found.levels, ancestors, neighbors, strict=False):
            add_equations(points[rows], found.normals[rows], ancestor[rows], level.positions, normals, near, sums)
        return principal(sums)

    with ThreadPoolExecutor(threads or available_cores()) as pool:
        return np.concatenate(list(pool.map(fit, range(0, len(points), CURVATURE_ROWS))))
