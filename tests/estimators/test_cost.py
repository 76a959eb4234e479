"""What estimators say of the operations they need."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.estimators.patchwise import network_estimator
from jetnormal.estimators.whole_cloud import CloudEstimator
from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig
from jetnormal.networks.patchfit.layers import PointLayer
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig
from jetnormal.support.flops import matrix_products

TINY = PatchFitConfig("graphfit", neighbors=32, width=0.125, light=True, offsets=True)
POINTS = np.random.default_rng(0).normal(size=(500, 3))


def test_a_product_of_matrices_is_two_operations_a_multiplication():
    assert matrix_products(lambda: torch.ones(3, 7) @ torch.ones(7, 5)) == pytest.approx(2e-9 * 3 * 7 * 5)


def test_a_patch_network_counts_one_patch():
    network = PatchFit(TINY).for_inference()
    layer, forward = PointLayer(3, 5), network.forward
    before = network_estimator("tiny", network).cost(POINTS)
    network.forward = lambda points, iterations: (layer(points), forward(points, iterations=iterations))[1]
    assert network_estimator("tiny", network).cost(POINTS) - before == pytest.approx(2e-9 * 32 * 3 * 5)


def test_a_network_of_the_whole_cloud_counts_its_points(monkeypatch):
    network = CloudFit(CloudFitConfig((8, 8, 8), 4, 2, (0, 0, 0), (0, 0, 0))).for_inference()
    monkeypatch.setattr(network, "encode", lambda pyramid: torch.ones(7, 11) @ torch.ones(11, 13))
    monkeypatch.setattr(network, "fit", lambda encoding, queries: torch.ones(len(queries), 3) @ torch.ones(3, 5))
    per_cloud = 2e-9 * 7 * 11 * 13 / len(POINTS)
    assert CloudEstimator("tiny", network).cost(POINTS) == pytest.approx(2e-9 * 3 * 5 + per_cloud)
