"""Votes and compiled jets against PyTorch's own operations and closed forms."""

import pytest
import torch
import torch.nn.functional as F

from jetnormal.geometry.jet import fit_jet
from jetnormal.networks.cloudfit.vote_ops import votes, weighted_jets
from jetnormal.networks.eigenvectors import smallest_eigenvector


def voters() -> tuple[torch.Tensor, ...]:
    torch.manual_seed(0)
    x, xj = torch.randn(30, 3).double(), torch.randn(25, 3).double()
    nj = F.normalize(torch.randn(25, 3), dim=1)
    neighbors = torch.randint(0, 25, (30, 16), dtype=torch.int32)
    return torch.rand(30, 16, 3, requires_grad=True), x, torch.rand(30) + 0.5, xj, nj, neighbors


def test_votes_equal_their_formula_forward_and_backward():
    weights, x, unit, xj, nj, neighbors = voters()
    index = neighbors.long()
    d = ((xj[index] - x[:, None]) / unit[:, None, None].double()).float()
    n = nj[index]
    r = n - 2 * (n * d).sum(2, keepdim=True) / d.square().sum(2, keepdim=True) * d
    a, b, c = weights.unbind(2)
    centred = d - ((a[..., None] * d).sum(1) / a.sum(1, keepdim=True))[:, None]
    expected = torch.einsum("nk,nki,nkj->nij", a, centred, centred)
    expected = expected - torch.einsum("nk,nki,nkj->nij", b, n, n) - torch.einsum("nk,nki,nkj->nij", c, r, r)
    result = votes(weights, x, unit, xj, nj, neighbors)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-4)
    back = torch.randn(30, 3, 3)
    back = back + back.transpose(1, 2)
    ours, theirs = (torch.autograd.grad((m * back).sum(), weights)[0] for m in (result, expected))
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


def test_a_mirrored_normal_on_a_sphere_is_the_own_normal():
    sphere = F.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(1)).double(), dim=1)
    neighbors = torch.arange(1, 20, dtype=torch.int32)[None]
    only_mirrored = torch.zeros(1, 19, 3)
    only_mirrored[..., 2] = 1
    matrix = votes(only_mirrored, sphere[:1], torch.ones(1), sphere, sphere.float(), neighbors)
    aligned = (smallest_eigenvector(matrix) * sphere[:1].float()).sum().abs()
    assert aligned.item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_compiled_jets_equal_fit_jet(order: int):
    torch.manual_seed(order)
    points = torch.randn(40, 51, 3) * torch.tensor([1, 1, 0.2])
    weights = torch.rand(40, 51, requires_grad=True)
    ours, theirs = (fit(weights, points) for fit in (
        lambda w, p: weighted_jets(w, p, order).coefficients, lambda w, p: fit_jet(p, w, order).coefficients
    ))  # fmt: skip
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    back = torch.randn_like(ours)
    slopes = [torch.autograd.grad((beta * back).sum(), weights)[0] for beta in (ours, theirs)]
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-2, atol=1e-3 * slopes[1].abs().max().item())


def test_jets_of_degenerate_points_are_finite():
    points = torch.zeros(3, 51, 3)
    points[1, :, 0] = torch.linspace(-1, 1, 51)
    points[2, :25] = torch.tensor([1e-20, 0, 0])
    weights = torch.full((3, 51), 1e-3, requires_grad=True)
    jet = weighted_jets(weights, points, 2)
    assert jet.normal.isfinite().all()
    assert torch.autograd.grad(jet.coefficients.sum(), weights)[0].isfinite().all()
