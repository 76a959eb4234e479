"""The estimator of balls: units, equivariance, what has no normal, and the way from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from jetnormal.estimators.ballwise import BallEstimator
from jetnormal.estimators.factory import make_estimator
from jetnormal.networks.checkpoint import save_model
from jetnormal.networks.nestinet import NestiNet, NestiNetConfig
from jetnormal.networks.pcpnet import PCPNet, PCPNetConfig

SMALL = {"radii": (0.1, 0.3), "points": 24, "width": 0.0625, "principal_axes": True}


@pytest.fixture(scope="module", params=["pcpnet", "nestinet"])
def network(request: pytest.FixtureRequest) -> PCPNet | NestiNet:
    torch.manual_seed(0)
    return PCPNet(PCPNetConfig(**SMALL)) if request.param == "pcpnet" else NestiNet(NestiNetConfig(**SMALL))


def cloud(count: int = 60) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3)) * [1, 1, 0.1]


def test_a_model_file_estimates(network: PCPNet | NestiNet, tmp_path: Path):
    path = tmp_path / "own.safetensors"
    save_model(path, network, {})
    estimator = make_estimator(str(path), threads=1)
    assert isinstance(estimator, BallEstimator)
    assert estimator.network.config == network.config
    prediction = estimator(cloud())
    np.testing.assert_allclose(np.linalg.norm(prediction.normals, axis=1), 1, atol=1e-5)
    assert ((prediction.confidence >= 0) & (prediction.confidence <= 1)).all()
    assert prediction.curvatures is None
    assert estimator.cost(cloud()) > 0


def test_queries_get_what_they_get_among_all(network: PCPNet | NestiNet):
    estimator = BallEstimator("tiny", network.eval(), batch_size=7, threads=2)
    queries = np.array([5, 59, 5, 30])
    done: list[int] = []
    some = estimator(cloud(), queries, done.append)
    np.testing.assert_allclose(some.normals, estimator(cloud()).normals[queries], atol=1e-4)
    assert sum(done) == 4


def test_lonely_points_have_no_normal(network: PCPNet | NestiNet):
    far = np.vstack([cloud(), [[50.0, 0, 0]]])
    prediction = BallEstimator("tiny", network.eval())(far, np.array([60]))
    assert np.isnan(prediction.normals).all()
    assert prediction.confidence[0] == 0
