"""Nesti-Net: published size, Fisher vectors against their definition, experts and their loss."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from jetnormal.networks.nestinet import NestiNet, NestiNetConfig, _local_mean, fisher_vectors
from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.training.losses import nestinet_loss

TINY = NestiNetConfig(points=24, width=0.0625)


def balls(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, 24, 3, generator=generator) - 0.5
    return points * torch.tensor([1, 1, 0.1]), torch.randint(5, 25, (count, 3), generator=generator)


def test_the_published_size():
    with torch.device("meta"):
        network = NestiNet(NestiNetConfig())
    assert parameter_count(network) == 178_382_710
    assert parameter_count(network) / 2**20 == pytest.approx(170.1, abs=0.05)  # as Du et al. print it


def test_fisher_vectors_are_those_of_their_definition():
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (10, 3))
    grid = 3
    ticks = np.array([-2 / 3, 0, 2 / 3])
    means = np.array([[x, y, z] for x in ticks for y in ticks for z in ticks])
    sigma, weight = 1 / 3, 1 / 27
    density = np.exp(-0.5 * ((points[:, None] - means) ** 2).sum(2) / sigma**2)
    share = density / density.sum(1, keepdims=True)
    scaled = (points[:, None] - means) / sigma
    slopes = {
        "weight": ((share - weight) / math.sqrt(weight))[..., None],
        "mean": share[..., None] * scaled / math.sqrt(weight),
        "deviation": share[..., None] * (scaled**2 - 1) / math.sqrt(2 * weight),
    }
    rest = np.concatenate([slopes["mean"], slopes["deviation"]], 2)
    every = np.concatenate([slopes["weight"], rest], 2)
    statistics = np.concatenate([every.max(0), rest.min(0), every.sum(0)], 1) / 10
    roots = np.sign(statistics) * np.sqrt(np.abs(statistics))
    expected = (roots / np.linalg.norm(roots, axis=0)).T.reshape(20, 3, 3, 3)
    padded = torch.from_numpy(np.concatenate([points, np.full((4, 3), 0.9)])).float()[None]
    found = fisher_vectors(padded, torch.tensor([10]), grid)
    assert found.shape == (1, 20, 3, 3, 3)
    np.testing.assert_allclose(found[0].numpy(), expected, atol=1e-5)


def test_a_local_mean_counts_only_cells_of_the_grid():
    torch.testing.assert_close(_local_mean(torch.ones(1, 2, 4, 4, 4), 3), torch.ones(1, 2, 4, 4, 4))
    line = torch.zeros(1, 1, 4, 4, 4)
    line[..., :, :, 3] = 6
    expected = torch.tensor([0.0, 0, 2, 3]).expand(4, 4, 4)
    torch.testing.assert_close(_local_mean(line, 3)[0, 0], expected)
    torch.testing.assert_close(_local_mean(line, 2)[0, 0], torch.tensor([0.0, 0, 3, 6]).expand(4, 4, 4))


def test_the_likeliest_expert_is_asked():
    torch.manual_seed(0)
    network = NestiNet(TINY).for_inference()
    points, counts = balls(6)
    normals, probabilities = network(points, counts)
    assert normals.shape == (6, 7, 3)
    torch.testing.assert_close(probabilities.sum(1), torch.ones(6))
    found, confidence = network.estimate(points, counts)
    best, chosen = probabilities.max(1)
    torch.testing.assert_close(confidence, best)
    torch.testing.assert_close(found, F.normalize(normals[torch.arange(6), chosen], dim=1), atol=1e-5, rtol=0)


def test_the_loss_is_twice_the_likely_experts_sine():
    true = torch.tensor([[0.0, 0, 1]])
    normals = torch.tensor([[[0.0, 0, -3], [2, 0, 0]]])
    assert nestinet_loss((normals, torch.tensor([[1.0, 0]])), true).item() == pytest.approx(0, abs=1e-6)
    assert nestinet_loss((normals, torch.tensor([[0.25, 0.75]])), true).item() == pytest.approx(1.5, abs=1e-6)


def test_it_learns_and_every_parameter_takes_part():
    torch.manual_seed(0)
    network = NestiNet(TINY).train()
    points, counts = balls(8)
    true = torch.tensor([0.0, 0, 1]).expand(8, 3)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(12):
        loss = nestinet_loss(network(points, counts), true)
        optimizer.zero_grad()
        loss.backward()
        assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in network.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]
