"""DeepFit's weight predictor (Ben-Shabat and Gould, ECCV 2020): a PointNet that says how far to trust each neighbor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from jetnormal.networks.layers import PointLayer, maximum, point_layers
from jetnormal.networks.ztransform import FeatureTransform, scaled

WEIGHT_FLOOR = 0.01  # no neighbor is ruled out, so that every fit keeps full rank


@dataclass(frozen=True)
class Weighting:
    """What a weight predictor says of B patches of k points.

    Attributes:
        weights: (B, k) in (0.01, 1.01).
        features: (B, k, C) the point features that the weights were read from.
        feature_transform: (B, F, F) matrices of the feature transform, or None.
    """

    weights: Tensor
    features: Tensor
    feature_transform: Tensor | None


class DeepFit(nn.Module):
    """Point features, their maximum over the patch, and a weight from both: 2,728,449 parameters at width 1."""

    def __init__(self, width: float = 1.0, feature_transform: bool = True) -> None:
        super().__init__()
        local, middle, summary = (scaled(c, width) for c in (64, 128, 1024))
        h1, h2, h3 = (scaled(c, width) for c in (512, 256, 128))
        self.local = point_layers([3, local, local])
        self.transform = FeatureTransform(local, width) if feature_transform else None
        self.middle = PointLayer(local, middle, nn.ReLU(inplace=True))
        self.summary = PointLayer(middle, summary)
        self.first = PointLayer(summary + local, h1, nn.ReLU(inplace=True))
        self.head = point_layers([h1, h2, h3])
        self.weight = nn.Linear(h3, 1)
        self.channels = h3

    def forward(self, points: Tensor) -> Weighting:
        """(B, k, 3) patches, z close to the normal, to weights."""
        local = self.local(points)
        matrix = None
        if self.transform is not None:
            matrix = self.transform(local)
            local = local @ matrix.to(local.dtype)
        summary = maximum(self.summary(self.middle(local)), 1)
        features = self.head(self.first.split(summary, local))
        weights = WEIGHT_FLOOR + torch.sigmoid(self.weight(features).float())
        return Weighting(weights[..., 0], features, matrix)
