"""Smallest eigenvectors and their gradients against torch.linalg.eigh."""

import pytest
import torch
import torch.nn.functional as F

from jetnormal.networks.eigenvectors import smallest_eigenvector


def test_smallest_eigenvector_is_that_of_eigh():
    torch.manual_seed(2)
    m = torch.randn(200, 3, 3)
    m = m + m.transpose(1, 2)
    expected = torch.linalg.eigh(m.double())[1][:, :, 0].float()
    found = smallest_eigenvector(m)
    torch.testing.assert_close((found * expected).sum(1).abs(), torch.ones(200), atol=1e-5, rtol=0)


def test_gradient_of_the_eigenvector_is_that_of_eigh_where_the_gap_is_large():
    torch.manual_seed(3)
    turn = torch.linalg.qr(torch.randn(50, 3, 3)).Q
    m = (turn @ torch.diag(torch.tensor([0.0, 50.0, 80.0])) @ turn.transpose(1, 2)).requires_grad_()
    target = F.normalize(turn[:, :, 0] + 0.3 * torch.randn(50, 3), dim=1)

    def misfit(normal: torch.Tensor) -> torch.Tensor:
        return (1 - (normal * target).sum(1).square()).sum()

    ours = torch.autograd.grad(misfit(smallest_eigenvector(m)), m)[0]
    theirs = torch.autograd.grad(misfit(torch.linalg.eigh(m)[1][:, :, 0]), m)[0]
    theirs = (theirs + theirs.transpose(1, 2)) / 2
    relative = (ours - theirs).norm(dim=(1, 2)) / theirs.norm(dim=(1, 2))
    assert relative.max() < 0.1  # the bounded gap makes it a little smaller


@pytest.mark.parametrize("matrix", [torch.zeros(1, 3, 3), torch.eye(3)[None], torch.full((1, 3, 3), 1e30)])
def test_degenerate_matrices_give_a_unit_vector_and_a_finite_gradient(matrix: torch.Tensor):
    matrix = matrix.clone().requires_grad_()
    vector = smallest_eigenvector(matrix)
    assert vector.norm().item() == pytest.approx(1, abs=1e-6)
    assert torch.autograd.grad(vector.sum(), matrix)[0].isfinite().all()
