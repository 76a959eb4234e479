"""CloudFit: the normals of all points of a cloud at once, from one graph network over the whole cloud.

A U-shaped graph network on a pyramid of the cloud gives each point features. From coarse to fine, the points of each
level then vote on their normals, after each edge convolution: the next one sees the normals that were voted for. A
normal is the smallest eigenvector of a matrix to which each neighbor gives, with learned weights, its offset (a
weighted plane), its normal, and its normal mirrored on the plane that bisects the edge (on a sphere, the point's own
normal: a weighted jet of second order). The normals of a level are where those of the next finer level start from, as
the z-direction is where the paper's fit starts from.

All inputs are invariant to rotation, translation and scaling of the cloud, to the order of its points and to the signs
of the normals (`layers.connect`), so the result rotates with the cloud exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from jetnormal.geometry.neighbors import inverse_order
from jetnormal.geometry.pyramid import SAME, Neighborhood, Pyramid
from jetnormal.networks.cloudfit.config import NODE_FEATURES, CloudFitConfig
from jetnormal.networks.cloudfit.layers import EdgeConv, Edges, Nodes, ZDirection, connect
from jetnormal.networks.rows import by_rows


@dataclass(frozen=True)
class CloudPrediction:
    """The output of the network for the N points of a cloud; normals are unit vectors of any sign.

    Attributes:
        normals: (N, 3) voted for by the neighbors.
        rough: (N, 3) the normals before the last vote.
        confidence: (N,) logit of the probability that a normal is off by less than 10 degrees.
        directions: (n, 3) normals found on the way, the coarsest first, each with the (n,) int64 points of the cloud
            that its points come from.
        levels: of the pyramid, with the normals voted for.
    """

    normals: Tensor
    rough: Tensor
    confidence: Tensor
    directions: list[tuple[Tensor, Tensor]]
    levels: list[Nodes]


class CloudFit(nn.Module):
    """See the module."""

    architecture = "cloudfit"  # in model files

    def __init__(self, config: CloudFitConfig) -> None:
        super().__init__()
        self.config = config
        c, hidden = config.channels, config.hidden
        steps = list(pairwise(c))
        self.embed = nn.ModuleList(nn.Linear(NODE_FEATURES, width) for width in c)
        self.up = _layers(c, config.up_layers)
        self.pool = nn.ModuleList(EdgeConv(coarse, fine) for fine, coarse in steps)
        self.unpool = nn.ModuleList(EdgeConv(fine, coarse) for fine, coarse in steps)
        self.interpolate = nn.ModuleList(ZDirection(fine, (coarse,), hidden) for fine, coarse in steps)
        self.down = _layers(c, config.down_layers)
        self.direction = nn.ModuleList(
            nn.ModuleList(ZDirection(width, c[level : level + 2], hidden) for _ in range(config.votes(level)))
            for level, width in enumerate(c)
        )
        self.carry = EdgeConv(c[0], c[0])
        self.carried_direction = ZDirection(c[0], (c[0],), hidden)
        self.confidence = nn.Sequential(nn.Linear(c[0] + 1, hidden), nn.ReLU(), nn.Linear(hidden, 1))

    def for_inference(self) -> CloudFit:
        """Return the network itself, as it is used to estimate."""
        return self.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    def forward(self, pyramid: Pyramid) -> CloudPrediction:
        """Return the normals of a cloud.

        Args:
            pyramid: of the cloud, with as many levels as the network.
        """
        nodes = [Nodes.of(level, self.device) for level in pyramid.levels]
        h = self._ascend(pyramid, nodes)
        origins = [self._tensor(rows) for rows in _origins(pyramid)]
        directions = []
        rough = normals = nodes[-1].normals
        for number in range(len(nodes) - 1, -1, -1):
            here = nodes[number]
            if number + 1 < len(nodes):
                above, parents = nodes[number + 1], self._tensor(pyramid.levels[number].parents)
                edges = connect(here, above, parents, above.scale[parents[:, 0].long()])
                h[number] = self.unpool[number](h[number], h[number + 1], edges)
                first = self.interpolate[number](h[number], here, [(h[number + 1], above, edges)])
                directions.append((first, origins[number]))
                here = here.turned(first.detach())
            nodes[number] = here
            for vote, direction in enumerate(cast(nn.ModuleList, self.direction[number])):
                rough, edges = nodes[number].normals, _within(nodes[number])
                if len(layers := cast(nn.ModuleList, self.down[number])):
                    h[number] = layers[vote](h[number], h[number], edges)
                normals = self._vote(direction, number, pyramid, h, nodes, edges)
                directions.append((normals, origins[number]))
                nodes[number] = nodes[number].turned(normals.detach())
        confidence = self._sure(h[0], normals, rough)
        if len(pyramid.left_out):
            late, late_rough, late_confidence = self._carry(pyramid.carried, nodes[0], h[0])
            directions.append((late, self._tensor(pyramid.left_out)))
            place = self._tensor(inverse_order(np.concatenate([pyramid.kept, pyramid.left_out])))
            pairs = ((normals, late), (rough, late_rough), (confidence, late_confidence))
            normals, rough, confidence = (torch.cat(pair)[place] for pair in pairs)
        return CloudPrediction(normals, rough, confidence, directions, nodes)

    def _sure(self, h: Tensor, normals: Tensor, rough: Tensor) -> Tensor:
        """(n,) confidence of points, from their features and from how far the last vote moved the normal."""

        def rate(rows: slice) -> Tensor:
            change = 1 - (normals[rows] * rough[rows]).sum(1, keepdim=True).abs()
            return self.confidence(torch.cat([h[rows], 10 * change], 1).detach())[:, 0]

        return by_rows(rate, len(h))

    def _ascend(self, pyramid: Pyramid, nodes: list[Nodes]) -> list[Tensor]:
        """Features of all levels on the way up."""
        features: list[Tensor] = []
        for number, (level, here) in enumerate(zip(pyramid.levels, nodes, strict=True)):
            h = self._embedded(number, level, here)
            if number:
                below, chosen = nodes[number - 1], self._tensor(pyramid.levels[number - 1].chosen)
                edges = connect(here, below, _with_itself(chosen, below), below.scale[chosen])
                h = self.pool[number - 1](h, features[number - 1], edges)
            if len(layers := cast(nn.ModuleList, self.up[number])):
                edges = _within(here)
                for layer in layers:
                    h = layer(h, h, edges)
            features.append(h)
        return features

    def _embedded(self, number: int, neighborhood: Neighborhood, nodes: Nodes) -> Tensor:
        """(n, C) first features of points, from the shape of their neighborhoods alone."""
        variance = self._tensor(neighborhood.variance)

        def embed(rows: slice) -> Tensor:
            tilt = (nodes.normals[rows] * nodes.centroid[rows]).sum(1, keepdim=True).abs()
            length = nodes.centroid[rows].norm(dim=1, keepdim=True)
            return self.embed[number](torch.cat([variance[rows], tilt, length], 1))

        return by_rows(embed, len(variance))

    def _vote(
        self, direction: nn.Module, number: int, pyramid: Pyramid, h: list[Tensor], nodes: list[Nodes], edges: Edges
    ) -> Tensor:
        """Normals of a level, voted for by its points and by those of the next."""
        here = nodes[number]
        senders = [(h[number], here, edges)]
        if number + 1 < len(nodes):
            above, parent = nodes[number + 1], self._tensor(pyramid.levels[number].parents[:, 0]).long()
            neighbors = _with_itself(parent, above)
            senders.append((h[number + 1], above, connect(here, above, neighbors, above.scale[parent])))
        normals: Tensor = direction(h[number], here, senders)
        return normals

    def _carry(self, carried: Neighborhood, level: Nodes, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Normals, first normals and confidence of the points that the finest level leaves out.

        A near-duplicate gets the normal of the point that it repeats.
        """
        here = Nodes.of(carried, self.device)
        rough = level.normals[here.neighbors[:, 0].long()]
        here = here.turned(rough)
        edges = connect(here, level, here.neighbors, here.scale)
        features = self.carry(self._embedded(0, carried, here), h, edges)
        normals = self.carried_direction(features, here, [(h, level, edges)])
        nearest = here.neighbors[:, 0].long()
        apart = (here.positions - level.positions[nearest]).norm(dim=1)
        normals = torch.where((apart <= SAME * level.scale[nearest])[:, None], rough, normals)
        return normals, rough, self._sure(features, normals, rough)


def _layers(channels: tuple[int, ...], counts: tuple[int, ...]) -> nn.ModuleList:
    """For each level, its edge convolutions."""
    return nn.ModuleList(
        nn.ModuleList(EdgeConv(width, width) for _ in range(count))
        for width, count in zip(channels, counts, strict=True)
    )


def _within(nodes: Nodes) -> Edges:
    """The edges between the points of a level."""
    return connect(nodes, nodes, nodes.neighbors, nodes.scale)


def _with_itself(points: Tensor, nodes: Nodes) -> Tensor:
    """(Q, 17) int32: each of the (Q,) points and its neighbors."""
    return torch.cat([points.to(torch.int32)[:, None], nodes.neighbors[points]], 1)


def _origins(pyramid: Pyramid) -> list[NDArray[np.int64]]:
    """For each level, which points of the cloud its points come from."""
    origins = [pyramid.kept]
    for level in pyramid.levels[:-1]:
        origins.append(origins[-1][level.chosen])
    return origins
