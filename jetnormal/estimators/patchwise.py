"""Estimators that look at one patch at a time, in bounded memory.

The classical ones fit a plane (`pca`) or a jet (`jet`) to each patch; a learned one (`PatchFit`) also turns it,
weighs its points and corrects the result. `make_estimator` builds each from a text such as "pca:k=112".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.errors import UsageError
from jetnormal.estimators.base import Estimator, Prediction, joined
from jetnormal.geometry.jet import MAX_ORDER, exponents, fit_jet
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.geometry.patches import Patches, build_patches
from jetnormal.networks.checkpoint import load_model, resolve
from jetnormal.networks.patchfit.network import PatchFit
from jetnormal.support.device import in_order, multiplies_bfloat16, resolve_device, worker_pool
from jetnormal.support.report import Advance

CHUNK_POINTS = 1_000_000  # neighbors gathered at a time, about 100 MB
BATCH_POINTS = 250_000  # neighbors in the default batch of a classical fit, at most: large patches come in few
MAX_BATCH = 256  # patches in the default batch of a network


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
        fit: what it does to a batch of patches.
        batch_size: patches fitted at a time.
        device: where they are fitted.
        threads: CPU threads; None for all cores.
        transform: a network's learned rotations, (B, 3, 3), of patches (B, k, 3); None for a classical fit.
    """

    name: str
    neighbors: int
    fit: Callable[[Patches], _Fit]
    batch_size: int
    device: str = "cpu"
    threads: int | None = None
    transform: Callable[[Tensor], Tensor] | None = None

    def __call__(
        self, points: NDArray[np.float64], queries: NDArray[np.int64] | None = None, advance: Advance | None = None
    ) -> Prediction:
        """See `Estimator`."""
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
    """The normal of the plane through each point's k neighbors (Hoppe et al., 1992)."""

    def fit(patches: Patches) -> _Fit:
        normals = torch.tensor([0.0, 0.0, 1.0]).expand(len(patches.points), 3)
        surface_variation = patches.variance[:, 2] / patches.variance.sum(1).clamp_min(1e-30)
        return _Fit(normals, normals, 1 - 3 * surface_variation, None)

    k = _checked_k(k)
    batch_size = batch_size or min(2048, 1 + BATCH_POINTS // k)
    return PatchEstimator(f"pca:k={k}", k, fit, batch_size, threads=threads)


def jet_estimator(
    k: int = 60, order: int = 2, batch_size: int | None = None, threads: int | None = None
) -> PatchEstimator:
    """The normal of a jet fitted to each point's k neighbors over their plane (Cazals and Pouget, 2005)."""
    if not 1 <= order <= MAX_ORDER:
        raise UsageError(f"the order of a jet is 1 to {MAX_ORDER}, not {order}")

    def fit(patches: Patches) -> _Fit:
        jet = fit_jet(patches.points, None, _order_for(patches.points.shape[1], order))
        rough = torch.tensor([0.0, 0.0, 1.0]).expand(len(patches.points), 3)
        return _Fit(jet.normal, rough, agreement(rough, jet.normal), jet.curvatures()[0])

    k = _checked_k(k)
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
    """A patch network; `k` overrides the patch size that it was trained with.

    Where the CPU can, its matrix products run in bfloat16: features are rounded, but rotations, jets and neighbors are
    not. The RMSE of deepfit-small on the validation benchmark moves by 0.01 degrees.
    """
    network = network.to(device)
    bfloat16 = multiplies_bfloat16(device)

    def fit(patches: Patches) -> _Fit:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            found = network(patches.points, iterations=iterations)
        before = found.rough if network.correction is not None else found.rotation[:, :, 2]
        before = before * torch.where((before * found.refined).sum(1, keepdim=True) < 0, -1.0, 1.0)
        return _Fit(found.refined, before, agreement(before, found.refined), found.jet.curvatures()[0])

    k = _checked_k(k or network.config.neighbors)
    # Narrow layers need more rows to be worth a call, and leave room for them in the cache.
    batch_size = batch_size or min(MAX_BATCH, round(network.weights.batch / network.config.width**2))
    return PatchEstimator(name, k, fit, batch_size, device, threads, network.transform)


def agreement(before: Tensor, after: Tensor) -> Tensor:
    """(B,) share of a right angle that two directions, (B, 3) unit vectors, are not apart: 1 - angle / 90 degrees."""
    sine = torch.linalg.cross(before, after).square().sum(1).sqrt()
    cosine = (before * after).sum(1).abs()
    return 1 - torch.atan2(sine, cosine) / (math.pi / 2)


def make_estimator(
    model: str,
    *,
    k: int | None = None,
    order: int | None = None,
    iterations: int | None = None,
    batch_size: int | None = None,
    device: str = "auto",
    threads: int | None = None,
) -> Estimator:
    """Builds an estimator from its name.

    Args:
        model: "pca", "jet", a packaged network or a model file; settings may follow a colon, as in
            "jet:k=122,order=2" or "deepfit-small:iterations=2".
        k: neighbors in a patch.
        order: of the jet; only for "jet".
        iterations: of a network; see `PatchFit.forward`.
        batch_size: patches at a time.
        device: "auto", "cpu", "cuda" or "cuda:N", for networks.
        threads: CPU threads.

    Raises:
        UsageError: a setting is unknown, out of range, or given to a model without it.
        ModelError: there is no such model, or its file is damaged.
        ResourceError: the device is not there.
    """
    name, settings = _parse(model)
    given = {"k": k, "order": order, "iterations": iterations} | settings
    chosen: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    common: dict[str, Any] = {"batch_size": batch_size, "threads": threads}
    for key in ("batch_size", "threads", "iterations"):
        if (value := (common | chosen).get(key)) is not None and value < 1:
            raise UsageError(f"{key} must be at least 1, not {value}")
    if name == "pca":
        return pca_estimator(**_only(chosen, name, "k"), **common)
    if name == "jet":
        return jet_estimator(**_only(chosen, name, "k", "order"), **common)
    network = load_model(name)
    if not isinstance(network, PatchFit):
        from jetnormal.estimators.whole_cloud import FIT_ROWS, CloudEstimator  # brings numba along

        if device not in ("auto", "cpu"):
            raise UsageError(f"{name} runs on the CPU: leave --device out or choose a patch network")
        return CloudEstimator(
            model, network, **_only(chosen, name, "iterations"), batch_size=batch_size or FIT_ROWS, threads=threads
        )
    chosen = _only(chosen, name, "k", "iterations")
    return network_estimator(model, network, **chosen, **common, device=resolve_device(device))


def model_file(model: str) -> Path | None:
    """The file that a model, given as to `make_estimator`, is loaded from; None for "pca" and "jet".

    Raises:
        UsageError, ModelError: as `make_estimator`.
    """
    name, _ = _parse(model)
    return None if name in ("pca", "jet") else resolve(name)


def _parse(model: str) -> tuple[str, dict[str, int]]:
    """Splits "name:key=value,..." at its last colon; a path may hold colons of its own."""
    name, colon, text = model.rpartition(":")
    if not colon or "=" not in text or Path(model).exists():
        return model, {}
    settings = {}
    for item in text.split(","):
        key, _, value = item.partition("=")
        if key not in ("k", "order", "iterations") or not value.isdigit():
            raise UsageError(f"{model}: {item!r} is no setting; write k=, order= or iterations= and a number")
        settings[key] = int(value)
    return name, settings


def _only(chosen: dict[str, Any], model: str, *allowed: str) -> dict[str, Any]:
    """The chosen settings, all of which the model must have; one iteration is what every model does."""
    for key in chosen:
        if key not in allowed and not (key == "iterations" and chosen[key] == 1):
            raise UsageError(f"the model {model} has no setting {key}; it takes {' and '.join(allowed)}")
    return {key: value for key, value in chosen.items() if key in allowed}


def _checked_k(k: int) -> int:
    if k < 3:
        raise UsageError(f"k must be at least 3, not {k}: fewer points span no plane")
    return k


def _order_for(points: int, order: int) -> int:
    """The largest order up to `order` whose jet has no more monomials than there are points."""
    return max((n for n in range(1, order + 1) if len(exponents(n)) <= points), default=1)


def _split(values: NDArray[np.int64], size: int) -> Iterator[NDArray[np.int64]]:
    return (values[start : start + size] for start in range(0, len(values), size))
