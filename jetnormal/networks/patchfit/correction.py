"""The learned correction of a fitted normal ("normal error estimation", Du et al., CVPR 2023, section 4.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from jetnormal.networks.patchfit.layers import PointLayer


class NormalError(nn.Module):
    """Add a residual in (-1, 1)^3 to the rough normal, and normalize: n = n_c + phi([features, n_c]).

    The residual of the query is computed from the pooled features of the patch. In training, the residuals of its
    neighbors are computed from their own features.
    """

    def __init__(self, channels: int, hidden: int = 64) -> None:
        super().__init__()
        self.pooled = PointLayer(channels, channels, nn.ReLU(inplace=True))
        self.query = nn.Linear(channels + 3, 3)
        self.neighbor = nn.Sequential(nn.Linear(channels + 3, hidden), nn.ReLU(), nn.Linear(hidden, 3))

    def forward(self, features: Tensor, rough: Tensor) -> Tensor:
        """(B, k, C) point features and (B, 3) rough unit normals to (B, 3) refined unit normals."""
        summary = self.pooled.peak(features)
        residual = self.query(torch.cat([summary.float(), rough], dim=1)).float().tanh()
        return normalize(rough + residual, dim=1)

    def neighbors(self, features: Tensor, rough: Tensor) -> Tensor:
        """(B, k, C) point features and (B, k, 3) rough unit normals of the neighbors to refined ones."""
        residual = self.neighbor(torch.cat([features, rough.to(features.dtype)], dim=2)).float().tanh()
        return normalize(rough + residual, dim=2)
