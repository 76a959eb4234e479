from __future__ import annotations

import pytest
import torch
from torch import nn

from jetnormal.networks.patchfit.adafit import AdaFit, ScaleAggregation
from jetnormal.networks.patchfit.network import parameter_count


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def moving(network: AdaFit) -> AdaFit:
    """A network whose offsets, zero at first, are not; evaluation mode."""
    nn.init.normal_(network.offset.weight)
    return network.eval().requires_grad_(False)


def test_parameters_are_those_of_the_publication():
    assert parameter_count(AdaFit()) == 3_372_228
    assert parameter_count(AdaFit(feature_transform=False)) == 3_372_228 - 1_857_344
    assert parameter_count(AdaFit(offsets=False)) == 3_372_228 - 3 * (128 + 1)


@pytest.mark.parametrize("count, fitted", [(1, 1), (3, 1), (17, 4), (64, 16), (700, 175)])
def test_the_nearest_quarter_of_any_number_of_points_is_weighed_and_moved(count, fitted):
    network = moving(AdaFit(0.125))
    weighting = network(torch.randn(2, count, 3))
    assert weighting.weights.shape == (2, fitted)
    assert weighting.features.shape == (2, fitted, network.channels)
    assert weighting.offsets.shape == (2, fitted, 3)
    assert not weighting.offsets[:, 0].any()
    assert weighting.feature_transform.shape == (2, 8, 8)


def test_every_scale_matters_and_its_order_does_not():
    network = moving(AdaFit(0.125))
    points = torch.randn(1, 64, 3)
    before = network(points)
    for scale in (slice(1, 16), slice(16, 32), slice(32, 64)):
        turned, changed = points.clone(), points.clone()
        turned[:, scale] = points[:, scale].flip(1)
        changed[:, scale] *= 3
        after = network(turned)
        expected = torch.cat([before.weights[:, :1], before.weights[:, 1:].flip(1)], 1)
        expected = expected if scale.stop == 16 else before.weights
        torch.testing.assert_close(after.weights, expected, rtol=0, atol=1e-5)
        assert (network(changed).weights - before.weights)[:, 0].abs().max() > 0


def test_aggregation_joins_the_summaries_of_both_scales_to_the_nearest_points():
    layer = ScaleAggregation(8, 12, outer=5).eval().requires_grad_(False)
    features, outer = torch.randn(3, 10, 8), torch.randn(3, 5)
    joined, summary = layer(features, 4, outer)
    wide = layer.widen(features)
    assert wide.shape == (3, 10, 16)
    expected = layer.narrow(wide.amax(1))
    torch.testing.assert_close(summary, expected)
    every = torch.cat([expected, outer], 1)[:, None].expand(3, 4, 9)
    torch.testing.assert_close(joined, layer.join(torch.cat([every, features[:, :4]], 2)))
