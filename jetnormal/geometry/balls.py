"""Balls of several radii around points, for networks that compare sizes of neighborhoods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from jetnormal.geometry.neighbors import COLLINEAR
from jetnormal.geometry.patches import principal_frame


@dataclass(frozen=True)
class Balls:
    """B batches of S balls each, all around the same query.

    Attributes:
        points: (B, S, n, 3) float32 offsets from the query, in units of each ball's radius; the first is the query
            itself, and copies of it stand where a ball has fewer points.
        counts: (B, S) int64 true points of each ball.
        frame: (B, 3, 3) float32 rotations: `ball = cloud @ frame` and `cloud = ball @ frame.T` for row vectors.
        spans_plane: (B,) bool whether the points of the largest ball are neither collinear nor coincident.
    """

    points: Tensor
    counts: Tensor
    frame: Tensor
    spans_plane: Tensor


class BallIndex:
    """Points of a cloud by distance.

    Args:
        points: (N, 3) finite coordinates, N >= 1.
    """

    def __init__(self, points: NDArray[np.float64]) -> None:
        self.points = points - (points.min(axis=0) + points.max(axis=0)) / 2
        self.diagonal = float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0
        self._tree = cKDTree(self.points)

    def balls(
        self, queries: NDArray[np.int64], radii: tuple[float, ...], size: int, principal_axes: bool = False
    ) -> Balls:
        """Gather the balls around some points.

        Which points of a full ball are drawn depends on nothing but the query's index.

        Args:
            queries: (B,) rows of the points.
            radii: S, in diagonals of the bounding box of the cloud.
            size: points of a ball, at most.
            principal_axes: whether the frame is that of the principal axes of the largest ball; else it is the cloud's.
        """
        offsets = np.zeros((len(queries), len(radii), size, 3))
        counts = np.empty((len(queries), len(radii)), dtype=np.int64)
        for scale, radius in enumerate(radii):
            length = radius * self.diagonal
            found = self._tree.query_ball_point(self.points[queries], length, return_sorted=True)
            for row, (query, inside) in enumerate(zip(queries, found, strict=True)):
                chosen = _drawn(int(query), np.asarray(inside), size)
                counts[row, scale] = len(chosen)
                offsets[row, scale, : len(chosen)] = (self.points[chosen] - self.points[query]) / length
        points, count = torch.from_numpy(offsets), torch.from_numpy(counts)
        widest = int(np.argmax(radii))
        frame, variance = _principal_frame(points[:, widest], count[:, widest])
        sound = variance[:, 1] > COLLINEAR * variance[:, 0]
        if not principal_axes:
            frame = torch.eye(3, dtype=points.dtype).expand_as(frame)
        return Balls((points @ frame[:, None]).float(), count, frame.float(), sound)


def _drawn(query: int, inside: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """The query and, of the (m,) points inside its ball, as many as there is room for."""
    others = inside[inside != query]
    if len(others) >= size:
        others = np.random.default_rng(query).choice(others, size - 1, replace=False)
    return np.concatenate([[query], others])


def _principal_frame(points: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """`principal_frame` of (B, n, 3) points, of which the first `counts` count: those behind are set to their mean."""
    there = (torch.arange(points.shape[1]) < counts[:, None])[..., None]
    mean = (points * there).sum(1, keepdim=True) / counts[:, None, None]
    return principal_frame(torch.where(there, points, mean))
