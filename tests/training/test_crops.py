from __future__ import annotations

import numpy as np
import pytest

from jetnormal.data.sources import LabeledCloud
from jetnormal.training.crops import WINDOW, Crop, CropSampler, draw_crops


class Spheres:
    """Spheres about the origin, a new one in each epoch."""

    def __init__(self, clouds: int = 3, points: int = 300):
        self.clouds_per_epoch = clouds
        self.points = points

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        rng = np.random.default_rng([epoch, index, seed])
        normals = rng.normal(size=(self.points, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return LabeledCloud(f"sphere {index}", (index + 1) * normals, normals)


def sampler(clouds: int = 3, batch_size: int = 2, seed: int = 1) -> CropSampler:
    return CropSampler(Spheres(clouds), crop_points=100, crops_per_cloud=5, batch_size=batch_size, seed=seed)


def assert_equal(first: list[list[Crop]], second: list[list[Crop]]):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert all((a.points == b.points).all() for a, b in zip(one, other, strict=True))


def test_an_epoch_has_whole_batches_only():
    batches = list(sampler().epoch(0))
    assert len(batches) == sampler().batches_per_epoch == 7
    assert all(len(batch) == 2 for batch in batches)


def test_batches_follow_from_seed_and_epoch():
    batches = list(sampler().epoch(1))
    assert_equal(batches, list(sampler().epoch(1)))
    for other in (list(sampler(seed=2).epoch(1)), list(sampler().epoch(2))):
        assert (other[0][0].points != batches[0][0].points).any()


@pytest.mark.parametrize("first", [1, 3, 17, 20, 23, 24])
def test_an_epoch_may_start_at_any_batch(first: int):
    clouds = WINDOW + 2
    assert_equal(list(sampler(clouds).epoch(0, first=first)), list(sampler(clouds).epoch(0))[first:])


def test_a_crop_is_the_nearest_points_of_its_first():
    cloud = Spheres().cloud(0, 0, 0)
    for crop in draw_crops(cloud, 80, 4, np.random.default_rng(0)):
        distances = np.linalg.norm(cloud.points - crop.points[0], axis=1)
        np.testing.assert_allclose(np.linalg.norm(crop.points - crop.points[0], axis=1), np.sort(distances)[:80])
        np.testing.assert_allclose(crop.points, crop.normals)
        assert crop.inner == 40


def test_a_small_cloud_is_its_own_crop_without_copies():
    cloud = Spheres(points=60).cloud(0, 0, 0)
    doubled = LabeledCloud("", np.repeat(cloud.points, 2, axis=0), np.repeat(cloud.normals, 2, axis=0))
    (crop,) = draw_crops(doubled, 500, 1, np.random.default_rng(0))
    assert len(crop.points) == crop.inner == 60


def test_errors_of_the_source_arrive():
    class Broken(Spheres):
        def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
            raise ValueError("no such cloud")

    with pytest.raises(ValueError, match="no such cloud"):
        next(CropSampler(Broken(), 100, 5, 2, 0).epoch(0))
