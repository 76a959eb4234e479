"""Differentiable votes for normals and weighted jets, over the compiled loops of `vote_kernels`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from jetnormal.geometry.jet import Jet, exponents
from jetnormal.networks.cloudfit import vote_kernels as kernels


class _Votes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weight: Tensor, x: Tensor, unit: Tensor, xj: Tensor, nj: Tensor, neighbors: Tensor) -> Tensor:
        out = weight.new_empty(len(x), 3, 3)
        arrays = [t.detach().contiguous().numpy() for t in (x, unit, xj, nj, neighbors, weight)]
        kernels.votes(*arrays, out.numpy())
        ctx.arrays = arrays if any(ctx.needs_input_grad) else None
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        out = grad.new_empty(ctx.arrays[-1].shape)
        kernels.votes_backward(*ctx.arrays, grad.contiguous().numpy(), out.numpy())
        return out, None, None, None, None, None


class _Jets(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, points: Tensor, order: int) -> Tensor:
        degrees = torch.tensor([a + b for a, b in exponents(order)])
        ridge = torch.where(degrees > 1, 1e-6, 1e-9).double()  # as `geometry.jet.fit_jet`
        count, terms = len(points), len(degrees)
        beta = points.new_empty(count, terms)
        factors, scales = points.new_empty(count, terms, terms, dtype=torch.float64), torch.empty(count, terms).double()
        arrays = points.detach().contiguous().numpy(), weights.detach().contiguous().numpy()
        results = beta.numpy(), factors.numpy(), scales.numpy()
        kernels.jets(*arrays, order, ridge.numpy(), *results)
        ctx.arrays = (*arrays, order, *results) if any(ctx.needs_input_grad) else None
        return beta

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        out = grad.new_empty(ctx.arrays[1].shape)
        kernels.jets_backward(*ctx.arrays, grad.contiguous().numpy(), out.numpy())
        return out, None, None


def weighted_jets(weights: Tensor, points: Tensor, order: int) -> Jet:
    """`geometry.jet.fit_jet`, compiled; the only gradient is that of the weights.

    Args:
        weights: (N, k) positive float32.
        points: (N, k, 3) float32, z close to the normal.
        order: of the jet.
    """
    return Jet(_Jets.apply(weights, points, order), order)


def votes(weights: Tensor, x: Tensor, unit: Tensor, xj: Tensor, nj: Tensor, neighbors: Tensor) -> Tensor:
    """(N, 3, 3) symmetric matrices whose smallest eigenvector is the normal that the neighbors vote for.

    With d the offset to a neighbor in units of `unit`, n its normal and r that normal mirrored on the plane which
    bisects d (on a sphere, the own normal):  sum a (d - mean)(d - mean)^T - b n n^T - c r r^T.

    Args:
        weights: (N, k, 3) non-negative a, b and c.
        x: (N, 3) float64 positions.
        unit: (N,) unit of length.
        xj: (M, 3) float64 positions of the neighbors.
        nj: (M, 3) their unit normals, of any sign.
        neighbors: (N, k) int32 rows of `xj`.
    """
    return _Votes.apply(weights, x, unit, xj, nj, neighbors)


def smallest_eigenvector(matrix: Tensor) -> Tensor:
    """(N, 3) unit eigenvectors of the smallest eigenvalues of symmetric (N, 3, 3) matrices, of any sign."""
    return _SmallestEigenvector.apply(matrix)


class _SmallestEigenvector(torch.autograd.Function):
    """In closed form, in float64; the gap between eigenvalues is bounded below in the gradient."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        a = matrix.detach().double()
        a = a / a.abs().amax((1, 2), keepdim=True).clamp_min(1e-30)
        value = _smallest_eigenvalue(a)
        vector = _kernel_vector(a - value[:, None, None] * torch.eye(3, dtype=torch.float64))
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
        shifted = a - (value - 0.02)[:, None, None] * torch.eye(3, dtype=torch.float64)
        w = _adjugate_times(shifted, g)
        w = w - (w * vector).sum(1, keepdim=True) * vector
        outer = w[:, :, None] * vector[:, None]
        return (-(outer + outer.transpose(1, 2)) / (2 * size)).to(grad.dtype)


def _smallest_eigenvalue(a: Tensor) -> Tensor:
    """(N,) of symmetric (N, 3, 3), by the trigonometric solution of the cubic (Smith, 1961)."""
    mean = a.diagonal(dim1=1, dim2=2).mean(1)
    b = a - mean[:, None, None] * torch.eye(3, dtype=a.dtype)
    p = (b.square().sum((1, 2)) / 6).sqrt().clamp_min(1e-30)
    c0 = torch.linalg.cross(b[:, 1], b[:, 2])
    half = ((b[:, 0] * c0).sum(1) / p**3 / 2).clamp(-1, 1)
    return mean + 2 * p * torch.cos(torch.arccos(half) / 3 + 2 * torch.pi / 3)


def _kernel_vector(b: Tensor) -> Tensor:
    """(N, 3) unit vectors that symmetric (N, 3, 3) matrices map to about zero: the longest of the rows' products."""
    products = torch.stack([torch.linalg.cross(b[:, i], b[:, j]) for i, j in ((0, 1), (1, 2), (2, 0))], dim=1)
    square = products.square().sum(2)
    longest = square.argmax(1)
    chosen = products[torch.arange(len(b)), longest]
    length = square[torch.arange(len(b)), longest].sqrt()[:, None]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=b.dtype).expand_as(chosen)
    return torch.where(length > 1e-20, chosen / length.clamp_min(1e-30), up)


def _adjugate_times(a: Tensor, g: Tensor) -> Tensor:
    """(N, 3) solutions of a x = g for symmetric (N, 3, 3) matrices, by Cramer's rule."""
    c0, c1, c2 = (torch.linalg.cross(a[:, i], a[:, j]) for i, j in ((1, 2), (2, 0), (0, 1)))
    determinant = (a[:, 0] * c0).sum(1, keepdim=True)
    x = torch.stack([c0, c1, c2], 2) @ g[:, :, None]
    return x[:, :, 0] / determinant
