"""How close to the z axis a learned transform brings the true normals (Du et al., CVPR 2023, fig. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import BenchmarkCloud
from jetnormal.geometry.metrics import angles

SAMPLE = 1000  # points of a cloud that are measured, at most


@dataclass(frozen=True)
class ZAngles:
    """Angles between true normals and the z axis of their patches, in degrees, regardless of sign.

    Attributes:
        rows: (S,) which of the points evaluated were measured.
        before: (S,) float32 in the frame of the patch's principal axes, where z is the normal of a plane.
        after: (S,) float32 in the frame that the learned transform turns the patch into.
    """

    rows: NDArray[np.int64]
    before: NDArray[np.float32]
    after: NDArray[np.float32]


def measure_z_angles(estimator: Estimator, cloud: BenchmarkCloud) -> ZAngles | None:
    """Apply the transform of a patch network to an even selection of the points evaluated.

    Returns:
        The angles; None if the estimator has no learned transform.
    """
    rows = np.arange(0, len(cloud.queries), -(-len(cloud.queries) // SAMPLE))
    queries = cloud.queries[rows]
    axes = estimator.z_axes(cloud.points, queries)
    if axes is None:
        return None
    before, after = (angles(axis, cloud.normals[queries]).astype(np.float32) for axis in axes)
    return ZAngles(rows, before, after)
