"""What estimators say of the operations they need."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.estimators.patchwise import network_estimator
from jetnormal.estimators.whole_cloud import CloudEstimator
from jetnormal.networks.cloudfit.config import CloudFitConfig
from jetnormal.networks.cloudfit.inference import Inference
from jetnormal.networks.cloudfit.network import CloudFit
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


def test_a_network_of_the_whole_cloud_counts_its_points():
    config = CloudFitConfig((8, 8), 4, (0, 0), (0, 0))
    network = CloudFit(config)
    weights = {name: values.numpy() for name, values in network.state_dict().items()}
    cost = CloudEstimator("tiny", config, Inference(config, weights)).cost(POINTS)
    parameters = sum(p.numel() for p in network.parameters() if p.ndim == 2)
    assert 0.2 * parameters < 1e9 * cost / 2 < parameters  # most, and no more than once a point
