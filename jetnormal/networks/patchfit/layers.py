"""Layers that the networks share. Features are arrays (..., channels) with a row for each point."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from jetnormal.networks.patchfit.selection import every_nth, farthest_points, smallest


class PointLayer(nn.Module):
    """A linear map of each point's features, batch normalization, activation: (..., C_in) to (..., C_out).

    The activation must be monotonic, so that it commutes with a maximum.
    """

    def __init__(self, inputs: int, outputs: int, activation: nn.Module | None = None, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias)
        self.norm: nn.Module = nn.BatchNorm1d(outputs)
        self.activation = activation or nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        return self.finish(self.linear(features))

    def finish(self, products: Tensor) -> Tensor:
        """Normalize and activate the output of the linear map."""
        rows = self.norm(products.flatten(0, -2))
        return self.activation(rows).view(products.shape)

    def peak(self, features: Tensor) -> Tensor:
        """Apply the layer and take the maximum over the points: (..., k, C_in) to (..., C_out)."""
        if self._folded:  # one addition and one activation for a patch, not for each point
            return self.activation(linear_peak(self.linear, features))
        return maximum(self.forward(features), -2)

    def split(self, shared: Tensor, features: Tensor) -> Tensor:
        """Apply the layer to `cat([shared, features])` without building that.

        A row of `shared`, (..., C_shared), belongs to all k points of `features`, (..., k, C). Its part of the product
        is computed once instead of k times; the result is the same up to rounding.
        """
        once, products = self._products(shared, features)
        return self.finish(products.add_(once[..., None, :]))

    def split_peak(self, shared: Tensor, features: Tensor) -> Tensor:
        """Compute `maximum(split(shared, features), -2)`: (..., C_shared) and (..., k, C) to (..., C_out)."""
        if self._folded:
            once, products = self._products(shared, features)
            return self.activation(maximum(products, -2).add_(once))
        return maximum(self.split(shared, features), -2)

    def fold(self) -> None:
        """Move the normalization into the linear map: the same function in evaluation mode, in one step."""
        if isinstance(self.norm, nn.BatchNorm1d):
            norm, linear = self.norm, self.linear
            assert norm.running_mean is not None and norm.running_var is not None
            with torch.no_grad():
                gain = norm.weight * (norm.running_var + norm.eps).rsqrt()
                before = torch.zeros_like(norm.bias) if linear.bias is None else linear.bias
                linear.weight *= gain[:, None]
                linear.bias = nn.Parameter((before - norm.running_mean) * gain + norm.bias, norm.bias.requires_grad)
            self.norm = nn.Identity()

    @property
    def _folded(self) -> bool:
        return isinstance(self.norm, nn.Identity)

    def _products(self, shared: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """The products of the linear map with both parts of its input."""
        ours, theirs = self.linear.weight.split([shared.shape[-1], features.shape[-1]], dim=1)
        once = nn.functional.linear(shared, ours, self.linear.bias)
        return once, nn.functional.linear(features, theirs)


def maximum(features: Tensor, axis: int) -> Tensor:
    """Take the maximum over an axis: by amax, which is faster; for gradients by max, which keeps the index."""
    return features.max(axis).values if features.requires_grad else features.amax(axis)


def linear_peak(linear: nn.Linear, features: Tensor) -> Tensor:
    """Take the maximum over the points of a linear map; its bias is added last: (..., k, C_in) to (..., C_out)."""
    return maximum(nn.functional.linear(features, linear.weight), -2) + linear.bias


def full_precision(tensor: Tensor) -> torch.autocast:
    """Switch automatic mixed precision off inside the block."""
    return torch.autocast(tensor.device.type, enabled=False)


def point_layers(widths: Sequence[int]) -> nn.Sequential:
    """Make a chain of point layers through the given widths, each with a ReLU."""
    return nn.Sequential(*(PointLayer(a, b, nn.ReLU(inplace=True)) for a, b in pairwise(widths)))


def gather(features: Tensor, indices: Tensor) -> Tensor:
    """Gather the rows of features (B, n, C) at indices (B, ...): (B, ..., C)."""
    count, channels = features.shape[1:]
    rows = flat_indices(indices, count).flatten()
    return features.reshape(-1, channels).index_select(0, rows).view(*indices.shape, channels)


def flat_indices(indices: Tensor, count: int) -> Tensor:
    """Convert indices (B, ...) into the n rows of each patch to indices into all B n rows."""
    first = torch.arange(indices.shape[0], device=indices.device) * count
    return indices + first.view(-1, *[1] * (indices.dim() - 1))


def nearest(points: Tensor, queries: Tensor, k: int) -> Tensor:
    """Find the indices (B, m, k) of the k nearest of (B, n, C) `points` to each of (B, m, C) `queries`, ascending.

    Distances in any number of channels, the query itself included where it is among the points.
    """
    with torch.no_grad(), full_precision(points):
        points, queries = points.float(), queries.float()
        # |p - q|^2 up to |q|^2, which does not change the order
        scores = torch.baddbmm(points.square().sum(2)[:, None], queries, points.transpose(1, 2), alpha=-2)
        return smallest(scores, min(k, points.shape[1]))


class EdgeConv(nn.Module):
    """Edge convolution over a k-nearest-neighbor graph in feature space (Wang et al., DGCNN, 2019).

    An edge carries [center - neighbor, center]; three maps, the first two with batch normalization and LeakyReLU(0.2),
    then the maximum over the neighbors. Every point is its own neighbor.
    """

    def __init__(self, inputs: int, outputs: int, k: int = 8) -> None:
        super().__init__()
        self.k = k
        half = outputs // 2
        self.first = PointLayer(2 * inputs, half, nn.LeakyReLU(0.2, inplace=True))
        self.second = PointLayer(half, half, nn.LeakyReLU(0.2, inplace=True))
        self.last = nn.Linear(half, outputs)

    def forward(self, features: Tensor) -> Tensor:
        """(B, n, C_in) to (B, n, C_out)."""
        neighbors = nearest(features, features, self.k)
        # W [c - n, c] = (W1 + W2) c - W1 n: one product a point instead of one an edge
        on_offset, on_center = self.first.linear.weight.chunk(2, dim=1)
        center = nn.functional.linear(features, on_offset + on_center, self.first.linear.bias)
        neighbor = nn.functional.linear(features, on_offset)
        edges = self.first.finish(center[:, :, None] - gather(neighbor, neighbors))
        return linear_peak(self.last, self.second(edges))


class AdaptivePooling(nn.Module):
    """Adaptive graph pooling (AdaGP; Yan et al., FBNet, 2022): fewer points, each an attentive mean of 8 neighbors.

    Per channel, softmax over the neighbors of attention(query - feature + position) weighs feature + position.
    The points kept are a farthest point sampling or, at a fraction of its cost, every n-th in order of distance from
    the query.
    """

    def __init__(self, channels: int, points: int, k: int = 8, farthest: bool = True) -> None:
        super().__init__()
        self.points = points
        self.k = k
        self.farthest = farthest
        self.position = _bottleneck(3, channels)
        self.attention = _bottleneck(channels, channels)

    def forward(self, points: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """(B, n, 3) and (B, n, C) to (B, m, 3) and (B, m, C); the query, index 0, stays at index 0."""
        count = min(self.points, points.shape[1])
        kept = farthest_points(points, count) if self.farthest else every_nth(points, count)
        centers = gather(points, kept)
        neighbors = nearest(points, centers, self.k)
        position = self.position(centers[:, :, None] - gather(points, neighbors))
        feature = gather(features, neighbors)
        attention = self.attention(gather(features, kept)[:, :, None] - feature + position)
        return centers, (attention.softmax(2) * (feature + position)).sum(2)


def _bottleneck(inputs: int, outputs: int) -> nn.Sequential:
    """Two maps through a quarter of the outputs."""
    narrow = outputs // 4
    return nn.Sequential(PointLayer(inputs, narrow, nn.LeakyReLU(0.2, inplace=True)), nn.Linear(narrow, outputs))
