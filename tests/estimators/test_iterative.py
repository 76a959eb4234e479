"""The iterative estimator: queries, blocks, degenerate clouds."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.estimators import blocks
from jetnormal.estimators.iterative import IterEstimator
from jetnormal.networks.iternet import IterNet, IterNetConfig


@pytest.fixture(scope="module")
def estimator() -> IterEstimator:
    torch.manual_seed(0)
    return IterEstimator("tiny", IterNet(IterNetConfig(neighbors=12, iterations=3)).for_inference())


def wavy(count: int) -> np.ndarray:
    xy = np.random.default_rng(0).random((count, 2)) * [3, 1]
    return np.column_stack([xy, 0.1 * np.sin(5 * xy[:, 0])])


def test_normals_are_units_that_follow_the_surface(estimator: IterEstimator):
    points = wavy(3000)
    prediction = estimator(points)
    true = np.column_stack([-0.5 * np.cos(5 * points[:, 0]), np.zeros(3000), np.ones(3000)])
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(prediction.normals, axis=1), 1, atol=1e-5)
    assert np.median(np.abs((prediction.normals * true).sum(axis=1))) > 0.99
    assert ((prediction.normals * prediction.rough).sum(axis=1) >= 0).all()
    assert ((prediction.confidence > 0) & (prediction.confidence <= 1)).all()
    assert prediction.curvatures is None and not estimator.has_curvature


def test_queries_get_what_they_get_among_all(estimator: IterEstimator):
    points = wavy(2000)
    queries = np.array([5, 1999, 5, 700])
    done: list[int] = []
    every, some = estimator(points), estimator(points, queries, done.append)
    np.testing.assert_allclose(some.normals, every.normals[queries], atol=1e-6)
    np.testing.assert_allclose(some.confidence, every.confidence[queries], atol=1e-5)
    assert sum(done) == 4


def test_threads_and_batches_do_not_matter(estimator: IterEstimator):
    points = wavy(1000)
    other = IterEstimator("tiny", estimator.network, batch_size=100, threads=3)
    np.testing.assert_allclose(other(points).normals, estimator(points).normals, atol=1e-6)


def test_blocks_leave_no_seams(estimator: IterEstimator, monkeypatch: pytest.MonkeyPatch):
    points = wavy(6000)
    whole = estimator(points)
    monkeypatch.setattr(blocks, "TOGETHER", 2000)
    monkeypatch.setattr(blocks, "CORE", 2000)
    parts = estimator(points)
    assert np.abs((whole.normals * parts.normals).sum(axis=1)).min() > 1 - 1e-6


def test_more_iterations_and_other_neighbors_can_be_asked_for(estimator: IterEstimator):
    other = IterEstimator("tiny", estimator.network, k=20, iterations=1)
    assert other.neighbors == 21
    assert np.abs(other(wavy(500)).normals - estimator(wavy(500)).normals).max() > 1e-4
    assert other.cost(wavy(500)) < estimator.cost(wavy(500))


def test_collinear_points_have_no_normal(estimator: IterEstimator):
    prediction = estimator(np.column_stack([np.linspace(0, 1, 200), np.zeros((200, 2))]))
    assert np.isnan(prediction.normals).all()
    assert (prediction.confidence == 0).all()


@pytest.mark.parametrize("count", [3, 10])
def test_small_clouds_get_unit_normals(estimator: IterEstimator, count: int):
    normals = estimator(np.random.default_rng(count).random((count, 3))).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
