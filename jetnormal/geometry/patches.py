"""Patches: the k nearest neighbors of a query, in a frame of their own.

A patch is moved so that its query is the origin, divided by its radius, and rotated into its principal axes. What a
network or a jet sees therefore does not depend on where the patch lies, how large it is and how it is rotated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.geometry.neighbors import COLLINEAR


@dataclass(frozen=True)
class Patches:
    """A batch of B patches with k points each.

    Attributes:
        points: (B, k, 3) coordinates in the patch frame, inside the unit ball; the query is the origin and the
            points keep the order of their neighbors (ascending distance).
        frame: (B, 3, 3) rotations whose columns are the patch's principal axes in the cloud's coordinates, by
            descending variance: `patch = cloud @ frame` and `cloud = patch @ frame.T` for row vectors.
        radius: (B,) distance of the farthest neighbor, in the cloud's unit; 0 where all neighbors coincide.
        variance: (B, 3) variances of the points along the principal axes, descending, in units of radius^2.
    """

    points: Tensor
    frame: Tensor
    radius: Tensor
    variance: Tensor

    @property
    def spans_plane(self) -> Tensor:
        """(B,) bool: whether the points span a plane, that is, are neither collinear nor coincident."""
        return self.variance[:, 1] > COLLINEAR * self.variance[:, 0]

    def to_cloud(self, vectors: Tensor) -> Tensor:
        """Rotate one vector per patch, (B, 3), from the patch frame into the cloud's frame."""
        return torch.einsum("bij,bj->bi", self.frame.to(vectors.dtype), vectors)

    def to_patch(self, vectors: Tensor) -> Tensor:
        """Rotate vectors (B, k, 3) or (B, 3) from the cloud's frame into the patch frame."""
        return torch.einsum("b...i,bij->b...j", vectors, self.frame.to(vectors.dtype))


def build_patches(
    points: NDArray[np.float64],
    queries: NDArray[np.int64],
    neighbors: NDArray[np.int64],
    dtype: torch.dtype = torch.float32,
) -> Patches:
    """Gather patches and bring each into its own frame.

    Everything is computed in float64, so that large (georeferenced) coordinates lose nothing; the result is rounded to
    `dtype`.

    Args:
        points: (N, 3) the cloud.
        queries: (B,) index of the query of each patch.
        neighbors: (B, k) indices of its neighbors, by ascending distance.
        dtype: type of the returned tensors.
    """
    offsets = torch.from_numpy(points[neighbors] - points[queries][:, None])  # (B, k, 3)
    radius = offsets.square().sum(2).amax(1).sqrt()
    unit = offsets / radius.clamp_min(torch.finfo(torch.float64).tiny)[:, None, None]
    frame, variance = principal_frame(unit)
    return Patches((unit @ frame).to(dtype), frame.to(dtype), radius.to(dtype), variance.to(dtype))


def principal_frame(points: Tensor) -> tuple[Tensor, Tensor]:
    """Find the principal axes of each patch, as a proper rotation, and the variances along them.

    An axis is only known up to its sign. The data decide it, so that a rotated patch gets a rotated frame: the mean of
    the patch has a positive z, the third moment along x is positive, and y makes the frame right-handed.

    Args:
        points: (B, k, 3) with the query at the origin.

    Returns:
        (B, 3, 3) axes as columns and (B, 3) variances, both by descending variance.
    """
    mean = points.mean(1, keepdim=True)
    centered = points - mean
    values, axes = torch.linalg.eigh(centered.transpose(1, 2) @ centered / points.shape[1])  # ascending
    x, z = axes[:, :, 2], axes[:, :, 0]
    z = z * sign((mean[:, 0] * z).sum(1, keepdim=True))
    x = x * sign((centered @ x[:, :, None]).pow(3).sum(1))
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=2), values.flip(1).clamp_min(0)


def sign(values: Tensor) -> Tensor:
    """Return +1 or -1, and +1 at zero."""
    return torch.where(values < 0, -torch.ones_like(values), torch.ones_like(values))
