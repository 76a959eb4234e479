"""Estimators that look at one patch at a time, in bounded memory.

The classical ones fit a plane (`pca`) or a jet (`jet`) to each patch; a learned one (`PatchFit`) also turns it,
weighs its points and corrects the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.errors import UsageError
from jetnormal.estimators.base import NETWORK_POINTS, Axes, Prediction, joined
from jetnormal.estimators.blocks import radius_of
from jetnormal.estimators.weights import check_finite, usable_weights
from jetnormal.geometry.jet import MAX_ORDER, exponents, fit_jet
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.geometry.patches import Patches, build_patches
from jetnormal.networks.patchfit.network import PatchFit
from jetnormal.support.device import in_order, multiplies_bfloat16, torch_threads, worker_pool
from jetnormal.support.flops import matrix_products
from jetnormal.support.report import Advance

CHUNK_POINTS = 1_000_000  # neighbors gathered at a time, about 100 MB
BATCH_POINTS = 250_000  # neighbors in the default batch of a classical fit, at most: large patches come in few
MAX_BATCH = 256  # patches in the default batch of a network
Z_BATCH = 32  # patches


@dataclass(frozen=True)
class _Fit:
    """Normals of a batch in the patch frame, and curvatures in units of 1 / radius."""

    normals: Tensor
    rough: Tensor
    confidence: Tensor
    curvatures: Tensor | None


@dataclass(frozen=True)
class PatchEstimator:
    """The common part of all estimators that look at one patch at a time.

    Attributes:
        name: what it is called.
        neighbors: points in a patch.
        fit: the function that is applied to a batch of patches.
        batch_size: patches fitted at a time.
        device: where they are fitted.
        threads: CPU threads; None for all cores.
        transform: a network's learned rotations, (B, 3, 3), of patches (B, k, 3); None for a classical fit.
        has_curvature: whether the fit has curvatures.
        min_points: of the smallest cloud that the fit is suited to.
    """

    name: str
    neighbors: int
    fit: Callable[[Patches], _Fit]
    batch_size: int
    device: str = "cpu"
    threads: int | None = None
    transform: Callable[[Tensor], Tensor] | None = None
    has_curvature: bool = True
    min_points: int = 3
    whole_cloud: ClassVar[bool] = False

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `estimators.base.Estimator`."""
        queries = np.arange(len(points)) if queries is None else queries
        k = min(self.neighbors, len(points))
        index = NeighborIndex(points, threads=self.threads)
        parts = []
        # Batches are independent and small enough for the cache: a thread each beats all threads on one.
        with worker_pool(self.threads) as pool:
            for chunk in _split(queries, max(self.batch_size, CHUNK_POINTS // k)):
                found, _ = index.query(points[chunk], k)
                found[:, 0] = chunk  # of coincident points, another may come first
                batches = zip(_split(chunk, self.batch_size), _split(found, self.batch_size), strict=True)
                for part in in_order(pool, lambda batch: self._predict(build_patches(points, *batch)), batches):
                    parts.append(part)
                    if advance:
                        advance(len(part.normals))
        return joined(parts)

    @property
    def reach(self) -> float:
        """See `estimators.base.Estimator`: the size of a patch."""
        return radius_of(self.neighbors)

    def cost(self, points: NDArray[np.float64]) -> float:
        """See `estimators.base.Estimator`; counted on one patch."""
        patch = self._patches(points, np.arange(1))
        return matrix_products(lambda: self.fit(replace(patch, points=patch.points.to(self.device))))

    @torch.inference_mode()
    def z_axes(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Axes | None:
        """See `estimators.base.Estimator`; before the transform, z is the normal of the patch's plane."""
        if self.transform is None:
            return None
        axes: list[tuple[Tensor, Tensor]] = []
        with torch_threads(1):  # small batches stay in the cache of one core
            for batch in _split(queries, Z_BATCH):
                patches = self._patches(points, batch)
                rotation = self.transform(patches.points.to(self.device)).cpu()
                axes.append((patches.frame[:, :, 2], patches.to_cloud(rotation[:, :, 2])))
        before, after = (torch.cat(parts).numpy() for parts in zip(*axes, strict=True))
        return before, after

    def _patches(self, points: NDArray[np.float64], queries: NDArray[np.int64]) -> Patches:
        found, _ = NeighborIndex(points, threads=self.threads).query(points[queries], min(self.neighbors, len(points)))
        found[:, 0] = queries  # of coincident points, another may come first
        return build_patches(points, queries, found)

    @torch.inference_mode()
    def _predict(self, patches: Patches) -> Prediction:
        fit = self.fit(replace(patches, points=patches.points.to(self.device)))
        sound = patches.spans_plane
        nowhere = torch.where(sound, 1.0, torch.nan)

        def finish(values: Tensor) -> NDArray[np.float32]:
            return (values * nowhere[:, None]).numpy()

        curvatures = None
        if fit.curvatures is not None:
            curvatures = finish(fit.curvatures.cpu() / patches.radius[:, None])
        return Prediction(
            normals=finish(patches.to_cloud(fit.normals.cpu())),
            rough=finish(patches.to_cloud(fit.rough.cpu())),
            confidence=(fit.confidence.cpu().clamp(0, 1) * sound).numpy(),
            curvatures=curvatures,
        )


def pca_estimator(k: int = 30, batch_size: int | None = None, threads: int | None = None) -> PatchEstimator:
    """Make an estimator of the plane through each point's k neighbors (Hoppe et al., 1992)."""

    def fit(patches: Patches) -> _Fit:
        normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(patches.points), 3)
        surface_variation = patches.variance[:, 2] / patches.variance.sum(1).clamp_min(1e-30)
        return _Fit(normals, normals, 1 - 3 * surface_variation, None)

    _check_neighbors(k, 1)
    batch_size = batch_size or min(2048, 1 + BATCH_POINTS // k)
    return PatchEstimator(f"pca:k={k}", k, fit, batch_size, threads=threads, has_curvature=False)


def jet_estimator(
    k: int = 60, order: int = 2, batch_size: int | None = None, threads: int | None = None
) -> PatchEstimator:
    """Make an estimator of a jet over the plane of each point's k neighbors (Cazals and Pouget, 2005)."""
    if not 1 <= order <= MAX_ORDER:
        raise UsageError(f"the order of a jet is 1 to {MAX_ORDER}, not {order}")

    def fit(patches: Patches) -> _Fit:
        jet = fit_jet(patches.points, None, _order_for(patches.points.shape[1], order))
        rough = torch.tensor([0.0, 0.0, 1.0]).expand(len(patches.points), 3)
        return _Fit(jet.normal, rough, agreement(rough, jet.normal), jet.curvatures()[0])

    _check_neighbors(k, order)
    batch_size = batch_size or min(512, 1 + BATCH_POINTS // k)
    return PatchEstimator(f"jet:k={k},order={order}", k, fit, batch_size, threads=threads)


def network_estimator(
    name: str,
    network: PatchFit,
    k: int | None = None,
    iterations: int = 1,
    batch_size: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> PatchEstimator:
    """Make an estimator of a patch network; `k` overrides the patch size that it was trained with.

    Where the CPU can, its matrix products run in bfloat16: features are rounded, but rotations, jets and neighbors are
    not. The RMSE of deepfit-small on the validation benchmark moves by 0.01 degrees.
    """
    network = network.to(device)
    bfloat16 = multiplies_bfloat16(device)

    def fit(patches: Patches) -> _Fit:
        with usable_weights(name), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            found = network(patches.points, iterations=iterations)
            curvatures = found.jet.curvatures()[0]
        check_finite(found.refined, name)
        before = found.rough if network.correction is not None else found.rotation[:, :, 2]
        before = before * torch.where((before * found.refined).sum(1, keepdim=True) < 0, -1.0, 1.0)
        return _Fit(found.refined, before, agreement(before, found.refined), curvatures)

    k = k or network.config.neighbors
    _check_neighbors(k, network.config.order)
    # Narrow layers need more rows to be worth a call, and leave room for them in the cache.
    batch_size = batch_size or min(MAX_BATCH, round(network.weights.batch / network.config.width**2))
    return PatchEstimator(name, k, fit, batch_size, device, threads, network.transform, min_points=NETWORK_POINTS)


def agreement(before: Tensor, after: Tensor) -> Tensor:
    """Return (B,) agreement of directions, (B, 3) unit vectors: 1 - angle / 90 degrees."""
    sine = torch.linalg.cross(before, after).square().sum(1).sqrt()
    cosine = (before * after).sum(1).abs()
    return 1 - torch.atan2(sine, cosine) / (math.pi / 2)


def _check_neighbors(k: int, order: int) -> None:
    """Refuse fewer neighbors than a jet has coefficients; a plane is a jet of order 1."""
    least = len(exponents(order))
    if k < least:
        raise UsageError(f"k must be at least {least}, not {k}: so many points determine a jet of order {order}")


def _order_for(points: int, order: int) -> int:
    """The largest order up to `order` whose jet has no more monomials than there are points."""
    return max((n for n in range(1, order + 1) if len(exponents(n)) <= points), default=1)


def _split(values: NDArray[np.int64], size: int) -> Iterator[NDArray[np.int64]]:
    return (values[start : start + size] for start in range(0, len(values), size))
