"""AdaFit's weight predictor (Zhu et al., ICCV 2021): a PointNet over three nested scales that also moves the points."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jetnormal.networks.patchfit.layers import PointLayer, point_layers
from jetnormal.networks.patchfit.weighting import Weighting, WeightPredictor
from jetnormal.networks.patchfit.ztransform import FeatureTransform, scaled


class AdaFit(WeightPredictor):
    """Point features through cascaded scale aggregation (700, 350, 175 points), then as DeepFit.

    The points of a patch come by distance from the query, so that a scale is a prefix of the one before. The jet is
    fitted to the smallest scale, a quarter of the patch, whose points are moved first. 3,372,228 parameters at
    width 1.
    """

    batch = 8

    def __init__(self, width: float = 1.0, feature_transform: bool = True, offsets: bool = True) -> None:
        super().__init__()
        local, middle, wide, summary = (scaled(c, width) for c in (64, 128, 256, 1024))
        self.local = point_layers([3, local, local])
        self.transform = FeatureTransform(local, width) if feature_transform else None
        self.middle = PointLayer(local, middle, nn.ReLU(inplace=True))
        self.large = ScaleAggregation(middle, wide)
        self.small = ScaleAggregation(wide, wide, self.large.channels)
        self.summary = PointLayer(wide, summary)
        self.add_head(summary, wide, width, offsets)

    def forward(self, points: Tensor) -> Weighting:
        """(B, k, 3) patches, z close to the normal, to weights and offsets of the nearest quarter of the points."""
        half, quarter = (max(1, points.shape[1] // n) for n in (2, 4))
        features = self.local(points)
        matrix = None
        if self.transform is not None:
            matrix = self.transform(features)
            features = features @ matrix.to(features.dtype)
        features, outer = self.large(self.middle(features), half)
        features, _ = self.small(features, quarter, outer)
        summary = self.summary.peak(features)
        return self.read(summary, features, matrix)


class ScaleAggregation(nn.Module):
    """One step of the cascade: keep the nearest points of a scale, each with a summary of the whole scale.

    Args:
        inputs: channels of a point.
        outputs: channels of a point that is kept.
        outer: channels of the summary of the larger scale, 0 if there is none.
    """

    def __init__(self, inputs: int, outputs: int, outer: int = 0) -> None:
        super().__init__()
        self.channels = inputs // 2
        self.widen = PointLayer(inputs, 2 * inputs, nn.ReLU(inplace=True))
        self.narrow = PointLayer(2 * inputs, self.channels, nn.ReLU(inplace=True))
        self.join = PointLayer(self.channels + outer + inputs, outputs, nn.ReLU(inplace=True))

    def forward(self, features: Tensor, count: int, outer: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(B, n, C_in) features and the (B, outer) summary of the larger scale, if there is one.

        Returns:
            (B, count, C_out) features of the nearest points and the (B, C_in / 2) summary of this scale.
        """
        summary = self.narrow(self.widen.peak(features))
        shared = summary if outer is None else torch.cat([summary, outer], dim=1)
        return self.join.split(shared, features[:, :count]), summary
