"""The smallest eigenvectors of many small symmetric matrices: normals of planes, with a gradient that stays finite."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def smallest_eigenvector(matrix: Tensor) -> Tensor:
    """Return (N, 3) unit eigenvectors of the smallest eigenvalues of symmetric (N, 3, 3) matrices, of any sign."""
    return _SmallestEigenvector.apply(matrix)


class _SmallestEigenvector(torch.autograd.Function):
    """In closed form, in float64; the gap between eigenvalues is bounded below in the gradient."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        a = matrix.detach().double()
        a = a / a.abs().amax((1, 2), keepdim=True).clamp_min(1e-30)
        value = _smallest_eigenvalue(a)
        vector = _kernel_vector(a - value[:, None, None] * torch.eye(3, dtype=torch.float64, device=a.device))
        ctx.save_for_backward(matrix, vector)
        return vector.to(matrix.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        matrix, vector = ctx.saved_tensors
        size = matrix.abs().amax((1, 2), keepdim=True).clamp_min(1e-30).double()
        a = matrix.double() / size
        g = grad.double()
        g = g - (g * vector).sum(1, keepdim=True) * vector
        value = (vector[:, None] @ a @ vector[:, :, None])[:, 0, 0]
        shifted = a - (value - 0.02)[:, None, None] * torch.eye(3, dtype=torch.float64, device=a.device)
        w = _adjugate_times(shifted, g)
        w = w - (w * vector).sum(1, keepdim=True) * vector
        outer = w[:, :, None] * vector[:, None]
        return (-(outer + outer.transpose(1, 2)) / (2 * size)).to(grad.dtype)


def _smallest_eigenvalue(a: Tensor) -> Tensor:
    """(N,) of symmetric (N, 3, 3), by the trigonometric solution of the cubic (Smith, 1961)."""
    mean = a.diagonal(dim1=1, dim2=2).mean(1)
    b = a - mean[:, None, None] * torch.eye(3, dtype=a.dtype, device=a.device)
    p = (b.square().sum((1, 2)) / 6).sqrt().clamp_min(1e-30)
    c0 = torch.linalg.cross(b[:, 1], b[:, 2])
    half = ((b[:, 0] * c0).sum(1) / p**3 / 2).clamp(-1, 1)
    return mean + 2 * p * torch.cos(torch.arccos(half) / 3 + 2 * torch.pi / 3)


def _kernel_vector(b: Tensor) -> Tensor:
    """(N, 3) unit vectors that symmetric (N, 3, 3) matrices map to almost zero: the longest product of two rows."""
    products = torch.stack([torch.linalg.cross(b[:, i], b[:, j]) for i, j in ((0, 1), (1, 2), (2, 0))], dim=1)
    square = products.square().sum(2)
    longest = square.argmax(1)
    chosen = products[torch.arange(len(b), device=b.device), longest]
    length = square[torch.arange(len(b), device=b.device), longest].sqrt()[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=b.dtype, device=b.device).expand_as(chosen)
    return torch.where(length > 1e-20, chosen / length.clamp_min(1e-30), up)


def _adjugate_times(a: Tensor, g: Tensor) -> Tensor:
    """(N, 3) solutions of a x = g for symmetric (N, 3, 3) matrices, by Cramer's rule."""
    c0, c1, c2 = (torch.linalg.cross(a[:, i], a[:, j]) for i, j in ((1, 2), (2, 0), (0, 1)))
    determinant = (a[:, 0] * c0).sum(1, keepdim=True)
    x = torch.stack([c0, c1, c2], 2) @ g[:, :, None]
    return x[:, :, 0] / determinant
