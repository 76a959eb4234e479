"""The whole-cloud estimator: blocks without seams, small, degenerate and far-away clouds."""

from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import sphere

from jetnormal.estimators import blocks
from jetnormal.estimators.factory import make_estimator
from jetnormal.estimators.whole_cloud import CloudEstimator, cloud_estimator, on_device
from jetnormal.networks.checkpoint import save_model
from jetnormal.networks.cloudfit.config import CloudFitConfig
from jetnormal.networks.cloudfit.inference import Inference
from jetnormal.networks.cloudfit.network import CloudFit


@pytest.fixture(scope="module")
def estimator() -> CloudEstimator:
    torch.manual_seed(0)
    config = CloudFitConfig(channels=(8, 8, 8), hidden=4, up_layers=(1, 1, 1), down_layers=(1, 1, 0))
    weights = {name: values.numpy() for name, values in CloudFit(config).state_dict().items()}
    return CloudEstimator("tiny", config, Inference(config, weights))


def wavy(count: int, seed: int = 0) -> np.ndarray:
    xy = np.random.default_rng(seed).random((count, 2)) * [3, 1]
    return np.column_stack([xy, 0.1 * np.sin(5 * xy[:, 0])])


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arcsin(np.linalg.norm(np.cross(a, b), axis=1).clip(0, 1)))


def test_normals_are_units_and_follow_the_surface(estimator: CloudEstimator):
    points = wavy(3000)
    prediction = estimator(points)
    true = np.column_stack([-0.5 * np.cos(5 * points[:, 0]), np.zeros(3000), np.ones(3000)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(prediction.normals, axis=1), 1, atol=1e-5)
    assert np.median(degrees(prediction.rough, true)) < 5  # untrained
    assert ((prediction.normals * prediction.rough).sum(axis=1) >= 0).all()
    assert ((prediction.confidence >= 0) & (prediction.confidence <= 1)).all()


def test_curvatures_of_a_sphere_are_those_of_its_radius(estimator: CloudEstimator):
    normals = sphere(8000)
    prediction = estimator(2 * normals)
    assert prediction.curvatures is not None
    outward = np.sign((prediction.normals * normals).sum(axis=1))
    np.testing.assert_allclose(np.median(prediction.curvatures * outward[:, None], axis=0), -0.5, atol=0.03)


def test_queries_get_what_they_get_among_all(estimator: CloudEstimator):
    points = wavy(2000)
    queries = np.array([5, 1999, 5, 700])
    every, some = estimator(points), estimator(points, queries)
    np.testing.assert_allclose(some.normals, every.normals[queries], atol=1e-5)
    np.testing.assert_allclose(some.confidence, every.confidence[queries], atol=1e-5)


def test_blocks_leave_no_seams(monkeypatch: pytest.MonkeyPatch):
    estimator = make_estimator("cloudfit")  # how far a network sees, it learns
    points = wavy(12_000)
    whole = estimator(points)
    monkeypatch.setattr(blocks, "TOGETHER", 3000)
    monkeypatch.setattr(blocks, "CORE", 3000)
    monkeypatch.setattr(blocks, "HALO_SHARE", 10.0)
    parts = estimator(points)
    assert degrees(whole.normals, parts.normals).max() < 0.01
    queries = np.array([11_000, 3, 6000])
    np.testing.assert_allclose(estimator(points, queries).normals, parts.normals[queries], atol=1e-4)


def test_the_order_of_the_points_does_not_matter(estimator: CloudEstimator):
    points = wavy(1500)
    order = np.random.default_rng(3).permutation(1500)
    assert degrees(estimator(points).normals[order], estimator(points[order]).normals).max() < 0.05


def test_far_from_the_origin_nothing_is_lost(estimator: CloudEstimator):
    points = np.round(wavy(1500) * 2**20) / 2**20  # so that moving them is exact
    moved = points + np.array([4_500_000.0, 5_600_000.0, 300.0])
    assert degrees(estimator(points).normals, estimator(moved).normals).max() < 0.05


@pytest.mark.parametrize("count", [3, 4, 10, 17, 50])
def test_small_clouds_get_unit_normals(estimator: CloudEstimator, count: int):
    normals = estimator(np.random.default_rng(count).random((count, 3))).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_a_plane_is_exact(estimator: CloudEstimator):
    points = np.random.default_rng(0).random((500, 3)) * [1, 1, 0]
    np.testing.assert_allclose(np.abs(estimator(points).normals[:, 2]), 1, atol=1e-4)


def test_collinear_points_have_no_normal(estimator: CloudEstimator):
    prediction = estimator(np.column_stack([np.linspace(0, 1, 200), np.zeros((200, 2))]))
    assert np.isnan(prediction.normals).all()
    assert (prediction.confidence == 0).all()


def test_a_scan_of_dense_lines_has_normals(estimator: CloudEstimator):
    x, y = np.meshgrid(np.linspace(0, 1, 400), np.linspace(0, 1, 12))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    assert np.abs(estimator(points).normals[:, 2]).min() > 0.99


def test_pytorch_gives_the_same_normals(estimator: CloudEstimator, tmp_path: Path):
    torch.manual_seed(0)
    network = CloudFit(estimator.config).for_inference()
    save_model(tmp_path / "model.safetensors", network, {})
    other = CloudEstimator("torch", estimator.config, on_device(network, "cpu"))
    points = wavy(3000)
    loaded = cloud_estimator("file", tmp_path / "model.safetensors")
    assert degrees(estimator(points).normals, other(points).normals).max() < 0.05
    np.testing.assert_array_equal(estimator(points).normals, loaded(points).normals)
