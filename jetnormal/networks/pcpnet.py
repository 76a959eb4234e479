"""PCPNet: the normal straight from a PointNet over balls of several sizes around a point.

Guerrero, Kleiman, Ovsjanikov and Mitra, "PCPNet: Learning Local Shape Properties from Raw Point Clouds", Eurographics
2018. A predicted quaternion rotates the points, a predicted matrix transforms their features. The maxima over the
points of each ball describe it, and fully connected layers map the maxima to the normal: 22,362,055 parameters with
three balls (the 21.3 x 2^20 that Du et al. print) and 3,469,255 with one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.networks.ball_config import BallConfig
from jetnormal.networks.patchfit.layers import PointLayer, full_precision, point_layers
from jetnormal.networks.patchfit.ztransform import rotation_matrix, scaled, zero_linear

DROPOUT = 0.3


@dataclass(frozen=True)
class PCPNetConfig(BallConfig):
    """Configuration of a PCPNet; the defaults are the published multi-scale network.

    The single-scale network has the radii (0.05,). A ball of fewer than `points` points is filled up with copies of the
    query.
    """


class PCPNet(nn.Module):
    """See the module."""

    architecture = "pcpnet"  # in model files

    def __init__(self, config: PCPNetConfig) -> None:
        super().__init__()
        self.config = config
        scales = len(config.radii)
        local, middle, c1, c2, c3 = (scaled(c, config.width) for c in (64, 128, 1024, 512, 256))
        self.turn = _Transform(3, 4, scales, config.width)
        self.local = point_layers([3, local, local])
        self.mix = _Transform(local, local**2, scales, config.width)
        self.features = point_layers([local, local, middle])
        self.describe = PointLayer(middle, c1, nn.ReLU(inplace=True) if scales > 1 else None)
        self.compare = PointLayer(c1, c1 * scales) if scales > 1 else None
        self.join = PointLayer(c1 * scales**2, c1, nn.ReLU(inplace=True)) if scales > 1 else nn.Identity()
        self.read = nn.Sequential(
            point_layers([c1, c2]), nn.Dropout(DROPOUT), point_layers([c2, c3]), nn.Dropout(DROPOUT), nn.Linear(c3, 3)
        )

    def forward(self, points: Tensor, counts: Tensor | None = None) -> Tensor:
        """Find normals.

        Args:
            points: (B, S, n, 3) points of S balls around each query, in radii.
            counts: (B, S) true points of the balls; the others are copies of the query and change no maximum.

        Returns:
            (B, 3) normals of any sign and length.
        """
        rotation = rotation_matrix(self.turn(points))
        with full_precision(points):
            points = points @ rotation[:, None]
        local = self.local(points)
        matrix = self.mix(local).view(len(local), local.shape[-1], local.shape[-1])
        local = local @ (matrix + torch.eye(local.shape[-1], device=points.device)).to(local.dtype)[:, None]
        last = self.describe if self.compare is None else self.compare
        features = self.features(local)
        summary = last.peak(features if self.compare is None else self.describe(features))  # (B, S, C)
        normals = self.read(self.join(summary.flatten(1))).float()
        with full_precision(normals):
            return (rotation @ normals[..., None])[..., 0]

    def estimate(self, points: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Find unit normals and confidences, from the same as `forward`.

        Returns:
            (B, 3) unit vectors of any sign, and (B,) their lengths before, at most 1: a network that is undecided
            between two normals predicts a shorter vector.
        """
        normals = self(points)
        return F.normalize(normals, dim=1), normals.norm(dim=1).clamp(0, 1)

    def for_inference(self) -> PCPNet:
        """Fold the batch normalization into the linear maps; return the network itself, not to be saved again."""
        self.eval().requires_grad_(False)
        for module in self.modules():
            if isinstance(module, PointLayer):
                module.fold()
        return self


class _Transform(nn.Module):
    """A PointNet from the points of several balls to the numbers of a transform, all zero at the start."""

    def __init__(self, inputs: int, outputs: int, scales: int, width: float) -> None:
        super().__init__()
        c1, c2, c3, c4, c5 = (scaled(c, width) for c in (64, 128, 1024, 512, 256))
        self.features = point_layers([inputs, c1, c2])
        self.describe = PointLayer(c2, c3, nn.ReLU(inplace=True))
        joined = [c3 * scales, c3, c4, c5] if scales > 1 else [c3, c4, c5]
        self.read = nn.Sequential(point_layers(joined), zero_linear(c5, outputs))

    def forward(self, points: Tensor) -> Tensor:
        """(B, S, n, C) to (B, outputs)."""
        return self.read(self.describe.peak(self.features(points)).flatten(1))
