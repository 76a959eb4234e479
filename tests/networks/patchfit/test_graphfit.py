from __future__ import annotations

import pytest
import torch
from norms import with_statistics
from torch import nn
from torch.nn.functional import leaky_relu

from jetnormal.networks.patchfit.graphfit import AdaptiveGate, Edges, GraphFit, GraphLayer
from jetnormal.networks.patchfit.layers import PointLayer
from jetnormal.networks.patchfit.network import parameter_count


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def naive_layer(layer: PointLayer, features: torch.Tensor) -> torch.Tensor:
    norm = layer.norm
    scaled = (layer.linear(features) - norm.running_mean) / (norm.running_var + norm.eps).sqrt()
    return leaky_relu(scaled * norm.weight + norm.bias, 0.2)


def naive_edges(edges: Edges, patch: torch.Tensor, neighbors: torch.Tensor) -> torch.Tensor:
    """(n, k, C) features of the edges of one (n, C) patch, after both layers."""
    center = patch[:, None].expand(-1, neighbors.shape[1], -1)
    both = torch.cat([patch[neighbors] - center, center], dim=2)
    return naive_layer(edges.last, naive_layer(edges.first, both))


def naive_graph(layer: GraphLayer, patch: torch.Tensor) -> torch.Tensor:
    order = (patch[:, None] - patch).norm(dim=2).argsort(1)
    far, near = layer.counts
    around = naive_edges(layer.far, patch, order[:, :far]).amax(1)
    edges = naive_edges(layer.near, patch, order[:, :near])
    both = torch.cat([around[:, None].expand_as(edges), edges], dim=2)
    return naive_layer(layer.join, both).amax(1)


def test_parameters_are_those_of_the_publication():
    assert parameter_count(GraphFit()) == 3_457_540
    assert parameter_count(GraphFit(feature_transform=False)) == 3_457_540 - 1_857_344
    assert parameter_count(GraphFit(offsets=False)) == 3_457_540 - 3 * (128 + 1)


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize("far, near", [(6, 3), (40, 20)])
def test_a_graph_layer_equals_a_loop_over_the_edges(far, near, folded):
    layer = with_statistics(GraphLayer(16, far, near))
    features = torch.randn(3, 25, 16)
    graph = torch.stack([naive_graph(layer, patch) for patch in features])
    expected = layer.gate(features, graph)
    if folded:
        for module in layer.modules():
            if isinstance(module, PointLayer):
                module.fold()
    torch.testing.assert_close(layer(features), expected, rtol=1e-4, atol=1e-4)


def test_folding_gives_a_layer_without_a_bias_one():
    layer = with_statistics(PointLayer(6, 10, nn.LeakyReLU(0.2), bias=False))
    features = torch.randn(2, 7, 6)
    expected = naive_layer(layer, features)
    assert layer.linear.bias is None
    layer.fold()
    assert not layer.linear.bias.requires_grad
    torch.testing.assert_close(layer(features), expected)


def test_the_gate_mixes_by_one_share_a_channel():
    gate = AdaptiveGate(16).eval().requires_grad_(False)
    first, second = torch.randn(2, 3, 9, 16)
    squeezed = (first + second).mean(1)
    share = torch.sigmoid(torch.relu(squeezed @ gate.share[0].weight.T) @ gate.share[2].weight.T)[:, None]
    torch.testing.assert_close(gate(first, second), share * first + (1 - share) * second)
    torch.testing.assert_close(gate(first, first), first)


@pytest.mark.parametrize("batch, count", [(1, 1), (1, 17), (3, 60)])
def test_shapes_for_any_number_of_points(batch, count):
    network = with_statistics(GraphFit(0.125))
    nn.init.normal_(network.offset.weight)
    weighting = network(torch.randn(batch, count, 3))
    assert weighting.weights.shape == (batch, count)
    assert weighting.offsets.shape == (batch, count, 3)
    assert not weighting.offsets[:, 0].any()
    assert weighting.features.shape == (batch, count, network.channels)
    assert weighting.feature_transform.shape == (batch, 8, 8)


def test_the_order_of_the_points_does_not_matter():
    network = with_statistics(GraphFit(0.125))
    points = torch.randn(2, 60, 3)
    order = torch.randperm(60)
    before, after = network(points).weights, network(points[:, order]).weights
    torch.testing.assert_close(after, before[:, order], rtol=0, atol=1e-4)
