"""The output of a weight predictor, and the last layers that all of them share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from jetnormal.networks.patchfit.layers import PointLayer, point_layers
from jetnormal.networks.patchfit.ztransform import scaled, zero_linear

WEIGHT_FLOOR = 0.01  # no neighbor is ruled out, so that every fit keeps full rank


@dataclass(frozen=True)
class Weighting:
    """The output of a weight predictor for B patches: how to fit a jet to their m nearest points, m <= k.

    Attributes:
        weights: (B, m) in (0.01, 1.01).
        features: (B, m, C) the point features that the weights were read from.
        feature_transform: (B, F, F) matrices of the feature transform, or None.
        offsets: (B, m, 3) by which to move the points before the fit, 0 for the query; None moves none.
    """

    weights: Tensor
    features: Tensor
    feature_transform: Tensor | None
    offsets: Tensor | None


class WeightPredictor(nn.Module):
    """Base of the weight predictors: their last layers.

    These compute a weight of each point, and perhaps an offset (AdaFit: Zhu et al., ICCV 2021), from its own features
    and those of its patch.

    A subclass builds its trunk, calls `add_head`, and ends its forward pass with `read`.

    Attributes:
        batch: patches at a time that are fastest on a CPU core, at width 1.
    """

    batch = 16

    def add_head(self, summary: int, local: int, width: float, offsets: bool) -> None:
        """Add the layers from `summary` channels of a patch and `local` ones of a point to weights and offsets."""
        h1, h2, h3 = (scaled(c, width) for c in (512, 256, 128))
        self.first = PointLayer(summary + local, h1, nn.ReLU(inplace=True))
        self.head = point_layers([h1, h2, h3])
        self.weight = nn.Linear(h3, 1)
        self.offset = zero_linear(h3, 3) if offsets else None
        self.channels = h3

    def read(self, summary: Tensor, local: Tensor, feature_transform: Tensor | None) -> Weighting:
        """(B, S) features of patches and (B, m, L) of their points, the query first, to weights and offsets."""
        features = self.head(self.first.split(summary, local))
        weights = WEIGHT_FLOOR + torch.sigmoid(self.weight(features).float())
        offsets = None
        if self.offset is not None:
            offsets = self.offset(features).float()
            offsets = torch.cat([torch.zeros_like(offsets[:, :1]), offsets[:, 1:]], dim=1)
        return Weighting(weights[..., 0], features, feature_transform, offsets)
