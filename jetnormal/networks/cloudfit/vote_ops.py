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
