from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from jetnormal.data.sources import LabeledCloud
from jetnormal.errors import InputError
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.training.batches import AHEAD, Batch, PatchSampler, held_out_queries, labeled_patches

K = 20


class Spheres:
    """Spheres about the origin, a new one in each epoch."""

    def __init__(self, clouds: int = 3, points: int = 200, queries: list[int] | None = None):
        self.clouds_per_epoch = clouds
        self.points = points
        self.queries = None if queries is None else np.array(queries)

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        rng = np.random.default_rng([epoch, index, seed])
        normals = rng.normal(size=(self.points, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return LabeledCloud(f"sphere {index}", (index + 1) * normals, normals, self.queries)


def sampler(source=None, patches_per_cloud=20, batch_size=8, seed=3) -> PatchSampler:
    return PatchSampler(source or Spheres(), K, patches_per_cloud, batch_size, seed)


def assert_equal(first: list[Batch], second: list[Batch]):
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a.points, b.points) and torch.equal(a.normals, b.normals)


def test_an_epoch_has_whole_batches_only():
    batches = list(sampler().epoch(0))
    assert len(batches) == sampler().batches_per_epoch == 7  # 60 patches, 8 at a time
    for batch in batches:
        assert batch.points.shape == batch.normals.shape == (8, K, 3)
        assert batch.points.dtype == batch.normals.dtype == torch.float32


def test_batches_follow_from_seed_and_epoch():
    batches = list(sampler().epoch(1))
    assert_equal(batches, list(sampler().epoch(1)))
    for other in (list(sampler(seed=4).epoch(1)), list(sampler().epoch(2))):
        assert not torch.equal(other[0].points, batches[0].points)


@pytest.mark.parametrize("first", [1, 4, 6, 7])
def test_an_epoch_may_start_at_any_batch(first):
    assert_equal(list(sampler().epoch(0, first=first)), list(sampler().epoch(0))[first:])


def test_patches_of_a_sphere_have_its_normals():
    """In the frame of its patch, too, a normal is the direction from the sphere's center."""
    cloud = Spheres().cloud(0, 1, 0)
    batch = labeled_patches(cloud, NeighborIndex(cloud.points), np.arange(12), K)
    distance = np.linalg.norm(cloud.points[:12, None] - cloud.points[None], axis=2)
    radius = torch.from_numpy(np.sort(distance, axis=1)[:, K - 1]).float()
    center = -batch.normals[:, :1] * (2 / radius)[:, None, None]  # from the query at the origin
    expected = torch.nn.functional.normalize(batch.points - center, dim=2)
    torch.testing.assert_close(batch.normals, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(batch.normals.norm(dim=2), torch.ones(12, K))
    assert not batch.points[:, 0].any()


def test_the_query_comes_first_among_its_duplicates():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3))
    points[20] = points[10] = points[5]
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    queries = np.array([20, 5, 10])
    batch = labeled_patches(LabeledCloud("", points, normals), NeighborIndex(points), queries, 60)
    cosine = batch.normals[:, 0] @ batch.normals[:, 0].T  # all three have one frame: it is the same patch
    expected = torch.from_numpy(normals[queries] @ normals[queries].T).float()
    torch.testing.assert_close(cosine, expected, rtol=0, atol=1e-5)


def test_any_point_is_drawn_whatever_is_listed_for_evaluation():
    patches = [b.points for b in sampler(Spheres(1, 40, [3, 8]), patches_per_cloud=40).epoch(0)]
    assert len({patch.numpy().tobytes() for patch in torch.cat(patches)}) == 40


def test_stray_points_are_not_validated_on():
    cloud = Spheres(1, 40).cloud(0, 0, 0)
    rng = np.random.default_rng(0)
    scan = replace(cloud, labeled=np.arange(40) >= 30)
    assert sorted(held_out_queries(scan, 100, rng)) == list(range(30, 40))
    assert sorted(held_out_queries(cloud, 100, rng)) == list(range(40))
    listed = replace(cloud, queries=np.array([3, 8]))
    assert sorted(held_out_queries(listed, 2, rng)) == [3, 8] and len(held_out_queries(listed, 1, rng)) == 1


def test_a_cloud_of_few_points_gives_some_of_them_again():
    patches = torch.cat([b.points for b in sampler(Spheres(1, 30), patches_per_cloud=60, batch_size=60).epoch(0)])
    assert len(patches) == 60


def test_queries_are_drawn_without_replacement_where_there_are_enough():
    patches = torch.cat([b.points for b in sampler(Spheres(1, 40), patches_per_cloud=40).epoch(0)])
    assert len({patch.numpy().tobytes() for patch in patches}) == 40


def test_a_batch_mixes_clouds():
    source = Spheres()
    clouds = [source.cloud(0, index, 3) for index in range(3)]
    patches = [labeled_patches(c, NeighborIndex(c.points), np.arange(200), K).points.flatten(1) for c in clouds]
    for batch in sampler(source, batch_size=30).epoch(0):
        origin = [min(range(3), key=lambda i: torch.cdist(p[None], patches[i]).min()) for p in batch.points.flatten(1)]
        assert set(origin) == {0, 1, 2}


def test_a_cloud_smaller_than_a_patch_is_named():
    with pytest.raises(InputError, match="sphere 0: 19 points; a patch needs 20"):
        list(sampler(Spheres(points=19)).epoch(0))


def test_errors_of_the_source_arrive():
    class Broken(Spheres):
        def cloud(self, epoch, index, seed):
            raise InputError("broken.xyz: cannot be read")

    with pytest.raises(InputError, match=r"broken\.xyz"):
        next(sampler(Broken()).epoch(0))


def test_an_epoch_that_is_left_early_ends_its_thread():
    before = threading.active_count()
    batches = sampler().epoch(0)
    next(batches)
    assert threading.active_count() == before + 1
    batches.close()
    assert threading.active_count() == before


def test_batches_are_made_ahead_but_not_all_at_once(monkeypatch):
    made = []
    build = PatchSampler.join
    monkeypatch.setattr(PatchSampler, "join", lambda self, *args: made.append(1) or build(self, *args))
    source = Spheres(points=500)
    batches = sampler(source, patches_per_cloud=200).epoch(0)
    for _ in range(3):
        next(batches)
    assert len(made) <= 3 + AHEAD
    batches.close()
