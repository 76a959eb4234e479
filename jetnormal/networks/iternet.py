"""IterNet: iterated plane fits, whose weights a small network computes from the normals of the last iteration.

Lenssen, Osendorfer and Masci, "Deep Iterative Surface Normal Estimation", CVPR 2020: 7,981 parameters. The cloud is
one graph of k nearest neighbors. The first normals are those of planes through all neighbors (PCA). An iteration looks
at each edge of the graph - the offset, the angles to the normals at both of its ends, the last weight - and gives each
neighbor a new weight; the next normals are those of the weighted planes. All iterations share their parameters.

The result does not change if the cloud is moved, scaled or permuted. It changes a little if the cloud is rotated,
because the network sees raw offsets. Normals have no sign: each is turned to the side where its neighbors lie, and the
normals of the neighbors are turned to the side of the point's own normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.geometry.graph import Graph
from jetnormal.networks.eigenvectors import smallest_eigenvector
from jetnormal.networks.patchfit.layers import full_precision
from jetnormal.networks.patchfit.ztransform import rotation_matrix
from jetnormal.support.options import Option

UNIT = 0.2  # offsets enter the network as this times their length in spacings of the cloud
CODE = 8  # channels of the features of a whole neighborhood


@dataclass(frozen=True)
class IterNetConfig:
    """Configuration of an IterNet.

    Raises:
        ValueError: if a number is out of range.
    """

    neighbors: Annotated[int, Option("Neighbors of a point in the graph, without the point itself.")] = 64
    iterations: Annotated[int, Option("Rounds of weighing the neighbors and fitting a plane.")] = 4

    def __post_init__(self) -> None:
        if self.neighbors < 2:
            raise ValueError(f"a plane needs 2 neighbors or more, not {self.neighbors}")
        if self.iterations < 1:
            raise ValueError(f"there is at least 1 iteration, not {self.iterations}")


class IterNet(nn.Module):
    """The network of one iteration; see the module."""

    architecture = "iternet"  # in model files

    def __init__(self, config: IterNetConfig) -> None:
        super().__init__()
        self.config = config
        self.edges = nn.ModuleList([_TwoLayers(8, 0, 16), _TwoLayers(16, CODE, 16), _TwoLayers(16, CODE, 16)])
        self.codes = nn.ModuleList([_TwoLayers(16 + 3, 0, CODE), _TwoLayers(16, 0, CODE), _TwoLayers(16, 0, 4 + CODE)])
        self.weight = _TwoLayers(16 + 3, CODE, 1, hidden=64)

    def for_inference(self) -> IterNet:
        """Return the network itself, as it is used to estimate."""
        return self.eval().requires_grad_(False)

    def first(self, graph: Graph, rows: slice | Tensor) -> tuple[Tensor, Tensor]:
        """Return the normals (n, 3) of planes through all neighbors of some points, and their equal weights (n, k)."""
        offsets = graph.offsets(rows)
        weights = torch.full(offsets.shape[:2], 1 / offsets.shape[1], device=offsets.device)
        return plane_normals(offsets, weights), weights

    def refit(self, graph: Graph, normals: Tensor, weights: Tensor, rows: slice | Tensor) -> tuple[Tensor, Tensor]:
        """Do an iteration for some points of a cloud.

        Args:
            graph: of the cloud.
            normals: (N, 3) of the last iteration, of all points.
            weights: (n, k) of the last iteration, of the points at `rows`.
            rows: n of the N points.

        Returns:
            The next normals (n, 3) and weights (n, k) of these points.
        """
        offsets = graph.offsets(rows)
        weights = self(offsets, weights, normals[rows], normals[graph.neighbors[rows]])
        return plane_normals(offsets, weights), weights

    def forward(self, offsets: Tensor, weights: Tensor, normals: Tensor, neighbor_normals: Tensor) -> Tensor:
        """Weigh the neighbors of n points.

        Args:
            offsets: (n, k, 3) float32 from the points to their neighbors, in spacings of the cloud.
            weights: (n, k) of the last iteration; 1 / k before the first.
            normals: (n, 3) of the last iteration, see `plane_normals`.
            neighbor_normals: (n, k, 3) the same of the neighbors, of any sign.

        Returns:
            (n, k) positive weights; those of a point sum up to 1.
        """
        offsets = UNIT * offsets
        features = _edge_features(offsets, weights, normals, neighbor_normals)
        code = None
        for edge_layers, code_layers in zip(self.edges, self.codes, strict=True):
            features = edge_layers(features, code)
            summary = features.mean(1)
            code = code_layers(summary if code is not None else torch.cat([summary, normals], 1))
        assert code is not None
        turned = offsets @ rotation_matrix(code[:, :4])
        return self.weight(torch.cat([features, turned], 2), code[:, 4:])[..., 0].float().softmax(1)


class _TwoLayers(nn.Module):
    """Two linear maps with a ReLU between; `shared` channels of the input belong to all edges of a point."""

    def __init__(self, inputs: int, shared: int, outputs: int, hidden: int = 32) -> None:
        super().__init__()
        self.inputs = inputs
        self.first = nn.Linear(inputs + shared, hidden)
        self.last = nn.Linear(hidden, outputs)

    def forward(self, features: Tensor, shared: Tensor | None = None) -> Tensor:
        """(n, k, C) features of edges and (n, S) of points, or (n, C) features of points alone."""
        if shared is None:
            return self.last(F.relu(self.first(features)))
        ours = F.linear(features, self.first.weight[:, : self.inputs])  # as a product of [features, shared] would be
        theirs = F.linear(shared, self.first.weight[:, self.inputs :], self.first.bias)
        return self.last(F.relu(ours + theirs[:, None]))


def plane_normals(offsets: Tensor, weights: Tensor) -> Tensor:
    """Find the normals of the weighted planes through neighborhoods, by least squares.

    Args:
        offsets: (n, k, 3) from n points to their neighbors.
        weights: (n, k) positive.

    Returns:
        (n, 3) unit vectors on the side where the neighbors' mean lies.
    """
    with full_precision(offsets):
        share = weights / weights.sum(1, keepdim=True)
        mean = (share[:, None] @ offsets)[:, 0]
        centered = offsets - mean[:, None]
        normals = smallest_eigenvector(centered.transpose(1, 2) @ (share[..., None] * centered))
    return torch.where((normals * mean).sum(1, keepdim=True) < 0, -normals, normals)


def _edge_features(offsets: Tensor, weights: Tensor, normals: Tensor, neighbor_normals: Tensor) -> Tensor:
    """(n, k, 8): offset, weight, cosines of the angles among the offset and both normals, length."""
    length = offsets.norm(dim=2)
    direction = offsets / length.clamp_min(1e-12)[..., None]  # 0 for the point itself
    own = (direction @ normals[..., None])[..., 0]
    agreement = (neighbor_normals @ normals[..., None])[..., 0]
    side = torch.where(agreement < 0, -1.0, 1.0)
    other = side * (direction * neighbor_normals).sum(2)
    return torch.cat([offsets, torch.stack([weights, own, other, side * agreement, length], 2)], 2)
