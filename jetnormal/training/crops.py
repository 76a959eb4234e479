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
SPREAD = 1.7  # a crop has up to this many times the asked number of points, or as many times fewer
INNER = 0.55  # share of a crop's points, the nearest to its middle, whose surroundings are as in the whole cloud
SPARSE_SHARE = 0.1  # of the clouds, which give a few of their points, spread over all of it, as one more crop
SPARSE = (64, 3000)  # points of such a crop


@dataclass(frozen=True)
class Crop:
    """Some points of a cloud.

    Attributes:
        points: (n, 3) float64.
        normals: (n, 3) float64 true unit normals.
        learned: (n,) which points have a normal to learn, and surroundings as in the whole cloud.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    learned: NDArray[np.bool_]


class CropSampler:
    """Draw the batches of an epoch: `crops_per_cloud` crops of each cloud of the source.

    Args:
        source: of the clouds.
        crop_points: points of a crop, about; a smaller cloud is its own crop.
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
        """Return the batches of an epoch from number `first` on; a thread prepares a window of clouds ahead."""
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
    """Draw crops of a cloud around random labeled points of it, the first now and then sparse; no point comes twice.

    Args:
        cloud: with at least one labeled point.
        points: of a crop, about: their number varies, so that the coarse levels see more and less.
        count: number of crops.
        rng: source of randomness.
    """
    from scipy.spatial import cKDTree

    from jetnormal.geometry.neighbors import distinct, spatial_order

    rows = np.sort(distinct(cloud.points)[0])
    rows = rows[spatial_order(cloud.points[rows])]
    places, normals = cloud.points[rows], cloud.normals[rows]
    labeled = np.ones(len(rows), dtype=np.bool_) if cloud.labeled is None else cloud.labeled[rows]
    tree = cKDTree(places)
    crops = []
    for middle in rng.choice(np.flatnonzero(labeled), count):
        size = min(len(places), round(points * SPREAD ** rng.uniform(-1, 1)))
        nearest = np.atleast_1d(tree.query(places[middle], size)[1])
        learned = labeled[nearest]
        if size < len(places):
            learned[round(INNER * size) :] = False
        order = np.argsort(nearest)  # in space again: what the network reads together then lies together
        nearest = nearest[order]
        crops.append(Crop(places[nearest], normals[nearest], learned[order]))
    if rng.random() < SPARSE_SHARE:
        crops[0] = _sparse(places, normals, labeled, rng)
    return crops


def _sparse(
    places: NDArray[np.float64], normals: NDArray[np.float64], labeled: NDArray[np.bool_], rng: np.random.Generator
) -> Crop:
    """A few points, spread over all of a cloud, at least one of them labeled."""
    fewest, most = SPARSE
    size = min(len(places), round(fewest * (most / fewest) ** rng.random()))
    some = rng.permutation(len(places))[:size]
    some[0] = rng.choice(np.flatnonzero(labeled)) if not labeled[some].any() else some[0]
    return Crop(places[some], normals[some], labeled[some])
