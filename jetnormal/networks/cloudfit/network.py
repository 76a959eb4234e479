"""CloudFit: the paper's three steps - turn z to the normal, fit a weighted jet, correct it - once per point of a cloud.

A U-shaped graph network on a pyramid of the cloud gives each point features. From coarse to fine, the points of each
level then vote on their z-directions: a normal is the smallest eigenvector of a matrix to which each neighbor gives,
with learned weights, its offset, its normal and its normal mirrored. At the finest level a weighted jet is fitted
over that direction, and a learned combination of the neighbors' normals and of the jet's residuals corrects it.

Everything is made of quantities that no rotation, translation, scaling, permutation or choice of the normals' signs
changes (`layers.connect`), so the result turns with the cloud exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from jetnormal.geometry.jet import MAX_ORDER, Jet
from jetnormal.geometry.pyramid import Level
from jetnormal.networks.cloudfit.layers import EdgeConv, EdgeWeights, Nodes, ZDirection, connect
from jetnormal.networks.cloudfit.vote_ops import votes, weighted_jets
from jetnormal.networks.eigenvectors import smallest_eigenvector

NODE_FEATURES = 5
FIT_LEVELS = 3  # whose points take part in the fit
LEAST_WEIGHT = 1e-3  # of a point in the fit


@dataclass(frozen=True)
class CloudFitConfig:
    """What rebuilds a CloudFit network.

    Attributes:
        channels: of the levels, the cloud first; even numbers.
        hidden: channels of the functions that weigh edges.
        order: of the jet, 1 to 4.
        up_layers, down_layers: edge convolutions of each level on the way up and on the way down.

    Raises:
        ValueError: if the levels disagree or a number is out of range.
    """

    channels: tuple[int, ...] = (64, 128, 192, 192, 192)
    hidden: int = 32
    order: int = 2
    up_layers: tuple[int, ...] = (1, 1, 2, 2, 2)
    down_layers: tuple[int, ...] = (2, 2, 2, 2, 0)

    def __post_init__(self) -> None:
        if not FIT_LEVELS <= len(self.channels) == len(self.up_layers) == len(self.down_layers):
            raise ValueError(f"channels and layers must tell of the same levels, {FIT_LEVELS} or more")
        if any(width < 2 or width % 2 for width in self.channels) or self.hidden < 1:
            raise ValueError("channels are positive even numbers")
        if not 1 <= self.order <= MAX_ORDER:
            raise ValueError(f"the order of a jet is 1 to {MAX_ORDER}, not {self.order}")


@dataclass(frozen=True)
class Encoding:
    """What the trunk finds of a cloud.

    Attributes:
        nodes: the levels of the pyramid, with the normals voted for.
        features: (N, channels) of the cloud's points.
        sent: (n, hidden) what the points of the levels that are fitted contribute to the weights of the fit.
        parents: (n,) int64 nearest point of the next level, for each level but the last.
        directions: (n, 3) z-directions found on the way, the coarsest first, each with the (n,) int64 points of the
            cloud that its points come from.
    """

    nodes: list[Nodes]
    features: Tensor
    sent: list[Tensor]
    parents: list[Tensor]
    directions: list[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class CloudPrediction:
    """What the network says of Q points; normals are unit vectors of any sign.

    Attributes:
        direction: (Q, 3) z-directions.
        rough: (Q, 3) normals of the jet, on the side of the z-direction.
        refined: (Q, 3) corrected normals: a learned blend of the two above, pulled by the neighbors.
        jet: the fit over the z-direction, in units of `unit`.
        unit: (Q,) unit of length of the jet, in the cloud's.
        confidence: (Q,) logit of the probability that the refined normal is off by less than 10 degrees.
    """

    direction: Tensor
    rough: Tensor
    refined: Tensor
    jet: Jet
    unit: Tensor
    confidence: Tensor


class CloudFit(nn.Module):
    """See the module. `encode` looks at a whole cloud, `fit` at some points of it."""

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
        self.interpolate = nn.ModuleList(ZDirection(fine, coarse, hidden) for fine, coarse in steps)
        self.down = _layers(c, config.down_layers)
        self.direction = nn.ModuleList(ZDirection(width, width, hidden) for width in c)
        self.head = nn.ModuleList(EdgeWeights(c[0], width, hidden, 6) for width in c[:FIT_LEVELS])
        self.own = nn.Linear(c[0], 1)
        self.confidence = nn.Sequential(nn.Linear(c[0] + 1, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        self.blend = nn.Linear(c[0], 1)

    def for_inference(self) -> CloudFit:
        """The network itself, as it is used to estimate."""
        return self.eval().requires_grad_(False)

    def encode(self, pyramid: list[Level]) -> Encoding:
        """Features and z-directions of all levels."""
        nodes = [Nodes.of(level) for level in pyramid]
        h = self._ascend(pyramid, nodes)
        origins = _origins(pyramid)
        directions = []
        for number in range(len(nodes) - 1, -1, -1):
            here = nodes[number]
            if number + 1 < len(nodes):
                above, parents = nodes[number + 1], torch.from_numpy(pyramid[number].parents)
                edges = connect(here, above, parents, above.scale[parents[:, 0].long()])
                h[number] = self.unpool[number](h[number], h[number + 1], edges)
                normals = self.interpolate[number](h[number], h[number + 1], here, above, edges)
                directions.append((normals, origins[number]))
                here = here.turned(normals.detach())
            edges = connect(here, here, here.neighbors, here.scale)
            for layer in cast(nn.ModuleList, self.down[number]):
                h[number] = layer(h[number], h[number], edges)
            normals = self.direction[number](h[number], h[number], here, here, edges)
            directions.append((normals, origins[number]))
            nodes[number] = here.turned(normals.detach())
        nearest = [torch.from_numpy(level.parents[:, 0]).long() for level in pyramid[:-1]]
        sent = [cast(EdgeWeights, head).project(features) for head, features in zip(self.head, h, strict=False)]
        return Encoding(nodes, h[0], sent, nearest, directions)

    def _ascend(self, pyramid: list[Level], nodes: list[Nodes]) -> list[Tensor]:
        """Features of all levels on the way up."""
        features: list[Tensor] = []
        for number, (level, here) in enumerate(zip(pyramid, nodes, strict=True)):
            tilt = (here.normals * here.centroid).sum(1, keepdim=True).abs()
            length = here.centroid.norm(dim=1, keepdim=True)
            h = self.embed[number](torch.cat([torch.from_numpy(level.variance), tilt, length], 1))
            if number:
                below, chosen = nodes[number - 1], torch.from_numpy(pyramid[number - 1].chosen)
                edges = connect(here, below, _with_itself(chosen, below), below.scale[chosen])
                h = self.pool[number - 1](h, features[number - 1], edges)
            edges = connect(here, here, here.neighbors, here.scale)
            for layer in cast(nn.ModuleList, self.up[number]):
                h = layer(h, h, edges)
            features.append(h)
        return features

    def fit(self, encoding: Encoding, queries: Tensor, iterations: int = 1) -> CloudPrediction:
        """The weighted jet over points of the three finest levels, and its correction.

        Args:
            encoding: of the cloud.
            queries: (Q,) int64 points of the cloud.
            iterations: from the second on, the refined normal takes the place of the one voted for by the trunk.
        """
        here, h = encoding.nodes[0].rows(queries), encoding.features[queries]
        prediction = self._fit(encoding, here, h, queries)
        for _ in range(1, iterations):
            prediction = self._fit(encoding, here.turned(prediction.refined), h, queries)
        return prediction

    def _fit(self, encoding: Encoding, here: Nodes, h: Tensor, queries: Tensor) -> CloudPrediction:
        outputs, offsets, normals = [], [], []
        matrix = -F.softplus(self.own(h))[:, :, None] * (here.normals[:, :, None] * here.normals[:, None])
        at = queries
        for number, head in enumerate(self.head):
            if number:
                at = encoding.parents[number - 1][at]
            senders = encoding.nodes[number]
            edges = connect(here, senders, _with_itself(at, senders), senders.scale[at])
            output = head(h, encoding.sent[number], edges.neighbors, edges.features)
            ballots = F.softplus(output[..., :3])
            matrix = matrix + votes(
                ballots, here.positions, edges.unit, senders.positions, senders.normals, edges.neighbors
            )
            index = edges.neighbors.long()
            outputs.append(output[..., 3:])
            offsets.append(((senders.positions[index] - here.positions[:, None]) / here.scale[:, None, None]).float())
            normals.append(senders.normals[index])
        weight, pull, spring = torch.cat(outputs, 1).unbind(2)
        offset = torch.cat(offsets, 1)
        direction = smallest_eigenvector(matrix)
        frame = tangent_frame(direction.detach())
        local = offset @ frame
        jet = weighted_jets(torch.sigmoid(weight) + LEAST_WEIGHT, local, self.config.order)
        rough = (frame @ jet.normal[:, :, None])[:, :, 0]
        residual = local[..., 2] - jet.heights(local[..., :2])
        blend = torch.lerp(rough, direction, torch.sigmoid(self.blend(h)))
        added = _pull(rough.detach(), pull, spring, torch.cat(normals, 1), offset, residual)
        refined = F.normalize(blend + added, dim=1)
        change = 1 - (refined * rough).sum(1, keepdim=True)
        confidence = self.confidence(torch.cat([h, 10 * change], 1).detach())[:, 0]
        return CloudPrediction(direction, rough, refined, jet, here.scale, confidence)


def _pull(rough: Tensor, pull: Tensor, spring: Tensor, normals: Tensor, offset: Tensor, residual: Tensor) -> Tensor:
    """(Q, 3) mean of what the neighbors add to the normals.

    A neighbor adds its normal, and its offset times the residual of the fit, each by a learned factor between -1
    and 1 and on the side of the rough normal: both turn their sign with it.
    """
    aligned = normals * (normals * rough[:, None]).sum(2, keepdim=True)
    square = offset.square().sum(2).clamp_min(1e-12)
    added = torch.tanh(pull)[..., None] * aligned + (torch.tanh(spring) * residual / square)[..., None] * offset
    return added.mean(1)


def tangent_frame(z: Tensor) -> Tensor:
    """(N, 3, 3) rotations whose last column is the (N, 3) unit vector z (Duff et al., 2017)."""
    sign = torch.where(z[:, 2] < 0, -1.0, 1.0)
    a = -1 / (sign + z[:, 2])
    b = z[:, 0] * z[:, 1] * a
    x = torch.stack([1 + sign * z[:, 0] ** 2 * a, sign * b, -sign * z[:, 0]], 1)
    y = torch.stack([b, sign + z[:, 1] ** 2 * a, -z[:, 1]], 1)
    return torch.stack([x, y, z], 2)


def _layers(channels: tuple[int, ...], counts: tuple[int, ...]) -> nn.ModuleList:
    """For each level, its edge convolutions."""
    return nn.ModuleList(
        nn.ModuleList(EdgeConv(width, width) for _ in range(count))
        for width, count in zip(channels, counts, strict=True)
    )


def _with_itself(points: Tensor, nodes: Nodes) -> Tensor:
    """(Q, 17) int32: each of the (Q,) points and its neighbors."""
    return torch.cat([points.to(torch.int32)[:, None], nodes.neighbors[points]], 1)


def _origins(pyramid: list[Level]) -> list[Tensor]:
    """For each level, which points of the cloud its points come from."""
    origins = [torch.arange(len(pyramid[0].positions))]
    for level in pyramid[:-1]:
        origins.append(origins[-1][torch.from_numpy(level.chosen)])
    return origins
