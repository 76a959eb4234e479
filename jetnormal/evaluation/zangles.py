"""How near to the z axis a learned transform brings the true normals (Du et al., CVPR 2023, fig. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import BenchmarkCloud
from jetnormal.geometry.metrics import angles

SAMPLE = 1000  # points of a cloud that are measured, at most
BATCH = 32


@dataclass(frozen=True)
class ZAngles:
    """Angles between true normals and the z axis of their patches, in degrees, signs left aside.

    Attributes:
        rows: (S,) which of the points evaluated were measured.
        before: (S,) float32 in the frame of the patch's principal axes, where z is the normal of a plane.
        after: (S,) float32 in the frame that the learned transform turns the patch into.
    """

    rows: NDArray[np.int64]
    before: NDArray[np.float32]
    after: NDArray[np.float32]


def measure_z_angles(estimator: Estimator, cloud: BenchmarkCloud) -> ZAngles | None:
    """Applies the transform of a patch network to an even selection of the points evaluated.

    Returns:
        The angles; None if the estimator has no learned transform.
    """
    import torch

    from jetnormal.estimators.patchwise import PatchEstimator
    from jetnormal.geometry.neighbors import NeighborIndex
    from jetnormal.geometry.patches import build_patches
    from jetnormal.support.device import torch_threads

    if not isinstance(estimator, PatchEstimator) or estimator.transform is None:
        return None
    points, queries = cloud.points, cloud.queries
    rows = np.arange(0, len(queries), -(-len(queries) // SAMPLE))
    index = NeighborIndex(points, threads=estimator.threads)
    found: list[NDArray[np.float64]] = []
    with torch.inference_mode(), torch_threads(1):  # small batches stay in the cache of one core
        for start in range(0, len(rows), BATCH):
            batch = queries[rows[start : start + BATCH]]
            neighbors, _ = index.query(points[batch], min(estimator.neighbors, len(points)))
            neighbors[:, 0] = batch  # of coincident points, another may come first
            patches = build_patches(points, batch, neighbors)
            rotation = estimator.transform(patches.points.to(estimator.device)).cpu()
            axes = (patches.frame[:, :, 2], patches.to_cloud(rotation[:, :, 2]))
            true = cloud.normals[batch]
            found.append(np.stack([angles(axis.numpy(), true) for axis in axes]))
    before, after = np.concatenate(found, axis=1).astype(np.float32)
    return ZAngles(rows, before, after)
