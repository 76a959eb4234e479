"""Nesti-Net: a network that chooses among experts for neighborhoods of different sizes.

Ben-Shabat, Lindenbaum and Fischer, "Nesti-Net: Normal Estimation for Unstructured 3D Point Clouds using Convolutional
Neural Networks", CVPR 2019. The points of each ball become a 3D modified Fisher vector (3DmFV; Ben-Shabat et al.,
RA-L 2018): statistics of how they deviate from a mixture of Gaussians on a grid, a 3D image with 20 channels.
Experts, two for each ball and one for all balls, are convolutional networks from such images to a normal. Another
network looks at all images and predicts the probability that each expert is right. The most probable one is used.

178,382,710 parameters with 8^3 Gaussians and seven experts: the 170.1 x 2^20 that Du et al. print.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.networks.ball_config import BallConfig
from jetnormal.networks.patchfit.layers import point_layers
from jetnormal.networks.patchfit.ztransform import scaled
from jetnormal.support.options import Option

GRID = 8  # Gaussians along each axis
CHANNELS = 20  # of a Fisher vector
# Filters of an inception module and the sizes of its two kernels; None halves the grid.
GATE = ((128, 3, 5), (256, 3, 5), (256, 3, 5), None, (512, 2, 4), (512, 2, 4), None, (512, 1, 2), None)
EXPERT = ((128, 3, 5), (256, 3, 5), None, (256, 2, 4), None, (512, 2, 4), None)


@dataclass(frozen=True)
class NestiNetConfig(BallConfig):
    """Configuration of a Nesti-Net; the defaults are the published network. A sparse ball keeps fewer than `points`."""

    points: Annotated[int, Option("Points of a ball; from a fuller ball so many are drawn.")] = 512

    @property
    def experts(self) -> list[slice]:
        """The balls that each expert sees: two experts for each ball, one for all."""
        scales = len(self.radii)
        return [slice(scale, scale + 1) for scale in range(scales) for _ in range(2)] + [slice(0, scales)]


class NestiNet(nn.Module):
    """See the module."""

    architecture = "nestinet"  # in model files

    def __init__(self, config: NestiNetConfig) -> None:
        super().__init__()
        self.config = config
        scales, width = len(config.radii), config.width
        self.gate = _Convolutions(scales, GATE, width, (1024, 256, 128), len(config.experts))
        self.experts = nn.ModuleList(
            _Convolutions(balls.stop - balls.start, EXPERT, width, (512, 128, 64), 3) for balls in config.experts
        )

    def forward(self, points: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the normals of all experts, and their probabilities.

        Args:
            points: (B, S, n, 3) points of S balls around each query, in radii.
            counts: (B, S) int64 true points of the balls; those that follow do not count.

        Returns:
            (B, E, 3) normals of the experts, of any sign and length, and (B, E) the probabilities of these.
        """
        pictures = fisher_vectors(points, counts)
        normals = [expert(pictures[:, balls]) for expert, balls in zip(self.experts, self.config.experts, strict=True)]
        return torch.stack(normals, 1).float(), self.gate(pictures).float().softmax(1)

    def estimate(self, points: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the normal of the most probable expert of each query.

        Returns:
            (B, 3) unit vectors of any sign, and (B,) the probabilities of the experts that gave them.
        """
        pictures = fisher_vectors(points, counts)
        probabilities, chosen = self.gate(pictures).float().softmax(1).max(1)
        normals = points.new_empty(len(points), 3)
        for number, (expert, balls) in enumerate(zip(self.experts, self.config.experts, strict=True)):
            rows = (chosen == number).nonzero()[:, 0]
            if len(rows):
                normals[rows] = expert(pictures[rows, balls]).float()
        return F.normalize(normals, dim=1), probabilities

    def for_inference(self) -> NestiNet:
        """Return the network itself, as it is used to estimate."""
        return self.eval().requires_grad_(False)


def fisher_vectors(points: Tensor, counts: Tensor, grid: int = GRID) -> Tensor:
    """Find the 3D modified Fisher vectors of sets of points in the unit ball.

    Of each Gaussian: maximum and mean over the points of the derivative of the likelihood with respect to its weight,
    and maximum, minimum and mean of those with respect to its three means and deviations. Signed square roots are
    taken, and each kind is scaled to length 1 over all Gaussians.

    Args:
        points: (..., n, 3).
        counts: (...) int64, of the points that count, the first ones.
        grid: Gaussians along each axis of the cube from -1 to 1.

    Returns:
        (..., 20, grid, grid, grid).
    """
    ticks = torch.linspace(1 / grid - 1, 1 - 1 / grid, grid, device=points.device)
    means = torch.cartesian_prod(ticks, ticks, ticks)  # (K, 3)
    weight, deviation = 1 / len(means), 1 / grid
    offsets = (points[..., None, :] - means) / deviation  # (..., n, K, 3)
    share = (-0.5 * offsets.square().sum(-1)).softmax(-1)[..., None]
    by_weight = (share - weight) / weight**0.5
    by_mean = share * offsets / weight**0.5
    by_deviation = share * (offsets.square() - 1) / (2 * weight) ** 0.5
    slopes = torch.cat([by_weight, by_mean, by_deviation], -1)  # (..., n, K, 7)
    there = (torch.arange(points.shape[-2], device=points.device) < counts[..., None])[..., None, None]
    highest = slopes.masked_fill(~there, -torch.inf).amax(-3)
    lowest = slopes.masked_fill(~there, torch.inf).amin(-3)[..., 1:]
    mean = (slopes * there).sum(-3) / counts[..., None, None]
    statistics = torch.cat([torch.cat([highest, lowest], -1) / counts[..., None, None], mean], -1)  # (..., K, 20)
    roots = statistics.sign() * statistics.abs().sqrt()
    return F.normalize(roots, dim=-2).transpose(-1, -2).unflatten(-1, (grid, grid, grid))


class _Convolutions(nn.Module):
    """Inception modules over the images of some balls, then fully connected layers."""

    def __init__(
        self, scales: int, plan: Sequence[tuple[int, int, int] | None], width: float, read: Sequence[int], outputs: int
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = CHANNELS * scales
        for number, module in enumerate(plan):
            if module is None:
                layers.append(nn.MaxPool3d(2))
                continue
            filters, *sizes = module
            if number == 0 and plan is EXPERT:
                filters //= scales  # an expert for several balls is no larger than the others
            inception = _Inception(channels, scaled(filters, width) if width != 1 else filters, *sizes)
            layers.append(inception)
            channels = inception.outputs
        self.convolutions = nn.Sequential(*layers)
        widths = [channels, *(scaled(c, width) for c in read)]
        self.read = nn.Sequential(point_layers(widths), nn.Linear(widths[-1], outputs))

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, S, 20, g, g, g) images to (B, outputs)."""
        return self.read(self.convolutions(pictures.flatten(1, 2)).flatten(1))


class _Inception(nn.Module):
    """Convolutions of three sizes and an average, side by side."""

    def __init__(self, inputs: int, filters: int, first: int, second: int) -> None:
        super().__init__()
        self.point = _convolution(inputs, filters, 1)
        self.first = _convolution(filters, filters // 2, first)
        self.second = _convolution(filters, filters // 2, second)
        self.average = _convolution(inputs, filters, 1)
        self.size = first
        self.outputs = 2 * filters + 2 * (filters // 2)

    def forward(self, pictures: Tensor) -> Tensor:
        point = self.point(pictures)
        branches = [point, self.first(point), self.second(point), self.average(_local_mean(pictures, self.size))]
        return torch.cat(branches, 1)


def _convolution(inputs: int, outputs: int, size: int) -> nn.Sequential:
    """A convolution that keeps the size of the grid, then batch normalization and ReLU."""
    layers = [nn.ConstantPad3d(_around(size), 0.0), nn.Conv3d(inputs, outputs, size)]
    return nn.Sequential(*layers, nn.BatchNorm3d(outputs), nn.ReLU(inplace=True))


def _around(size: int) -> tuple[int, int, int, int, int, int]:
    """Padding before and after each axis that keeps the size of the grid for a window of a size."""
    before, after = (size - 1) // 2, size // 2
    return before, after, before, after, before, after


def _local_mean(pictures: Tensor, size: int) -> Tensor:
    """The mean over the cells of a cube around each cell, as far as they lie inside the grid."""

    def means(values: Tensor) -> Tensor:
        return F.avg_pool3d(F.pad(values, _around(size)), size, stride=1)

    return means(pictures) / means(torch.ones_like(pictures[:1, :1]))
