from __future__ import annotations

import pytest
import torch
from norms import with_statistics
from torch import nn

from jetnormal.networks.patchfit.layers import (
    AdaptivePooling,
    EdgeConv,
    PointLayer,
    full_precision,
    gather,
    maximum,
    nearest,
    point_layers,
)
from jetnormal.networks.patchfit.selection import every_nth, farthest_points


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("shape", [(5,), (2, 7), (2, 3, 4)])
def test_a_point_layer_is_linear_normalized_activated(shape):
    layer = with_statistics(PointLayer(6, 10, nn.LeakyReLU(0.2)))
    features = torch.randn(*shape, 6)
    norm = layer.norm
    products = features @ layer.linear.weight.T + layer.linear.bias
    expected = (products - norm.running_mean) / (norm.running_var + norm.eps).sqrt() * norm.weight + norm.bias
    torch.testing.assert_close(layer(features), torch.where(expected > 0, expected, 0.2 * expected))


def test_training_normalizes_over_all_points_of_all_patches():
    rows = PointLayer(6, 10)(torch.randn(4, 7, 6)).flatten(0, 1)
    torch.testing.assert_close(rows.mean(0), torch.zeros(10), rtol=0, atol=1e-6)
    torch.testing.assert_close(rows.var(0, unbiased=False), torch.ones(10), rtol=1e-3, atol=0)


def test_a_split_layer_equals_the_layer_on_the_concatenation():
    shared, features = torch.randn(3, 5), torch.randn(3, 7, 4)
    together = torch.cat([shared[:, None].expand(3, 7, 5), features], dim=2)
    layer = PointLayer(9, 6, nn.ReLU())
    torch.testing.assert_close(layer.split(shared, features), layer(together))  # statistics of the batch
    with_statistics(layer)
    torch.testing.assert_close(layer.split(shared, features), layer(together))
    layer.fold()
    torch.testing.assert_close(layer.split(shared, features), layer(together))


@pytest.mark.parametrize("folded", [False, True])
def test_a_peak_is_the_maximum_over_the_points(folded):
    layer = with_statistics(PointLayer(9, 6, nn.LeakyReLU(0.2)))
    shared, features = torch.randn(3, 2, 5), torch.randn(3, 2, 7, 4)
    together = torch.cat([shared[:, :, None].expand(3, 2, 7, 5), features], dim=3)
    expected = layer(together).amax(2)
    if folded:
        layer.fold()
    torch.testing.assert_close(layer.peak(together), expected)
    torch.testing.assert_close(layer.split_peak(shared, features), expected)


def test_folding_keeps_the_function_and_may_be_repeated():
    layer = with_statistics(PointLayer(6, 10, nn.ReLU()))
    features = torch.randn(2, 7, 6)
    before = layer(features)
    layer.fold()
    assert isinstance(layer.norm, nn.Identity)
    torch.testing.assert_close(layer(features), before)
    after = layer(features)
    layer.fold()
    assert torch.equal(layer(features), after)


def test_a_chain_of_point_layers_has_the_given_widths():
    layers = point_layers([3, 8, 16])
    assert [(layer.linear.in_features, layer.linear.out_features) for layer in layers] == [(3, 8), (8, 16)]
    assert layers(torch.randn(2, 5, 3)).min() == 0


@pytest.mark.parametrize("shape", [(4,), (4, 2), (1, 1)])
def test_gather_takes_rows(shape):
    features = torch.randn(3, 6, 5)
    indices = torch.randint(0, 6, (3, *shape))
    taken = gather(features, indices)
    assert taken.shape == (3, *shape, 5)
    for b in range(3):
        assert torch.equal(taken[b], features[b][indices[b]])


@pytest.mark.parametrize("k", [1, 8, 30, 50])
@pytest.mark.parametrize("channels", [3, 64])
def test_nearest_equals_brute_force(k, channels):
    points, queries = torch.randn(3, 30, channels), torch.randn(3, 11, channels)
    found = nearest(points, queries, k)
    assert found.shape == (3, 11, min(k, 30))
    distances = (queries[:, :, None] - points[:, None]).norm(dim=3)
    expected = distances.argsort(dim=2)[:, :, :k]
    assert torch.equal(found, expected)


def test_a_point_is_its_own_neighbor():
    points = torch.randn(2, 40, 16)
    found = nearest(points, points, 1)[:, :, 0]
    assert torch.equal(found, torch.arange(40).expand(2, 40))


def naive_edge_conv(layer: EdgeConv, features: torch.Tensor) -> torch.Tensor:
    rows = []
    for patch in features:
        for center in patch:
            order = (patch - center).norm(dim=1).argsort()[: layer.k]
            edges = torch.stack([torch.cat([center - patch[j], center]) for j in order])
            rows.append(layer.last(layer.second(layer.first(edges))).max(0).values)
    return torch.stack(rows).view(*features.shape[:2], -1)


@pytest.mark.parametrize("count", [30, 5])  # fewer points than neighbors, too
def test_edge_convolution_equals_a_loop_over_the_edges(count):
    layer = with_statistics(EdgeConv(6, 32))
    features = torch.randn(2, count, 6)
    expected = naive_edge_conv(layer, features)
    torch.testing.assert_close(layer(features), expected, rtol=1e-4, atol=1e-5)
    layer.first.fold()
    layer.second.fold()
    torch.testing.assert_close(layer(features), expected, rtol=1e-4, atol=1e-5)


def naive_pooling(layer: AdaptivePooling, points, features, kept):
    pooled = []
    for p, f, chosen in zip(points, features, kept, strict=True):
        for i in chosen:
            order = (p - p[i]).norm(dim=1).argsort()[: layer.k]
            position = layer.position(p[i] - p[order])
            attention = layer.attention(f[i] - f[order] + position)
            share = attention.exp() / attention.exp().sum(0)
            pooled.append((share * (f[order] + position)).sum(0))
    return torch.stack(pooled).view(len(points), -1, features.shape[2])


@pytest.mark.parametrize("farthest", [True, False])
def test_adaptive_pooling_equals_a_loop_over_the_points(farthest):
    layer = with_statistics(AdaptivePooling(16, points=9, farthest=farthest))
    points, features = torch.randn(2, 30, 3), torch.randn(2, 30, 16)
    centers, pooled = layer(points, features)
    kept = farthest_points(points, 9) if farthest else every_nth(points, 9)
    assert torch.equal(centers, gather(points, kept))
    assert torch.equal(centers[:, 0], points[:, 0])
    torch.testing.assert_close(pooled, naive_pooling(layer, points, features, kept), rtol=1e-4, atol=1e-5)


def test_pooling_to_more_points_than_there_are_keeps_all():
    points, features = torch.randn(2, 6, 3), torch.randn(2, 6, 16)
    centers, pooled = with_statistics(AdaptivePooling(16, points=20))(points, features)
    assert pooled.shape == (2, 6, 16)
    assert sorted(centers[0].tolist()) == sorted(points[0].tolist())


@pytest.mark.parametrize("axis", [1, 2])
def test_the_maximum_is_the_same_with_gradients_and_without(axis):
    features = torch.randint(0, 5, (3, 20, 6)).float()  # with ties
    expected = features.max(axis).values
    assert torch.equal(maximum(features, axis), expected)
    features.requires_grad_()
    values = maximum(features, axis)
    assert torch.equal(values, expected)
    values.sum().backward()
    assert torch.equal(features.grad.sum(axis), torch.ones_like(expected))
    assert set(features.grad.unique().tolist()) == {0, 1}  # one of the largest takes all


def test_neighbors_are_found_in_full_precision_under_autocast():
    points = 1 + 1e-3 * torch.randn(1, 50, 3)  # one value for all in bfloat16
    expected = nearest(points, points, 4)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(nearest(points, points, 4), expected)
        with full_precision(points):
            assert (points @ points.transpose(1, 2)).dtype == torch.float32
