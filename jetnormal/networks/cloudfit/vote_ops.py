"""Differentiable votes for normals: compiled loops on the CPU, PyTorch elsewhere."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from jetnormal.networks.cloudfit import torch_ops
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


def votes(weights: Tensor, x: Tensor, unit: Tensor, xj: Tensor, nj: Tensor, neighbors: Tensor) -> Tensor:
    """Return (N, 3, 3) symmetric matrices whose smallest eigenvector is the normal that the neighbors vote for.

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
    if not torch_ops.has_loops(weights):
        return torch_ops.votes(weights, x, unit, xj, nj, neighbors)
    return _Votes.apply(weights, x, unit, xj, nj, neighbors)
