"""Input transforms: rotations that bring the normal of a patch to its z axis.

Points are row vectors: a transform R, (B, 3, 3), is applied as `points @ R` and undone as `normals @ R.T`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from jetnormal.networks.patchfit.layers import AdaptivePooling, EdgeConv, PointLayer, maximum, point_layers


class ZTransform(nn.Module):
    """The paper's graph-convolution transform (Du et al., supplement, A.1): 980,212 parameters at width 1.

    Three edge convolutions with two adaptive graph poolings to 128 and 64 points, the maximum and the mean over the
    points, three fully connected layers to a quaternion. The last one starts at zero: the identity.

    The light form takes every second point of the patch. It pools to 64 and 32 points in equal steps of the order of
    distance instead of by farthest point sampling. It costs a quarter.
    """

    def __init__(self, width: float = 1.0, light: bool = False) -> None:
        super().__init__()
        self.step = 2 if light else 1
        pools = (64, 32) if light else (128, 64)
        c1, c2, c3, c4 = (scaled(c, width) for c in (64, 128, 256, 512))
        self.conv1 = EdgeConv(3, c1)
        self.pool1 = AdaptivePooling(c1, points=pools[0], farthest=not light)
        self.conv2 = EdgeConv(c1, c2)
        self.pool2 = AdaptivePooling(c2, points=pools[1], farthest=not light)
        self.conv3 = EdgeConv(c2, c3)
        self.lift = nn.Sequential(PointLayer(c3, c3, nn.LeakyReLU(0.2, inplace=True)), nn.Linear(c3, c4))
        self.quaternion = quaternion_head(2 * c4, c4, c3)

    def forward(self, points: Tensor) -> Tensor:
        """(B, k, 3) patches to (B, 3, 3) rotations."""
        points = points[:, :: self.step]
        centers, features = self.pool1(points, self.conv1(points))
        _, features = self.pool2(centers, self.conv2(features))
        features = self.lift(self.conv3(features))
        summary = torch.cat([maximum(features, 1), features.mean(1)], dim=1)
        return rotation_matrix(self.quaternion(summary))


class QSTN(nn.Module):
    """The quaternion spatial transformer of PCPNet and DeepFit: a PointNet that ends in a quaternion."""

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        c1, c2, c3, c4, c5 = (scaled(c, width) for c in (64, 128, 1024, 512, 256))
        self.features = point_layers([3, c1, c2, c3])
        self.quaternion = quaternion_head(c3, c4, c5)

    def forward(self, points: Tensor) -> Tensor:
        """(B, k, 3) patches to (B, 3, 3) rotations."""
        return rotation_matrix(self.quaternion(summary(self.features, points)))


class FeatureTransform(nn.Module):
    """PointNet's feature transform: a C x C matrix for each patch, the identity at the start."""

    def __init__(self, channels: int = 64, width: float = 1.0) -> None:
        super().__init__()
        self.channels = channels
        c1, c2, c3, c4, c5 = (scaled(c, width) for c in (64, 128, 1024, 512, 256))
        self.features = point_layers([channels, c1, c2, c3])
        self.head = nn.Sequential(point_layers([c3, c4, c5]), zero_linear(c5, channels**2))

    def forward(self, features: Tensor) -> Tensor:
        """(B, k, C) features to (B, C, C) matrices."""
        matrix = self.head(summary(self.features, features)).view(-1, self.channels, self.channels)
        return matrix + torch.eye(self.channels, device=features.device)


def summary(layers: nn.Sequential, features: Tensor) -> Tensor:
    """Apply a chain of point layers and take the maximum over the points: (B, k, C_in) to (B, C_out)."""
    last = layers[-1]
    assert isinstance(last, PointLayer)
    return last.peak(layers[:-1](features))


def scaled(channels: int, width: float) -> int:
    """Scale a channel count by the width of the network, rounded to a multiple of 8."""
    return max(8, 8 * round(channels * width / 8))


def quaternion_head(*widths: int) -> nn.Sequential:
    """Make fully connected layers through `widths` to a quaternion minus the identity."""
    return nn.Sequential(point_layers(widths), zero_linear(widths[-1], 4))


def zero_linear(inputs: int, outputs: int) -> nn.Linear:
    """Make a linear map whose weights start at zero."""
    linear = nn.Linear(inputs, outputs)
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear


def rotation_matrix(offset: Tensor) -> Tensor:
    """Return (B, 3, 3) rotations of the quaternions (1, 0, 0, 0) + `offset`, (B, 4), of any length but zero."""
    w, x, y, z = nn.functional.normalize(offset.float() + offset.new_tensor([1.0, 0, 0, 0]), dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)


def rotation_to_z(normals: Tensor) -> Tensor:
    """Return the smallest rotations R, (B, 3, 3), with `normals @ R = +-z` for (B, 3) unit normals of either sign."""
    n = torch.where(normals[:, 2:] < 0, -normals, normals)
    x, y, z = n.unbind(1)
    s = 1 / (1 + z)
    rows = [1 - s * x * x, -s * x * y, x, -s * x * y, 1 - s * y * y, y, -x, -y, z]
    return torch.stack(rows, dim=1).view(-1, 3, 3)
