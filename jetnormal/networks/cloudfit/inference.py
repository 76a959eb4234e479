"""CloudFit without PyTorch: NumPy's matrix products around the compiled loops.

Estimation on a CPU needs no gradients, and importing PyTorch takes longer than the network takes for 50,000
points. This is `network.CloudFit.forward` step by step; tests check that both give the same result.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from jetnormal.errors import ModelError
from jetnormal.geometry.neighbors import inverse_order
from jetnormal.geometry.pyramid import SAME, Level, Neighborhood, Pyramid
from jetnormal.networks.cloudfit import edge_kernels, vote_kernels
from jetnormal.networks.cloudfit.config import BALLOTS, FEATURES, CloudFitConfig, check_shapes
from jetnormal.networks.model_file import read_model_file
from jetnormal.support.device import available_cores

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

CHUNK = 2048  # rows computed at a time by a thread: what they need stays in its cache


@dataclass(frozen=True)
class Surface:
    """Points with normals, see `layers.Nodes`; `sign` tells on which side of the normal the centroid is."""

    neighborhood: Neighborhood
    normals: F32
    sign: F32
    log_scale: F32

    @classmethod
    def of(cls, neighborhood: Neighborhood) -> Surface:
        """Give points the normals of their neighbors' planes."""
        scale = neighborhood.scale
        return cls(neighborhood, neighborhood.normals, scale, np.log(scale)).turned(neighborhood.normals)

    def turned(self, normals: F32) -> Surface:
        """Give the same points other normals."""
        sign = np.tanh(3 * np.einsum("ij,ij->i", normals, self.neighborhood.centroid))
        return replace(self, normals=normals, sign=sign)


@dataclass(frozen=True)
class Edges:
    """Edges to points from others: (N, k) neighbors and (N,) unit of length.

    Each layer computes their invariants again, which is faster than keeping them in memory.
    """

    to: Surface
    sender: Surface
    neighbors: I32
    unit: F32

    def features(self, rows: slice) -> F32:
        """Compute the (n, k, 12) invariants of the edges to some rows; see `layers.connect`."""
        shape, other = self.to.neighborhood, self.sender.neighborhood
        own = (shape.positions, self.to.normals, shape.centroid, self.to.sign, self.to.log_scale, self.unit)
        others = (other.positions, self.sender.normals, other.centroid, self.sender.sign, self.sender.log_scale)
        neighbors = self.neighbors[rows]
        features = np.empty((*neighbors.shape, FEATURES), np.float32)
        edge_kernels.edge_features(*(a[rows] for a in own), *others, neighbors, features)
        return features


@dataclass(frozen=True)
class Found:
    """The output of the network for the N points of a cloud; see `network.CloudPrediction`.

    Attributes:
        normals: (N, 3) unit vectors of any sign.
        rough: (N, 3) the normals before the last vote.
        confidence: (N,) logit of the probability that a normal is off by less than 10 degrees.
        levels: (n, 3) normals of each level of the pyramid.
    """

    normals: F32
    rough: F32
    confidence: F32
    levels: list[F32]


class Inference:
    """A trained CloudFit network, ready to be called on the CPU.

    Args:
        config: of the network.
        weights: its parameters by the names that `network.CloudFit` gives them.

    Raises:
        ValueError: a parameter is missing, or has another shape than the configuration says.
    """

    def __init__(self, config: CloudFitConfig, weights: dict[str, F32]) -> None:
        self.config = config
        check_shapes(config, {name: values.shape for name, values in weights.items()})
        self._weights = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in weights.items()}

    @classmethod
    def load(cls, path: Path) -> Inference:
        """Load a network from a model file.

        Raises:
            ModelError: the file is missing, damaged, or holds another network.
        """
        weights, description = read_model_file(path)
        try:
            return cls(CloudFitConfig.from_description(description["config"]), weights)
        except (KeyError, TypeError, ValueError) as error:
            raise ModelError(f"{path}: its configuration and its weights do not fit ({error})") from error

    def __call__(self, pyramid: Pyramid, threads: int | None = None) -> Found:
        """Find the normals of a cloud.

        Args:
            pyramid: of the cloud, with as many levels as the network.
            threads: CPU threads; None for all cores. The result does not depend on them.
        """
        with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads or available_cores()) as pool:
            return _Pass(self.config, self._weights, pool).run(pyramid)


class _Pass:
    """One pass of the network over a cloud; the methods have the names of the modules of `network.CloudFit`."""

    def __init__(self, config: CloudFitConfig, weights: dict[str, F32], pool: ThreadPoolExecutor) -> None:
        self._config = config
        self._w = weights
        self._pool = pool
        self._scratch: dict[int, F32] = {}

    def run(self, pyramid: Pyramid) -> Found:
        levels = pyramid.levels
        surfaces = [Surface.of(level) for level in levels]
        h = self._ascend(levels, surfaces)
        rough = normals = surfaces[-1].normals
        for number in range(len(levels) - 1, -1, -1):
            here = surfaces[number]
            if number + 1 < len(levels):
                above, parents = surfaces[number + 1], levels[number].parents
                edges = Edges(here, above, parents, levels[number + 1].scale[parents[:, 0]])
                self._edge_conv(f"unpool.{number}", h[number], h[number + 1], edges)
                here = here.turned(
                    self._vote(f"interpolate.{number}", h[number], here, [(h[number + 1], above, edges)])
                )
            surfaces[number] = here
            for vote in range(self._config.votes(number)):
                rough = surfaces[number].normals
                if self._config.down_layers[number]:
                    edges = _within(surfaces[number], levels[number])
                    self._edge_conv(f"down.{number}.{vote}", h[number], h[number], edges)
                normals = self._vote_at(number, vote, levels, h, surfaces)
                surfaces[number] = surfaces[number].turned(normals)
            del h[number + 2 :]  # nobody asks for them any more
        confidence = self._confidence(h[0], normals, rough)
        if len(pyramid.left_out):
            carried = self._carry(pyramid.carried, surfaces[0], h[0])
            place = inverse_order(np.concatenate([pyramid.kept, pyramid.left_out]))
            kept = (normals, rough, confidence)
            normals, rough, confidence = (np.concatenate(pair)[place] for pair in zip(kept, carried, strict=True))
        return Found(normals, rough, confidence, [surface.normals for surface in surfaces])

    def _ascend(self, levels: list[Level], surfaces: list[Surface]) -> list[F32]:
        features: list[F32] = []
        for number, here in enumerate(surfaces):
            h = self._embed(number, here)  # each layer writes over it
            if number:
                below, chosen = surfaces[number - 1], levels[number - 1].chosen
                own = _with_itself(chosen, levels[number - 1])
                edges = Edges(here, below, own, levels[number - 1].scale[chosen])
                self._edge_conv(f"pool.{number - 1}", h, features[number - 1], edges)
            if self._config.up_layers[number]:
                edges = _within(here, levels[number])
                for layer in range(self._config.up_layers[number]):
                    self._edge_conv(f"up.{number}.{layer}", h, h, edges)
            features.append(h)
        return features

    def _embed(self, number: int, here: Surface) -> F32:
        shape = here.neighborhood

        def embed(rows: slice) -> F32:
            centroid = shape.centroid[rows]
            tilt = np.abs(np.einsum("ij,ij->i", here.normals[rows], centroid))[:, None]
            length = np.sqrt(np.einsum("ij,ij->i", centroid, centroid))[:, None]
            return self._linear(f"embed.{number}", np.concatenate([shape.variance[rows], tilt, length], axis=1))

        return self._by_rows(embed, len(here.normals), (self._config.channels[number],))

    def _vote_at(self, number: int, vote: int, levels: list[Level], h: list[F32], surfaces: list[Surface]) -> F32:
        here = surfaces[number]
        senders = [(h[number], here, _within(here, levels[number]))]
        if number + 1 < len(levels):
            above, parent = levels[number + 1], levels[number].parents[:, 0]
            neighbors = _with_itself(parent, above)
            wide = Edges(here, surfaces[number + 1], neighbors, above.scale[parent])
            senders.append((h[number + 1], surfaces[number + 1], wide))
        return self._vote(f"direction.{number}.{vote}", h[number], here, senders)

    def _carry(self, carried: Neighborhood, level: Surface, h: F32) -> tuple[F32, F32, F32]:
        nearest = carried.neighbors[:, 0]
        rough = level.normals[nearest]
        shape = Surface.of(carried)
        features = self._embed(0, shape)
        here = shape.turned(rough)
        edges = Edges(here, level, carried.neighbors, carried.scale)
        self._edge_conv("carry", features, h, edges)
        normals = self._vote("carried_direction", features, here, [(h, level, edges)])
        apart = np.linalg.norm(carried.positions - level.neighborhood.positions[nearest], axis=1)
        normals = np.where((apart <= SAME * level.neighborhood.scale[nearest])[:, None], rough, normals)
        return normals, rough, self._confidence(features, normals, rough)

    def _confidence(self, h: F32, normals: F32, rough: F32) -> F32:
        def rate(rows: slice) -> F32:
            change = 1 - np.abs(np.einsum("ij,ij->i", normals[rows], rough[rows]))[:, None]
            hidden = self._linear("confidence.0", np.concatenate([h[rows], 10 * change], axis=1))
            return self._linear("confidence.2", np.maximum(hidden, 0))[:, 0]

        return self._by_rows(rate, len(h), ())

    def _edge_conv(self, name: str, h: F32, sender: F32, edges: Edges) -> None:
        """Writes what `layers.EdgeConv` makes of the features h over them."""
        pools = len(sender) > len(h)
        sent = None if pools else self._product(f"{name}.sender", sender)
        weight, gain, shift = (self._w[f"{name}.{key}"] for key in ("edge", "norm.weight", "norm.bias"))

        def layer(rows: slice) -> None:
            own = self._linear(f"{name}.own", h[rows])
            messages, neighbors, contribution = np.empty_like(own), edges.neighbors[rows], sent
            if contribution is None:  # for all senders at once, it would be the largest array of all
                used, inverse = np.unique(neighbors, return_inverse=True)
                neighbors = inverse.reshape(neighbors.shape).astype(np.int32)
                contribution = sender[used] @ self._w[f"{name}.sender.weight"].T
            edge_kernels.edge_messages(own, contribution, neighbors, edges.features(rows), weight, messages)
            edge_kernels.layer_norm(messages, gain, shift)
            h[rows] += self._linear(f"{name}.out", messages)

        self._for_rows(layer, len(h))

    def _vote(self, name: str, h: F32, to: Surface, senders: list[tuple[F32, Surface, Edges]]) -> F32:
        """See `layers.ZDirection`."""
        names = [f"{name}.weights.{number}" for number in range(len(senders))]
        sent = [
            self._product(f"{part}.sender", features, place)
            for place, (part, (features, _, _)) in enumerate(zip(names, senders, strict=True))
        ]
        positions = to.neighborhood.positions

        def vote(rows: slice) -> F32:
            before = to.normals[rows]
            own = _softplus(self._linear(f"{name}.own", h[rows]))
            matrix = -own[:, :, None] * (before[:, :, None] * before[:, None])
            added = np.empty_like(matrix)
            for part, contribution, (_, surface, edges) in zip(names, sent, senders, strict=True):
                ballots = self._ballots(part, h[rows], contribution, edges, rows)
                places = positions[rows], edges.unit[rows], surface.neighborhood.positions, surface.normals
                vote_kernels.votes(*places, edges.neighbors[rows], ballots, added)
                matrix += added
            normals = np.empty((len(matrix), 3), np.float32)
            vote_kernels.smallest_eigenvectors(matrix, normals)
            return normals

        return self._by_rows(vote, len(h), (3,))

    def _ballots(self, name: str, h: F32, sent: F32, edges: Edges, rows: slice) -> F32:
        """See `layers.EdgeWeights`; (n, k, 3) non-negative weights of votes."""
        own = self._linear(f"{name}.own", h)
        out = np.empty((*edges.neighbors[rows].shape, BALLOTS), np.float32)
        parameters = (self._w[f"{name}.{key}"] for key in ("edge", "out.weight", "out.bias"))
        edge_kernels.edge_mlp(own, sent, edges.neighbors[rows], edges.features(rows), *parameters, out)
        return _softplus(out)

    def _linear(self, name: str, x: F32) -> F32:
        return x @ self._w[f"{name}.weight"].T + self._w[f"{name}.bias"]

    def _product(self, name: str, x: F32, place: int = 0) -> F32:
        """x (N, C) times a matrix, in memory that the next product of the same place writes over.

        The system takes as long to give new memory for a large cloud as a layer takes to fill it.
        """
        weight = self._w[f"{name}.weight"]
        size = len(x) * len(weight)
        if place not in self._scratch or self._scratch[place].size < size:
            self._scratch[place] = np.empty(size, np.float32)
        out = self._scratch[place][:size].reshape(len(x), len(weight))
        self._for_rows(lambda rows: np.matmul(x[rows], weight.T, out=out[rows]), len(x))
        return out

    def _for_rows(self, work: Callable[[slice], object], count: int) -> None:
        """Call work(rows) for the rows 0 to count, in chunks whose size does not depend on the number of threads."""
        chunks = (slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK))
        if count <= CHUNK:
            work(slice(0, count))
        else:
            list(self._pool.map(work, chunks))

    def _by_rows(self, function: Callable[[slice], F32], count: int, shape: tuple[int, ...]) -> F32:
        """function(rows) for the rows 0 to count, put together."""
        out = np.empty((count, *shape), np.float32)

        def work(rows: slice) -> None:
            out[rows] = function(rows)

        self._for_rows(work, count)
        return out


def _within(surface: Surface, level: Level) -> Edges:
    """The edges between the points of a level."""
    return Edges(surface, surface, level.neighbors, level.scale)


def _with_itself(points: NDArray[np.integer], level: Level) -> I32:
    """(Q, 17) int32: each of the (Q,) points and its neighbors."""
    return np.concatenate([points.astype(np.int32)[:, None], level.neighbors[points]], axis=1)


def _softplus(x: F32) -> F32:
    return np.maximum(x, 0) + np.log(1 + np.exp(-np.abs(x)))
