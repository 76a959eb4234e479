"""Votes against PyTorch's own operations and closed forms."""

import pytest
import torch
import torch.nn.functional as F

from jetnormal.networks.cloudfit import torch_ops
from jetnormal.networks.cloudfit.vote_ops import votes
from jetnormal.networks.eigenvectors import smallest_eigenvector


def voters() -> tuple[torch.Tensor, ...]:
    torch.manual_seed(0)
    x, xj = torch.randn(30, 3).double(), torch.randn(25, 3).double()
    nj = F.normalize(torch.randn(25, 3), dim=1)
    neighbors = torch.randint(0, 25, (30, 16), dtype=torch.int32)
    return torch.rand(30, 16, 3, requires_grad=True), x, torch.rand(30) + 0.5, xj, nj, neighbors


def test_votes_equal_those_of_pytorch_forward_and_backward():
    weights, x, unit, xj, nj, neighbors = voters()
    expected = torch_ops.votes(weights, x, unit, xj, nj, neighbors)
    result = votes(weights, x, unit, xj, nj, neighbors)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-4)
    back = torch.randn(30, 3, 3)
    back = back + back.transpose(1, 2)
    ours, theirs = (torch.autograd.grad((m * back).sum(), weights)[0] for m in (result, expected))
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


def test_votes_are_a_weighted_covariance_minus_the_normals_outer_products():
    weights, x, unit, xj, nj, neighbors = voters()
    a, b, c = weights[3].detach().unbind(1)
    d = ((xj - x[3])[neighbors[3].long()] / unit[3]).float()
    n = nj[neighbors[3].long()]
    r = n - 2 * (n * d).sum(1, keepdim=True) / d.square().sum(1, keepdim=True) * d
    centered = d - (a[:, None] * d).sum(0) / a.sum()
    expected = (a * centered.T) @ centered - (b * n.T) @ n - (c * r.T) @ r
    torch.testing.assert_close(votes(weights, x, unit, xj, nj, neighbors)[3], expected, rtol=1e-4, atol=1e-4)


def test_a_mirrored_normal_on_a_sphere_is_the_own_normal():
    sphere = F.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(1)).double(), dim=1)
    neighbors = torch.arange(1, 20, dtype=torch.int32)[None]
    only_mirrored = torch.zeros(1, 19, 3)
    only_mirrored[..., 2] = 1
    matrix = votes(only_mirrored, sphere[:1], torch.ones(1), sphere, sphere.float(), neighbors)
    aligned = (smallest_eigenvector(matrix) * sphere[:1].float()).sum().abs()
    assert aligned.item() == pytest.approx(1, abs=1e-6)
