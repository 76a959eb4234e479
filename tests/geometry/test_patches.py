from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.geometry.patches import Patches, build_patches, sign

K = 40


def cloud(count: int = 600, seed: int = 0) -> np.ndarray:
    """A bent sheet without symmetry."""
    xy = np.random.default_rng(seed).uniform(-1, 1, (count, 2)) ** 3
    return np.column_stack([xy, 0.3 * np.sin(2 * xy[:, 0]) + 0.2 * xy[:, 1] ** 2])


def patches_of(points: np.ndarray, queries: np.ndarray, k: int = K, **options) -> tuple[Patches, np.ndarray]:
    neighbors, _ = NeighborIndex(points).query(points[queries], k)
    return build_patches(points, queries, neighbors, **options), neighbors


QUERIES = np.array([0, 17, 3, 599, 42])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_patch_is_centered_scaled_and_turned(dtype):
    points = cloud()
    patches, neighbors = patches_of(points, QUERIES, dtype=dtype)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    assert patches.points.dtype == patches.frame.dtype == patches.radius.dtype == dtype
    assert patches.points.shape == (5, K, 3) and patches.frame.shape == (5, 3, 3) and patches.radius.shape == (5,)

    assert torch.equal(patches.points[:, 0], torch.zeros(5, 3, dtype=dtype))
    lengths = patches.points.norm(dim=2)
    torch.testing.assert_close(lengths[:, -1], torch.ones(5, dtype=dtype))
    assert (lengths.diff(dim=1) > -tolerance).all()  # the order of the neighbors is kept

    offsets = torch.from_numpy(points[neighbors] - points[QUERIES][:, None]).to(dtype)
    back = patches.points @ patches.frame.transpose(1, 2) * patches.radius[:, None, None]
    torch.testing.assert_close(back, offsets, rtol=0, atol=tolerance)


def test_a_frame_is_a_rotation_to_the_principal_axes():
    patches, _ = patches_of(cloud(), QUERIES, dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    torch.testing.assert_close(patches.frame.transpose(1, 2) @ patches.frame, identity, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.linalg.det(patches.frame), torch.ones(5, dtype=torch.float64))
    centered = patches.points - patches.points.mean(1, keepdim=True)
    covariance = centered.transpose(1, 2) @ centered / K
    torch.testing.assert_close(covariance, torch.diag_embed(patches.variance), rtol=0, atol=1e-12)
    assert (patches.variance.diff(dim=1) < 0).all()
    assert patches.spans_plane.all()


def test_most_of_a_patch_lies_at_positive_z_and_leans_to_positive_x():
    patches, _ = patches_of(cloud(), QUERIES, dtype=torch.float64)
    mean = patches.points.mean(1)
    assert (mean[:, 2] > 0).all()
    assert ((patches.points - mean[:, None])[..., 0].pow(3).sum(1) > 0).all()


@pytest.mark.parametrize("shift", [0.0, 5e6])
@pytest.mark.parametrize("scale", [1.0, 0.01, 300.0])
def test_a_moved_cloud_has_the_same_patches_and_moved_frames(scale, shift):
    points = cloud()
    rotation = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    before, neighbors = patches_of(points, QUERIES)
    moved = scale * points @ rotation.T + shift
    after = build_patches(moved, QUERIES, neighbors)
    # at 5e6 the coordinates themselves are rounded to 1e-9, which is 1e-6 of the smallest radius here
    torch.testing.assert_close(after.points, before.points, rtol=0, atol=2e-5 if shift and scale < 1 else 2e-6)
    expected = torch.from_numpy(rotation).float() @ before.frame
    torch.testing.assert_close(after.frame, expected, rtol=0, atol=1e-4 if shift and scale < 1 else 1e-5)
    torch.testing.assert_close(after.radius, scale * before.radius, rtol=1e-5, atol=0)


def test_vectors_go_to_the_patch_and_back():
    patches, _ = patches_of(cloud(), QUERIES, dtype=torch.float64)
    vectors = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inside = patches.to_patch(vectors)
    torch.testing.assert_close(patches.to_cloud(inside), vectors)
    torch.testing.assert_close(inside, (vectors[:, None] @ patches.frame)[:, 0])
    several = torch.stack([vectors, 2 * vectors], dim=1)
    torch.testing.assert_close(patches.to_patch(several), torch.stack([inside, 2 * inside], dim=1))
    z = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(5, 3)
    torch.testing.assert_close(patches.to_cloud(z), patches.frame[:, :, 2])


def test_coincident_points_make_a_finite_patch():
    patches, _ = patches_of(np.full((50, 3), 3.7), np.array([0, 9]))
    assert torch.equal(patches.points, torch.zeros(2, K, 3))
    assert patches.radius.tolist() == [0, 0]
    torch.testing.assert_close(patches.frame.transpose(1, 2) @ patches.frame, torch.eye(3).expand(2, 3, 3))
    assert not patches.spans_plane.any()


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_collinear_points_span_no_plane(offset):
    direction = np.array([1.0, 2, -0.5])
    points = np.sort(np.random.default_rng(0).uniform(0, 1, 100))[:, None] * direction + offset
    patches, _ = patches_of(points, np.array([50, 3]))
    assert torch.isfinite(patches.points).all()
    assert not patches.spans_plane.any()
    along = torch.from_numpy(direction / np.linalg.norm(direction)).float()
    torch.testing.assert_close((patches.frame[:, :, 0] @ along).abs(), torch.ones(2))


def test_a_thin_strip_still_spans_a_plane():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 1, 100), 1e-4 * rng.uniform(0, 1, 100), np.zeros(100)])
    patches, _ = patches_of(points, np.array([0]))
    assert patches.spans_plane.all()
    torch.testing.assert_close(patches.frame[0, :, 2].abs(), torch.tensor([0.0, 0, 1]))


def test_one_point_is_a_patch():
    patches, _ = patches_of(cloud(), np.array([5]), k=1)
    assert torch.equal(patches.points, torch.zeros(1, 1, 3))
    assert not patches.spans_plane.any()


def test_zero_has_a_positive_sign():
    assert sign(torch.tensor([-2.0, -0.0, 0.0, 3.0])).tolist() == [-1, 1, 1, 1]
