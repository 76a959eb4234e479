"""GraphFit's weight predictor (Li et al., ECCV 2022): a PointNet with two layers of graph convolution."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jetnormal.networks.patchfit.layers import PointLayer, flat_indices, nearest, point_layers
from jetnormal.networks.patchfit.weighting import Weighting, WeightPredictor
from jetnormal.networks.patchfit.ztransform import FeatureTransform, scaled
from jetnormal.networks.rows import by_rows

EDGES = 4096  # at a time, in inference on a CPU: their features stay in a core's cache


class GraphFit(WeightPredictor):
    """Point features that look at their neighbors in feature space twice, then as DeepFit.

    3,457,540 parameters at width 1.
    """

    batch = 2

    def __init__(self, width: float = 1.0, feature_transform: bool = True, offsets: bool = True) -> None:
        super().__init__()
        c1, c2, c3, summary = (scaled(c, width) for c in (64, 128, 256, 1024))
        self.local = point_layers([3, c1, c1])
        self.graph1 = GraphLayer(c1)
        self.transform = FeatureTransform(c1, width) if feature_transform else None
        self.middle = PointLayer(c1, c2, nn.ReLU(inplace=True))
        self.graph2 = GraphLayer(c2)
        self.wide = PointLayer(c2, c3, nn.ReLU(inplace=True))
        self.summary = PointLayer(c1 + c2 + c3, summary)
        self.add_head(summary, c1 + c2 + c3, width, offsets)

    def forward(self, points: Tensor) -> Weighting:
        """(B, k, 3) patches, z close to the normal, to weights and offsets of all k points."""
        first = self.graph1(self.local(points))
        matrix = None
        if self.transform is not None:
            matrix = self.transform(first)
            first = first @ matrix.to(first.dtype)
        second = self.graph2(self.middle(first))
        local = torch.cat([first, second, self.wide(second)], dim=2)
        summary = self.summary.peak(local)
        return self.read(summary, local, matrix)


class GraphLayer(nn.Module):
    """Graph convolution at two scales, mixed with the features that went in by an adaptive gate.

    The edges to the 40 nearest neighbors in feature space become one feature of the point, which then joins the edges
    to the 20 nearest.
    """

    def __init__(self, channels: int, far: int = 40, near: int = 20) -> None:
        super().__init__()
        self.counts = far, near
        self.far = Edges(channels)
        self.near = Edges(channels)
        self.join = _edge_layer(2 * channels, channels)
        self.gate = AdaptiveGate(channels)

    def forward(self, features: Tensor) -> Tensor:
        """(B, n, C) to (B, n, C)."""
        far, near = self.counts
        neighbors = flat_indices(nearest(features, features, far), features.shape[1]).flatten(0, 1)
        from_far, from_near = self.far.parts(features), self.near.parts(features)

        def joined(rows: slice) -> Tensor:
            around = self.far.last.peak(self.far(*from_far, neighbors[rows], rows))
            edges = self.near.last(self.near(*from_near, neighbors[rows, :near], rows))
            return self.join.split_peak(around, edges)

        if torch.onnx.is_in_onnx_export():  # one graph for any number of patches
            return self.gate(features, joined(slice(None)).view(features.shape))
        chunk = EDGES // far if features.device.type == "cpu" else len(neighbors)
        return self.gate(features, by_rows(joined, len(neighbors), chunk).view(features.shape))


class Edges(nn.Module):
    """Two layers on the edges [neighbor - center, center] of a graph; the caller applies the second."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _edge_layer(2 * channels, channels)
        self.last = _edge_layer(channels, channels)

    def parts(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first linear map of (B, n, C) features, as neighbors and as centers: two (B n, C).

        W [n - c, c] = W1 n + (W2 - W1) c: one product a point instead of one an edge.
        """
        rows = features.flatten(0, 1)
        on_offset, on_center = self.first.linear.weight.chunk(2, dim=1)
        center = nn.functional.linear(rows, on_center - on_offset, self.first.linear.bias)
        return nn.functional.linear(rows, on_offset), center

    def forward(self, neighbor: Tensor, center: Tensor, neighbors: Tensor, rows: slice) -> Tensor:
        """Features (m, k, C), after the first layer, of the edges from m rows to their (m, k) neighbors."""
        picked = neighbor.index_select(0, neighbors.flatten()).view(*neighbors.shape, -1)
        return self.first.finish(picked.add_(center[rows, None]))


class AdaptiveGate(nn.Module):
    """Mix two features of each point by one share per channel, computed from the mean of their sum over the patch."""

    def __init__(self, channels: int, reduction: int = 8) -> None:
        super().__init__()
        narrow = max(1, channels // reduction)
        self.share = nn.Sequential(
            nn.Linear(channels, narrow, bias=False), nn.ReLU(), nn.Linear(narrow, channels, bias=False), nn.Sigmoid()
        )

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Two (B, n, C) features to (B, n, C)."""
        share = self.share((first + second).mean(1))[:, None]
        return torch.lerp(second, first, share)


def _edge_layer(inputs: int, outputs: int) -> PointLayer:
    return PointLayer(inputs, outputs, nn.LeakyReLU(0.2, inplace=True), bias=False)
