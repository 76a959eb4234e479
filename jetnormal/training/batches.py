"""Batches of training patches, as a pure function of the seed, made ahead in a thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.data.sources import DataSource, LabeledCloud
from jetnormal.errors import InputError
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.geometry.patches import build_patches

AHEAD = 4  # batches that wait for the network
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class Batch:
    """Patches with the true normals of all their points.

    Attributes:
        points: (B, k, 3) float32 patches in their own frames.
        normals: (B, k, 3) float32 true unit normals in the same frames.
    """

    points: Tensor
    normals: Tensor


class PatchSampler:
    """Draws the batches of an epoch: `patches_per_cloud` patches of each cloud of the source, shuffled together.

    Any point may be a query, as in the published training: the .pidx files of PCPNet are for evaluation.

    Args:
        source: of the clouds.
        neighbors: points in a patch.
        patches_per_cloud: queries drawn from each cloud, without replacement where it has as many.
        batch_size: patches in a batch; what does not fill the last batch of an epoch is left out.
        seed: everything drawn follows from it.
    """

    def __init__(self, source: DataSource, neighbors: int, patches_per_cloud: int, batch_size: int, seed: int) -> None:
        self.source = source
        self.neighbors = neighbors
        self.patches_per_cloud = patches_per_cloud
        self.batch_size = batch_size
        self.seed = seed

    @property
    def batches_per_epoch(self) -> int:
        return self.source.clouds_per_epoch * self.patches_per_cloud // self.batch_size

    def epoch(self, epoch: int, first: int = 0) -> Iterator[Batch]:
        """The batches of an epoch from number `first` on; a thread prepares them ahead.

        Raises:
            InputError: if a cloud has fewer points than a patch.
        """
        clouds = self._clouds(epoch)
        picks = self._picks(epoch, clouds)

        def build(number: int) -> Batch:
            return self._batch(clouds, picks[number * self.batch_size : (number + 1) * self.batch_size])

        with ThreadPoolExecutor(1) as thread:
            yield from made_ahead(thread, build, range(first, self.batches_per_epoch))

    def _clouds(self, epoch: int) -> list[tuple[LabeledCloud, NeighborIndex]]:
        clouds = []
        for index in range(self.source.clouds_per_epoch):
            cloud = self.source.cloud(epoch, index, self.seed)
            clouds.append((cloud, NeighborIndex(cloud.points, threads=1)))
        return clouds

    def _picks(self, epoch: int, clouds: list[tuple[LabeledCloud, NeighborIndex]]) -> NDArray[np.int64]:
        """(P, 2) pairs of cloud and query, shuffled."""
        rng = np.random.default_rng([self.seed, epoch, 1])
        pairs = []
        for number, (cloud, _) in enumerate(clouds):
            drawn = rng.choice(len(cloud.points), self.patches_per_cloud, len(cloud.points) < self.patches_per_cloud)
            pairs.append(np.stack([np.full_like(drawn, number), drawn], axis=1))
        return rng.permutation(np.concatenate(pairs))

    def _batch(self, clouds: list[tuple[LabeledCloud, NeighborIndex]], picks: NDArray[np.int64]) -> Batch:
        parts = []
        for number in np.unique(picks[:, 0]):
            cloud, index = clouds[number]
            queries = picks[picks[:, 0] == number, 1]
            parts.append(labeled_patches(cloud, index, queries, self.neighbors))
        return Batch(torch.cat([p.points for p in parts]), torch.cat([p.normals for p in parts]))


def labeled_patches(cloud: LabeledCloud, index: NeighborIndex, queries: NDArray[np.int64], neighbors: int) -> Batch:
    """The patches around (B,) queries of a cloud, with the true normals of their points.

    Raises:
        InputError: if the cloud has fewer points than a patch.
    """
    if len(cloud.points) < neighbors:
        raise InputError(f"{cloud.name}: {len(cloud.points)} points; a patch needs {neighbors}")
    found, _ = index.query(cloud.points[queries], neighbors)
    found[:, 0] = queries  # a duplicate of the query may precede it
    patches = build_patches(cloud.points, queries, found)
    normals = patches.to_patch(torch.from_numpy(cloud.normals[found]).float())
    return Batch(patches.points, normals)


def made_ahead(thread: ThreadPoolExecutor, build: Callable[[int], _Made], numbers: range) -> Iterator[_Made]:
    """Yields build(n) for all numbers in order, with AHEAD of them under way."""
    waiting = [thread.submit(build, n) for n in numbers[:AHEAD]]
    try:
        for number in numbers:
            batch = waiting.pop(0).result()
            if number + AHEAD < numbers.stop:
                waiting.append(thread.submit(build, number + AHEAD))
            yield batch
    finally:
        for future in waiting:
            future.cancel()
