"""Batches of neighborhoods to train on, as a pure function of the seed, made ahead in a thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar

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
_Index = TypeVar("_Index")


@dataclass(frozen=True)
class Batch:
    """Patches with the true normals of all their points.

    Attributes:
        points: (B, k, 3) float32 patches in their own frames.
        normals: (B, k, 3) float32 true unit normals in the same frames.
    """

    points: Tensor
    normals: Tensor


class QuerySampler(Generic[_Index, _Made]):
    """Draw the batches of an epoch: neighborhoods of some queries of each cloud of the source, shuffled together.

    Any point may be a query, as in the published trainings: the .pidx files of PCPNet are for evaluation. A subclass
    says how neighborhoods are found and put together.

    Args:
        source: of the clouds.
        queries_per_cloud: drawn from each cloud, without replacement where it has as many.
        batch_size: queries in a batch; what does not fill the last batch of an epoch is left out.
        seed: everything drawn follows from it.
    """

    def __init__(self, source: DataSource, queries_per_cloud: int, batch_size: int, seed: int) -> None:
        self.source = source
        self.queries_per_cloud = queries_per_cloud
        self.batch_size = batch_size
        self.seed = seed

    def index(self, cloud: LabeledCloud) -> _Index:
        """Return what finds the neighborhoods of a cloud."""
        raise NotImplementedError

    def gather(self, cloud: LabeledCloud, index: _Index, queries: NDArray[np.int64]) -> _Made:
        """Return the neighborhoods of (B,) queries of a cloud."""
        raise NotImplementedError

    def join(self, parts: list[_Made]) -> _Made:
        """Return one batch of several."""
        raise NotImplementedError

    @property
    def batches_per_epoch(self) -> int:
        return self.source.clouds_per_epoch * self.queries_per_cloud // self.batch_size

    def epoch(self, epoch: int, first: int = 0) -> Iterator[_Made]:
        """Return the batches of an epoch from number `first` on; a thread prepares them ahead.

        Raises:
            InputError: if a cloud cannot be used.
        """
        clouds = [self.source.cloud(epoch, number, self.seed) for number in range(self.source.clouds_per_epoch)]
        indices = [self.index(cloud) for cloud in clouds]
        picks = self._picks(epoch, clouds)

        def build(number: int) -> _Made:
            chosen = picks[number * self.batch_size : (number + 1) * self.batch_size]
            several = np.unique(chosen[:, 0])
            return self.join([self.gather(clouds[n], indices[n], chosen[chosen[:, 0] == n, 1]) for n in several])

        with ThreadPoolExecutor(1) as thread:
            yield from made_ahead(thread, build, range(first, self.batches_per_epoch))

    def _picks(self, epoch: int, clouds: list[LabeledCloud]) -> NDArray[np.int64]:
        """(P, 2) pairs of cloud and query, shuffled."""
        rng = np.random.default_rng([self.seed, epoch, 1])
        pairs = []
        for number, cloud in enumerate(clouds):
            candidates = labeled_points(cloud)
            drawn = rng.choice(candidates, self.queries_per_cloud, len(candidates) < self.queries_per_cloud)
            pairs.append(np.stack([np.full_like(drawn, number), drawn], axis=1))
        return rng.permutation(np.concatenate(pairs))


class PatchSampler(QuerySampler[NeighborIndex, Batch]):
    """Draw batches of patches; see `QuerySampler`.

    Args:
        source: of the clouds.
        neighbors: points in a patch; a cloud with fewer raises InputError.
        patches_per_cloud, batch_size, seed: see `QuerySampler`.
    """

    def __init__(self, source: DataSource, neighbors: int, patches_per_cloud: int, batch_size: int, seed: int) -> None:
        super().__init__(source, patches_per_cloud, batch_size, seed)
        self.neighbors = neighbors

    def index(self, cloud: LabeledCloud) -> NeighborIndex:
        return NeighborIndex(cloud.points, threads=1)

    def gather(self, cloud: LabeledCloud, index: NeighborIndex, queries: NDArray[np.int64]) -> Batch:
        return labeled_patches(cloud, index, queries, self.neighbors)

    def join(self, parts: list[Batch]) -> Batch:
        return Batch(torch.cat([p.points for p in parts]), torch.cat([p.normals for p in parts]))


def labeled_points(cloud: LabeledCloud) -> NDArray[np.int64]:
    """Find the rows of the points of a cloud that have a true normal."""
    return np.arange(len(cloud.points)) if cloud.labeled is None else np.flatnonzero(cloud.labeled)


def held_out_queries(cloud: LabeledCloud, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw points to validate on: those that the cloud's list names, else labeled ones; all, where there are fewer."""
    candidates = labeled_points(cloud) if cloud.queries is None else cloud.queries
    return rng.choice(candidates, min(count, len(candidates)), replace=False)


def labeled_patches(cloud: LabeledCloud, index: NeighborIndex, queries: NDArray[np.int64], neighbors: int) -> Batch:
    """Return the patches around (B,) queries of a cloud, with the true normals of their points.

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
    """Yield build(n) for all numbers in order, with AHEAD of them under way."""
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
