"""Layers on the levels of a pyramid: edges described by invariants, edge convolutions, votes for a z-direction."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.geometry.pyramid import Level
from jetnormal.networks.cloudfit.edge_kernels import FEATURES, edge_features
from jetnormal.networks.cloudfit.edge_ops import edge_messages, edge_mlp
from jetnormal.networks.cloudfit.vote_ops import votes
from jetnormal.networks.eigenvectors import smallest_eigenvector
from jetnormal.networks.rows import by_rows, for_rows


@dataclass(frozen=True)
class Nodes:
    """A level of the pyramid as tensors, see `pyramid.Level`; `sign` tells on which side the centroid is."""

    positions: Tensor
    neighbors: Tensor
    scale: Tensor
    normals: Tensor
    centroid: Tensor
    sign: Tensor

    @classmethod
    def of(cls, level: Level) -> Nodes:
        """A level with the normals of its neighbors' planes."""
        arrays = (level.positions, level.neighbors, level.scale, level.normals, level.centroid)
        positions, neighbors, scale, normals, centroid = (torch.from_numpy(array) for array in arrays)
        return cls(positions, neighbors, scale, normals, centroid, sign=scale).turned(normals)

    def rows(self, rows: Tensor) -> Nodes:
        """The points at (Q,) int64 rows; their neighbors still count among all."""
        return Nodes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def turned(self, normals: Tensor) -> Nodes:
        """The same points with other normals."""
        sign = torch.tanh(3 * (normals * self.centroid).sum(1))
        return Nodes(self.positions, self.neighbors, self.scale, normals, self.centroid, sign)


@dataclass(frozen=True)
class Edges:
    """Edges from nodes to nodes: (N, k) int32 neighbors, (N,) unit of length and (N, k, 12) invariants."""

    neighbors: Tensor
    unit: Tensor
    features: Tensor


def connect(to: Nodes, sender: Nodes, neighbors: Tensor, unit: Tensor) -> Edges:
    """The edges to each of `to` from its `neighbors` among `sender`, with their twelve invariants.

    With d the offset in units of `unit`, n and n' the normals of receiver and sender, m and m' their centroids, t and
    t' their soft signs tanh(3 n.m), s and s' their scales:
    |d|^2, |d|, |n.d|, |n'.d|, (n.n')^2, (n.d)(n'.d)(n.n'), (n.d) t, (n'.d) t', m.d, m'.d, (n.n') t t', log s'/s.
    """
    own = [t.numpy() for t in (to.positions, to.normals, to.centroid, to.sign, to.scale, unit)]
    others = [t.numpy() for t in (sender.positions, sender.normals, sender.centroid, sender.sign, sender.scale)]

    features = torch.empty(*neighbors.shape, FEATURES)

    def describe(rows: slice) -> None:
        edge_features(*(array[rows] for array in own), *others, neighbors[rows].numpy(), features[rows].numpy())

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
    """A small function of both ends and the invariants of an edge, with `outputs` results."""

    def __init__(self, channels: int, sender_channels: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.own = nn.Linear(channels, hidden)
        self.sender = nn.Linear(sender_channels, hidden, bias=False)
        self.edge = nn.Parameter(torch.randn(FEATURES, hidden) / FEATURES**0.5)
        self.out = nn.Linear(hidden, outputs)

    def project(self, sender: Tensor) -> Tensor:
        """(M, hidden) what senders with (M, C') features contribute."""
        return by_rows(lambda rows: self.sender(sender[rows]), len(sender))

    def forward(self, h: Tensor, sent: Tensor, neighbors: Tensor, features: Tensor) -> Tensor:
        """(N, k, outputs) from (N, C) own features and what `project` made of the senders'."""
        return edge_mlp(self.own(h), sent, self.edge, self.out.weight, self.out.bias, neighbors, features)


class ZDirection(nn.Module):
    """The normals of a level by a vote of neighbors (`vote_ops.votes`) and of the normals that the points have."""

    def __init__(self, channels: int, sender_channels: int, hidden: int) -> None:
        super().__init__()
        self.weights = EdgeWeights(channels, sender_channels, hidden, 3)
        self.own = nn.Linear(channels, 1)

    def forward(self, h: Tensor, sender: Tensor, to: Nodes, senders: Nodes, edges: Edges) -> Tensor:
        """(N, 3) unit normals."""
        sent = self.weights.project(sender)

        def vote(rows: slice) -> Tensor:
            neighbors = edges.neighbors[rows]
            weights = F.softplus(self.weights(h[rows], sent, neighbors, edges.features[rows]))
            matrix = votes(weights, to.positions[rows], edges.unit[rows], senders.positions, senders.normals, neighbors)
            before = to.normals[rows]
            own = F.softplus(self.own(h[rows]))[:, :, None]
            return smallest_eigenvector(matrix - own * (before[:, :, None] * before[:, None]))

        return by_rows(vote, len(h))
