from __future__ import annotations

import numpy as np
import pytest

from jetnormal.data.sources import LabeledCloud
from jetnormal.training.crops import INNER, SPARSE, SPREAD, WINDOW, Crop, CropSampler, draw_crops


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
        assert all(np.array_equal(a.points, b.points) for a, b in zip(one, other, strict=True))


def test_an_epoch_has_whole_batches_only():
    batches = list(sampler().epoch(0))
    assert len(batches) == sampler().batches_per_epoch == 7
    assert all(len(batch) == 2 for batch in batches)


def test_batches_follow_from_seed_and_epoch():
    batches = list(sampler().epoch(1))
    assert_equal(batches, list(sampler().epoch(1)))
    for other in (list(sampler(seed=2).epoch(1)), list(sampler().epoch(2))):
        assert not np.array_equal(other[0][0].points, batches[0][0].points)


@pytest.mark.parametrize("first", [1, 3, 17, 20, 23, 24])
def test_an_epoch_may_start_at_any_batch(first: int):
    clouds = WINDOW + 2
    assert_equal(list(sampler(clouds).epoch(0, first=first)), list(sampler(clouds).epoch(0))[first:])


def test_a_crop_is_the_nearest_points_of_a_middle_and_learns_the_inner_ones():
    cloud = Spheres(points=600).cloud(0, 0, 0)
    sizes = set()
    for crop in draw_crops(cloud, 80, 20, np.random.default_rng(0))[1:]:
        size, inner = len(crop.points), round(INNER * len(crop.points))
        sizes.add(size)
        np.testing.assert_allclose(crop.points, crop.normals)
        assert crop.learned.sum() == inner
        middles = 0
        for middle in crop.points[crop.learned]:
            nearest = np.sort(np.linalg.norm(cloud.points - middle, axis=1))
            far = np.linalg.norm(crop.points - middle, axis=1)
            middles += far.max() < nearest[size - 1] + 1e-12 and far[crop.learned].max() < nearest[inner - 1] + 1e-12
        assert middles >= 1
    assert 80 / SPREAD - 1 < min(sizes) < 70
    assert 100 < max(sizes) < 80 * SPREAD + 1


def test_neighbors_in_a_crop_lie_near_in_memory():
    cloud = Spheres(points=20_000).cloud(0, 0, 0)
    points = draw_crops(cloud, 8000, 2, np.random.default_rng(0))[1].points
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(step) < 0.1 * np.linalg.norm(np.ptp(points, axis=0))


def test_points_without_a_label_are_neither_a_middle_nor_learned():
    cloud = Spheres(points=600).cloud(0, 0, 0)
    labeled = cloud.points[:, 0] > 0
    cloud = LabeledCloud("", cloud.points, cloud.normals, labeled=labeled)
    for crop in draw_crops(cloud, 80, 20, np.random.default_rng(0)):
        assert crop.learned.any()
        assert (crop.points[crop.learned, 0] > 0).all()


def test_some_clouds_give_a_sparse_crop_of_all_their_surface():
    cloud = Spheres(points=5000).cloud(0, 0, 0)
    firsts = [draw_crops(cloud, 80, 1, np.random.default_rng(seed))[0] for seed in range(100)]
    sparse = [crop for crop in firsts if np.ptp(crop.points, axis=0).min() > 1.5 and crop.learned.all()]
    assert 3 <= len(sparse) <= 25
    assert all(SPARSE[0] <= len(crop.points) <= SPARSE[1] for crop in sparse)


def test_a_small_cloud_is_its_own_crop_without_copies():
    cloud = Spheres(points=60).cloud(0, 0, 0)
    doubled = LabeledCloud("", np.repeat(cloud.points, 2, axis=0), np.repeat(cloud.normals, 2, axis=0))
    (crop,) = draw_crops(doubled, 500, 1, np.random.default_rng(0))
    assert len(crop.points) == crop.learned.sum() == 60


def test_errors_of_the_source_arrive():
    class Broken(Spheres):
        def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
            raise ValueError("no such cloud")

    with pytest.raises(ValueError, match="no such cloud"):
        next(CropSampler(Broken(), 100, 5, 2, 0).epoch(0))
