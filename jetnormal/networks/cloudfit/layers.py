"""Layers on the levels of a pyramid: edges described by invariants, edge convolutions, votes for a z-direction."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.geometry.pyramid import Neighborhood
from jetnormal.networks.cloudfit import torch_ops
from jetnormal.networks.cloudfit.config import BALLOTS, FEATURES
from jetnormal.networks.cloudfit.edge_kernels import edge_features
from jetnormal.networks.cloudfit.edge_ops import edge_messages, edge_mlp
from jetnormal.networks.cloudfit.vote_ops import votes
from jetnormal.networks.eigenvectors import smallest_eigenvector
from jetnormal.networks.rows import by_rows, for_rows


@dataclass(frozen=True)
class Nodes:
    """A level of the pyramid as tensors, see `pyramid.Neighborhood`; `sign` tells on which side the centroid is."""

    positions: Tensor
    neighbors: Tensor
    scale: Tensor
    normals: Tensor
    centroid: Tensor
    sign: Tensor

    @classmethod
    def of(cls, level: Neighborhood, device: torch.device) -> Nodes:
        """Return a level with the normals of its neighbors' planes."""
        arrays = (level.positions, level.neighbors, level.scale, level.normals, level.centroid)
        positions, neighbors, scale, normals, centroid = (torch.from_numpy(array).to(device) for array in arrays)
        return cls(positions, neighbors, scale, normals, centroid, sign=scale).turned(normals)

    def turned(self, normals: Tensor) -> Nodes:
        """Return the same points with other normals."""

        def side(rows: slice) -> Tensor:
            return torch.tanh(3 * (normals[rows] * self.centroid[rows]).sum(1))

        sign = by_rows(side, len(normals))
        return Nodes(self.positions, self.neighbors, self.scale, normals, self.centroid, sign)


@dataclass(frozen=True)
class Edges:
    """Edges from nodes to nodes: (N, k) int32 neighbors, (N,) unit of length and (N, k, 12) invariants."""

    neighbors: Tensor
    unit: Tensor
    features: Tensor


def connect(to: Nodes, sender: Nodes, neighbors: Tensor, unit: Tensor) -> Edges:
    """Return the edges to each of `to` from its `neighbors` among `sender`, with their twelve invariants.

    With d the offset in units of `unit`, n and n' the normals of receiver and sender, m and m' their centroids, t and
    t' their soft signs tanh(3 n.m), s and s' their scales:
    |d|^2, |d|, |n.d|, |n'.d|, (n.n')^2, (n.d)(n'.d)(n.n'), (n.d) t, (n'.d) t', m.d, m'.d, (n.n') t t', log s'/s.
    """
    own = (to.positions, to.normals, to.centroid, to.sign, to.scale)
    others = (sender.positions, sender.normals, sender.centroid, sender.sign, sender.scale)
    if not torch_ops.has_loops(unit):
        return Edges(neighbors, unit, torch_ops.edge_features(own, unit, others, neighbors))
    # NumPy's logarithm: PyTorch's depends in the last digit on how its threads divide the numbers
    arrays = [*(t.numpy() for t in own[:-1]), np.log(to.scale.numpy()), unit.numpy()]
    sent = [*(t.numpy() for t in others[:-1]), np.log(sender.scale.numpy())]
    features = torch.empty(*neighbors.shape, FEATURES)

    def describe(rows: slice) -> None:
        edge_features(*(array[rows] for array in arrays), *sent, neighbors[rows].numpy(), features[rows].numpy())

    for_rows(describe, len(neighbors))
    return Edges(neighbors, unit, features)


class EdgeConv(nn.Module):
    """h <- h + W LN(m): an edge convolution whose products are taken per point, not per edge.

    Half the channels of m are the maximum over j of the messages relu(A h_i + B h_j + C q_ij), the others their mean.
    """

    def __init__(self, channels: int, sender_channels: int) -> None:
        super().__init__()
        self.own = nn.Linear(channels, channels)
        self.sender = nn.Linear(sender_channels, channels, bias=False)
        self.edge = nn.Parameter(torch.randn(FEATURES, channels) / FEATURES**0.5)
        self.norm = nn.LayerNorm(channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, h: Tensor, sender: Tensor, edges: Edges) -> Tensor:
        """(N, C) features from (N, C) own and (M, C') the senders' features."""
        sent = by_rows(lambda rows: self.sender(sender[rows]), len(sender))

        def layer(rows: slice) -> Tensor:
            messages = edge_messages(self.own(h[rows]), sent, self.edge, edges.neighbors[rows], edges.features[rows])
            return h[rows] + self.out(self.norm(messages))

        return by_rows(layer, len(h))


class EdgeWeights(nn.Module):
    """A small network from the features of both ends and the invariants of an edge to `outputs` numbers."""

    def __init__(self, channels: int, sender_channels: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.own = nn.Linear(channels, hidden)
        self.sender = nn.Linear(sender_channels, hidden, bias=False)
        self.edge = nn.Parameter(torch.randn(FEATURES, hidden) / FEATURES**0.5)
        self.out = nn.Linear(hidden, outputs)

    def project(self, sender: Tensor) -> Tensor:
        """Return (M, hidden) the part of the sum that senders with (M, C') features contribute."""
        return by_rows(lambda rows: self.sender(sender[rows]), len(sender))

    def forward(self, h: Tensor, sent: Tensor, neighbors: Tensor, features: Tensor) -> Tensor:
        """(N, k, outputs) from (N, C) own features and the output of `project` for the senders."""
        return edge_mlp(self.own(h), sent, self.edge, self.out.weight, self.out.bias, neighbors, features)


class ZDirection(nn.Module):
    """Vote for the normals of points: by their neighbors (`vote_ops.votes`) and by the normals that they have so far.

    Args:
        channels: features of the points that vote for their own normals.
        sender_channels: features of the neighbors, for each set of them.
        hidden: channels of the small networks that weigh the votes.
    """

    def __init__(self, channels: int, sender_channels: tuple[int, ...], hidden: int) -> None:
        super().__init__()
        self.weights = nn.ModuleList(EdgeWeights(channels, width, hidden, BALLOTS) for width in sender_channels)
        self.own = nn.Linear(channels, 1)

    def forward(self, h: Tensor, to: Nodes, senders: list[tuple[Tensor, Nodes, Edges]]) -> Tensor:
        """(N, 3) unit normals from (N, C) features of the points, and each set's (M, C') features, nodes and edges."""
        sent = [weights.project(features) for weights, (features, _, _) in self._sets(senders)]

        def vote(rows: slice) -> Tensor:
            before = to.normals[rows]
            own = F.softplus(self.own(h[rows]))[:, :, None]
            matrix = -own * (before[:, :, None] * before[:, None])
            for (weights, (_, nodes, edges)), contribution in zip(self._sets(senders), sent, strict=True):
                neighbors = edges.neighbors[rows]
                ballots = F.softplus(weights(h[rows], contribution, neighbors, edges.features[rows]))
                places = to.positions[rows], edges.unit[rows], nodes.positions, nodes.normals
                matrix = matrix + votes(ballots, *places, neighbors)
            return smallest_eigenvector(matrix)

        return by_rows(vote, len(h))

    def _sets(
        self, senders: list[tuple[Tensor, Nodes, Edges]]
    ) -> Iterator[tuple[EdgeWeights, tuple[Tensor, Nodes, Edges]]]:
        return zip(cast("Iterable[EdgeWeights]", self.weights), senders, strict=True)
