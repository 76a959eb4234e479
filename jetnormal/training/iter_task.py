"""What IterNet learns: the normals of the inner points of crops of clouds, after each iteration."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.data.sources import DataSource, LabeledCloud
from jetnormal.geometry.graph import Graph, build_graph, cloud_spacing
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.networks.iternet import IterNet, IterNetConfig
from jetnormal.training.batches import QuerySampler, labeled_points
from jetnormal.training.losses import iternet_loss
from jetnormal.training.options import IterTraining
from jetnormal.training.trainer import HELD_OUT_EPOCH

CHUNK = 512  # points at a time: what they need stays in the cache
HELD_OUT_CROPS = 4  # of each cloud
INNER = 0.5  # share of a crop's points, the nearest to its middle, that are learned from


@dataclass(frozen=True)
class RoundCrop:
    """The nearest points of a cloud around one of them, by ascending distance.

    Attributes:
        points: (n, 3) float64.
        normals: (n, 3) float64 true unit normals.
        learned: (m,) bool which of the first points, whose surroundings are about as in the whole cloud, are learned
            from: those with a true normal.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    learned: NDArray[np.bool_]


class RoundCropSampler(QuerySampler[NeighborIndex, list[RoundCrop]]):
    """Draw batches of crops; see `QuerySampler`."""

    def __init__(self, source: DataSource, crop_points: int, crops_per_cloud: int, batch_size: int, seed: int) -> None:
        super().__init__(source, crops_per_cloud, batch_size, seed)
        self.crop_points = crop_points

    def index(self, cloud: LabeledCloud) -> NeighborIndex:
        return NeighborIndex(cloud.points, threads=1)

    def gather(self, cloud: LabeledCloud, index: NeighborIndex, queries: NDArray[np.int64]) -> list[RoundCrop]:
        return round_crops(cloud, index, queries, self.crop_points)

    def join(self, parts: list[list[RoundCrop]]) -> list[RoundCrop]:
        return [crop for part in parts for crop in part]


def round_crops(cloud: LabeledCloud, index: NeighborIndex, queries: NDArray[np.int64], size: int) -> list[RoundCrop]:
    """Cut crops of a size, or the whole of a smaller cloud, around (B,) points, which are labeled."""
    found, _ = index.query(cloud.points[queries], min(size, len(cloud.points)))
    inner = max(1, round(INNER * found.shape[1]))
    labeled = np.ones(len(cloud.points), dtype=np.bool_) if cloud.labeled is None else cloud.labeled
    return [RoundCrop(cloud.points[rows], cloud.normals[rows], labeled[rows[:inner]]) for rows in found]


class IterTask:
    """See `trainer.Task`.

    An iteration starts from the normals and weights of the one before as from constants, as published. Those of the
    points around the inner ones are only computed as far as later iterations see them.

    Args:
        config: of the network.
        options: how it is trained.
        pool: threads, on each of which PyTorch runs alone (`support.device.worker_pool`).
    """

    unit = "crops"
    measures = ("rmse", "rmse_plane")

    def __init__(self, config: IterNetConfig, options: IterTraining, pool: ThreadPoolExecutor) -> None:
        self.network = IterNet(config)
        self._options = options
        self._pool = pool

    def sampler(self, source: DataSource) -> RoundCropSampler:
        options = self._options
        return RoundCropSampler(
            Turned(source), options.crop_points, options.crops_per_cloud, options.batch_size, options.seed
        )

    def samples(self, batch: list[RoundCrop]) -> int:
        return sum(int(crop.learned.sum()) for crop in batch)

    def backward(self, batch: list[RoundCrop]) -> dict[str, float]:
        parameters = list(self.network.parameters())
        results = list(self._pool.map(self._slope, batch))
        for parameter, *gradients in zip(parameters, *(gradients for gradients, _ in results), strict=True):
            parameter.grad = torch.stack(gradients).mean(0)
        losses = np.mean([losses for _, losses in results], axis=0)
        names = [f"iteration_{number + 1}" for number in range(len(losses))]
        return dict(zip(names, map(float, losses), strict=True)) | {"loss": float(losses.mean())}

    def _slope(self, crop: RoundCrop) -> tuple[list[Tensor], list[float]]:
        """The gradient of a crop's loss, which is the mean over the iterations, and the loss of each."""
        network, parameters = self.network, list(self.network.parameters())
        count, inner, iterations = len(crop.points), len(crop.learned), network.config.iterations
        graph = _graph(crop, network)
        learned = torch.from_numpy(crop.learned)
        true = torch.from_numpy(crop.normals[:inner]).float()[learned]
        normals, weights = _in_chunks(lambda rows: network.first(graph, rows), 0, count)
        gradients, losses = [torch.zeros_like(parameter) for parameter in parameters], []
        for left in range(iterations - 1, -1, -1):

            def refit(rows: slice) -> tuple[Tensor, Tensor]:
                with torch.autocast("cpu", torch.bfloat16, enabled=self._options.bfloat16):
                    return network.refit(graph, normals, weights[rows], rows)  # noqa: B023

            inside, inner_weights = _in_chunks(refit, 0, inner)
            loss = iternet_loss(inside[learned], true)
            for total, gradient in zip(gradients, torch.autograd.grad(loss, parameters), strict=True):
                total += gradient / iterations
            losses.append(loss.item())
            seen = inner + (count - inner) * left // iterations
            with torch.no_grad():
                outside, outer_weights = _in_chunks(refit, inner, seen)
            normals = torch.cat([inside.detach(), outside, normals[seen:]])
            weights = torch.cat([inner_weights.detach(), outer_weights])
        return gradients, losses

    def held_out(self, source: DataSource) -> list[RoundCrop]:
        """Draw some crops from each held-out cloud of a source."""
        seed, turned = self._options.seed, Turned(source)
        crops = []
        for number in range(source.clouds_per_epoch):
            cloud = turned.cloud(HELD_OUT_EPOCH, number, seed)
            queries = np.random.default_rng([seed, number]).choice(labeled_points(cloud), HELD_OUT_CROPS)
            crops += round_crops(cloud, NeighborIndex(cloud.points), queries, self._options.crop_points)
        return crops

    def errors(self, network: IterNet, held_out: list[RoundCrop]) -> tuple[float, ...]:
        """Measure the means over the crops of the RMSE in degrees of the last normals and of the first planes."""

        @torch.inference_mode()
        def measure(crop: RoundCrop) -> list[float]:
            graph = _graph(crop, network)
            count = len(crop.points)
            first, weights = _in_chunks(lambda rows: network.first(graph, rows), 0, count)
            last = first
            for _ in range(network.config.iterations):
                before, old = last, weights
                last, weights = _in_chunks(lambda rows: network.refit(graph, before, old[rows], rows), 0, count)  # noqa: B023
            rows = np.flatnonzero(crop.learned)
            return [rmse(angles(normals[rows].numpy(), crop.normals[rows])) for normals in (last, first)]

        return tuple(map(float, np.mean(list(self._pool.map(measure, held_out)), axis=0)))


class Turned:
    """The clouds of a source, each turned at random and scaled to a spacing of 1: the network sees raw offsets."""

    def __init__(self, source: DataSource) -> None:
        self._source = source
        self.clouds_per_epoch = source.clouds_per_epoch

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`."""
        from scipy.spatial.transform import Rotation

        cloud = self._source.cloud(epoch, index, seed)
        quaternion = np.random.default_rng([seed, epoch, index, 4]).normal(size=4)  # uniform over all rotations
        turn = Rotation.from_quat(quaternion).as_matrix().T
        points = (cloud.points - cloud.points.mean(axis=0)) / cloud_spacing(cloud.points, threads=1)
        return replace(cloud, points=points @ turn, normals=cloud.normals @ turn)


def _graph(crop: RoundCrop, network: IterNet) -> Graph:
    return build_graph(crop.points, network.config.neighbors + 1, 1.0, threads=1)


def _in_chunks(step: Callable[[slice], tuple[Tensor, Tensor]], start: int, stop: int) -> tuple[Tensor, Tensor]:
    """Normals and weights of the points from `start` to `stop`."""
    starts = range(start, stop, CHUNK) if stop > start else [start]
    normals, weights = zip(*(step(slice(first, min(first + CHUNK, stop))) for first in starts), strict=True)
    return torch.cat(normals), torch.cat(weights)
