from __future__ import annotations

import pytest
import torch

from jetnormal.networks.patchfit.correction import NormalError
from jetnormal.networks.patchfit.deepfit import DeepFit
from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.networks.patchfit.weighting import WEIGHT_FLOOR


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def test_parameters_are_those_of_the_publication():
    assert parameter_count(DeepFit()) == 2_728_449
    assert parameter_count(DeepFit(feature_transform=False)) == 2_728_449 - 1_857_344
    assert parameter_count(DeepFit(offsets=True)) == 2_728_449 + 3 * (128 + 1)


@pytest.mark.parametrize("feature_transform", [True, False])
@pytest.mark.parametrize("batch, count", [(1, 1), (1, 17), (5, 64)])
def test_shapes_for_any_number_of_points(batch, count, feature_transform):
    network = DeepFit(0.125, feature_transform).eval()
    weighting = network(torch.randn(batch, count, 3))
    assert weighting.weights.shape == (batch, count)
    assert weighting.features.shape == (batch, count, network.channels)
    if feature_transform:
        assert weighting.feature_transform.shape == (batch, 8, 8)
    else:
        assert weighting.feature_transform is None


def test_weights_stay_above_the_floor():
    network = DeepFit(0.125).eval().requires_grad_(False)
    points = torch.randn(2, 30, 3)
    for bias in (-100.0, 0.0, 100.0):
        network.weight.bias.fill_(bias)
        weights = network(points).weights
        assert weights.min() >= WEIGHT_FLOOR and weights.max() <= 1 + WEIGHT_FLOOR


def test_offsets_start_at_zero_and_never_move_the_query():
    network = DeepFit(0.125, offsets=True).eval().requires_grad_(False)
    points = torch.randn(2, 30, 3)
    assert torch.equal(network(points).offsets, torch.zeros(2, 30, 3))
    torch.nn.init.normal_(network.offset.weight)
    offsets = network(points).offsets
    assert offsets.shape == (2, 30, 3)
    assert not offsets[:, 0].any() and offsets[:, 1:].all()
    assert DeepFit(0.125)(points).offsets is None


def test_a_weight_depends_on_the_point_and_on_the_whole_patch():
    network = DeepFit(0.125).eval().requires_grad_(False)
    points = torch.randn(1, 30, 3)
    before = network(points).weights
    assert before.std() > 0
    points[0, -1] *= 5
    assert (network(points).weights - before)[0, :-1].abs().max() > 0


def test_a_correction_is_a_unit_vector_near_the_rough_normal():
    correction = NormalError(16).eval()
    features, rough = torch.randn(4, 20, 16), torch.nn.functional.normalize(torch.randn(4, 3), dim=1)
    refined = correction(features, rough)
    torch.testing.assert_close(refined.norm(dim=1), torch.ones(4))
    several = correction.neighbors(features, rough[:, None].expand(4, 20, 3))
    torch.testing.assert_close(several.norm(dim=2), torch.ones(4, 20))  # over the axis of coordinates, not of points
    assert (refined - rough).abs().max() > 0


def test_a_correction_without_residual_keeps_the_normal():
    correction = NormalError(16).eval().requires_grad_(False)
    for linear in (correction.query, correction.neighbor[-1]):
        linear.weight.zero_()
        linear.bias.zero_()
    features, rough = torch.randn(4, 20, 16), torch.nn.functional.normalize(torch.randn(4, 3), dim=1)
    torch.testing.assert_close(correction(features, rough), rough)
    many = rough[:, None].expand(4, 20, 3)
    torch.testing.assert_close(correction.neighbors(features, many), many)


def test_a_correction_adds_the_hyperbolic_tangent_of_its_residual():
    correction = NormalError(16).eval().requires_grad_(False)
    correction.query.weight.zero_()
    correction.query.bias.copy_(torch.tensor([0.5, -1.0, 10.0]))
    rough = torch.tensor([[0.0, 0, 1]])
    expected = torch.tensor([[0.5, -1.0, 10.0]]).tanh() + rough
    torch.testing.assert_close(correction(torch.randn(1, 20, 16), rough), expected / expected.norm())
