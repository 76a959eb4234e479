"""Crops of clouds for training a whole-cloud network, as a pure function of the seed, made ahead in a thread."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.sources import DataSource, LabeledCloud
from jetnormal.training.batches import made_ahead

WINDOW = 8  # clouds whose crops are shuffled together


@dataclass(frozen=True)
class Crop:
    """The nearest points of a cloud around one of them, by ascending distance.

    Attributes:
        points: (n, 3) float64.
        normals: (n, 3) float64 true unit normals.
        inner: how many of the first points have a neighborhood like in the whole cloud.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    inner: int


class CropSampler:
    """Draws the batches of an epoch: `crops_per_cloud` crops of each cloud of the source.

    Args:
        source: of the clouds.
        crop_points: points of a crop; a smaller cloud is its own crop.
        crops_per_cloud: crops around random points of each cloud.
        batch_size: crops in a batch; what does not fill the last batch of an epoch is left out.
        seed: everything drawn follows from it.
    """

    def __init__(self, source: DataSource, crop_points: int, crops_per_cloud: int, batch_size: int, seed: int) -> None:
        self.source = source
        self.crop_points = crop_points
        self.crops_per_cloud = crops_per_cloud
        self.batch_size = batch_size
        self.seed = seed

    @property
    def batches_per_epoch(self) -> int:
        return self.source.clouds_per_epoch * self.crops_per_cloud // self.batch_size

    def epoch(self, epoch: int, first: int = 0) -> Iterator[list[Crop]]:
        """The batches of an epoch from number `first` on; a thread prepares a window of clouds ahead."""
        window, skip = divmod(first * self.batch_size, WINDOW * self.crops_per_cloud)
        windows = range(window, -(-self.source.clouds_per_epoch // WINDOW))
        batch: list[Crop] = []
        with ThreadPoolExecutor(1) as thread:
            for crops in made_ahead(thread, lambda number: self._window(epoch, number * WINDOW), windows):
                for crop in crops[skip:]:
                    batch.append(crop)
                    if len(batch) == self.batch_size:
                        yield batch
                        batch = []
                skip = 0

    def _window(self, epoch: int, start: int) -> list[Crop]:
        """The shuffled crops of a window of clouds."""
        crops = []
        for index in range(start, min(start + WINDOW, self.source.clouds_per_epoch)):
            cloud = self.source.cloud(epoch, index, self.seed)
            rng = np.random.default_rng([self.seed, epoch, index, 2])
            crops += draw_crops(cloud, self.crop_points, self.crops_per_cloud, rng)
        order = np.random.default_rng([self.seed, epoch, start, 3]).permutation(len(crops))
        return [crops[number] for number in order]


def draw_crops(cloud: LabeledCloud, points: int, count: int, rng: np.random.Generator) -> list[Crop]:
    """Crops of a cloud around random points of it; copies of a point are left out."""
    from scipy.spatial import cKDTree

    from jetnormal.geometry.neighbors import distinct

    rows = np.sort(distinct(cloud.points)[0])
    places, normals = cloud.points[rows], cloud.normals[rows]
    points = min(points, len(places))
    inner = points if points == len(places) else points // 2
    _, found = cKDTree(places).query(places[rng.integers(len(places), size=count)], points)
    return [Crop(places[nearest], normals[nearest], inner) for nearest in found.reshape(count, points)]
