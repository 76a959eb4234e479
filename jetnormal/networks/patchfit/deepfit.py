"""DeepFit's weight predictor (Ben-Shabat and Gould, ECCV 2020): a PointNet that gives each neighbor a weight."""

from __future__ import annotations

from torch import Tensor, nn

from jetnormal.networks.patchfit.layers import PointLayer, point_layers
from jetnormal.networks.patchfit.weighting import Weighting, WeightPredictor
from jetnormal.networks.patchfit.ztransform import FeatureTransform, scaled


class DeepFit(WeightPredictor):
    """Point features, their maximum over the patch, and a weight from both: 2,728,449 parameters at width 1.

    With offsets it is the single-scale AdaFit (387 parameters more).
    """

    def __init__(self, width: float = 1.0, feature_transform: bool = True, offsets: bool = False) -> None:
        super().__init__()
        local, middle, summary = (scaled(c, width) for c in (64, 128, 1024))
        self.local = point_layers([3, local, local])
        self.transform = FeatureTransform(local, width) if feature_transform else None
        self.middle = PointLayer(local, middle, nn.ReLU(inplace=True))
        self.summary = PointLayer(middle, summary)
        self.add_head(summary, local, width, offsets)

    def forward(self, points: Tensor) -> Weighting:
        """(B, k, 3) patches, z close to the normal, to weights of all k points."""
        local = self.local(points)
        matrix = None
        if self.transform is not None:
            matrix = self.transform(local)
            local = local @ matrix.to(local.dtype)
        summary = self.summary.peak(self.middle(local))
        return self.read(summary, local, matrix)
