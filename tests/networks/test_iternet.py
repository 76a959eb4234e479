"""IterNet: size, what changes nothing, planes, and that it learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.geometry.graph import build_graph, cloud_spacing
from jetnormal.networks.iternet import IterNet, IterNetConfig, plane_normals
from jetnormal.networks.patchfit.network import parameter_count


@pytest.fixture
def network() -> IterNet:
    torch.manual_seed(0)
    return IterNet(IterNetConfig(neighbors=16))


def corner(count: int = 400) -> tuple[np.ndarray, torch.Tensor]:
    """Points on both sides of a right angle with a little noise, and their normals."""
    rng = np.random.default_rng(0)
    flat = rng.random((count, 2)) * [1, 2] - [0, 1]
    points = np.where(flat[:, 1:] > 0, flat @ [[1, 0, 0], [0, 1, 0]], flat @ [[1, 0, 0], [0, 0, 1]])
    normals = np.where(flat[:, 1:] > 0, [0, 0, 1], [0, 1, 0])
    return points + 0.01 * rng.normal(size=points.shape), torch.from_numpy(normals).float()


def estimate(network: IterNet, points: np.ndarray, iterations: int = 3) -> torch.Tensor:
    graph = build_graph(points, network.config.neighbors + 1, cloud_spacing(points))
    everywhere = slice(0, len(points))
    normals, weights = network.first(graph, everywhere)
    for _ in range(iterations):
        normals, weights = network.refit(graph, normals, weights, everywhere)
    return normals


def test_the_published_size():
    assert parameter_count(IterNet(IterNetConfig())) == 7_981


def test_weights_are_shares_and_normals_units(network: IterNet):
    points, _ = corner()
    graph = build_graph(points, 17, cloud_spacing(points))
    normals, weights = network.first(graph, slice(0, 400))
    torch.testing.assert_close(weights, torch.full((400, 17), 1 / 17))
    normals, weights = network.refit(graph, normals, weights[10:50], slice(10, 50))
    assert weights.shape == (40, 17)
    assert weights.min() > 0
    torch.testing.assert_close(weights.sum(1), torch.ones(40))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(40))


def test_moving_scaling_and_permuting_the_cloud_change_nothing(network: IterNet):
    points, _ = corner()
    order = np.random.default_rng(1).permutation(len(points))
    moved = (1e-3 * points + [5000.0, -3000.0, 10.0])[order]
    torch.testing.assert_close(estimate(network, moved), estimate(network, points)[order], atol=1e-4, rtol=0)


def test_the_signs_of_the_neighbors_normals_do_not_matter(network: IterNet):
    torch.manual_seed(1)
    offsets, weights = torch.randn(20, 17, 3), torch.rand(20, 17)
    normals = torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    others = torch.nn.functional.normalize(torch.randn(20, 17, 3), dim=2)
    flips = torch.where(torch.rand(20, 17, 1) < 0.5, -1.0, 1.0)
    found, expected = network(offsets, weights, normals, flips * others), network(offsets, weights, normals, others)
    torch.testing.assert_close(found, expected)


def test_a_weighted_plane_ignores_what_has_no_weight():
    rng = np.random.default_rng(0)
    offsets = torch.from_numpy(rng.normal(size=(5, 30, 3)) * [1, 1, 0] + [0, 0, 0.3]).float()
    offsets[:, 20:] += torch.tensor([0.0, 0.0, 5.0])
    weights = torch.ones(5, 30)
    weights[:, 20:] = 0
    torch.testing.assert_close(plane_normals(offsets, weights), torch.tensor([[0.0, 0, 1]]).expand(5, 3))


def test_a_cloud_smaller_than_a_neighborhood(network: IterNet):
    normals = estimate(network, np.random.default_rng(0).random((6, 3)))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(6))


def test_every_parameter_gets_a_gradient_and_a_few_steps_learn_an_edge(network: IterNet):
    points, true = corner()
    graph = build_graph(points, 17, cloud_spacing(points))
    first, weights = network.first(graph, slice(0, 400))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(40):
        normals, _ = network.refit(graph, first, weights, slice(0, 400))
        loss = (1 - (normals * true).sum(1).abs()).mean()
        optimizer.zero_grad()
        loss.backward()
        for name, parameter in network.named_parameters():
            assert parameter.grad is not None
            idle = name == "weight.last.bias"  # published, and of no effect: a softmax follows
            assert (parameter.grad.abs().max() > 1e-8) != idle, name
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("change", [{"neighbors": 1}, {"iterations": 0}])
def test_impossible_configurations_are_refused(change: dict[str, int]):
    with pytest.raises(ValueError, match="not"):
        IterNetConfig(**change)
