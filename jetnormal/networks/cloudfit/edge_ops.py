"""Differentiable operations on the edges of a neighbor graph: compiled loops on the CPU, PyTorch elsewhere."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from jetnormal.networks.cloudfit import edge_kernels as kernels
from jetnormal.networks.cloudfit import torch_ops


class _EdgeMessages(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, own: Tensor, sender: Tensor, weight: Tensor, neighbors: Tensor, features: Tensor) -> Tensor:
        out = torch.empty_like(own, memory_format=torch.contiguous_format)
        tensors = (own, sender, neighbors, features, weight)
        kernels.edge_messages(*_arrays(*tensors, out))
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        own, sender, _, _, weight = ctx.saved_tensors
        grads = [_zeros(own), _zeros(sender), _zeros(weight)]
        kernels.edge_messages_backward(*_arrays(grad, *ctx.saved_tensors, *grads))
        return *grads, None, None


class _EdgeMLP(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, own: Tensor, sender: Tensor, weight: Tensor, out_weight: Tensor, bias: Tensor,
        neighbors: Tensor, features: Tensor,
    ) -> Tensor:  # fmt: skip
        out = own.new_empty(*neighbors.shape, len(out_weight))
        tensors = (own, sender, neighbors, features, weight, out_weight, bias)
        kernels.edge_mlp(*_arrays(*tensors, out))
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(*tensors)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        own, sender, neighbors, features, weight, out_weight, bias = ctx.saved_tensors
        grads = [_zeros(tensor) for tensor in (own, sender, weight, out_weight, bias)]
        kernels.edge_mlp_backward(*_arrays(grad, own, sender, neighbors, features, weight, out_weight, *grads))
        return *grads, None, None


def edge_messages(own: Tensor, sender: Tensor, weight: Tensor, neighbors: Tensor, features: Tensor) -> Tensor:
    """Return the messages relu(own[i] + sender[j] + features[i, j] @ weight) to each i, pooled over its neighbors j.

    Args:
        own: (N, C) float32, C even.
        sender: (M, C) float32.
        weight: (12, C) float32.
        neighbors: (N, k) int32 rows of `sender`.
        features: (N, k, 12) float32; no gradient flows to them.

    Returns:
        (N, C): their maximum in the first half of the channels, their mean in the second.
    """
    if not torch_ops.has_loops(own):
        return torch_ops.edge_messages(own, sender, weight, neighbors, features)
    return _EdgeMessages.apply(own, sender, weight, neighbors, features)


def edge_mlp(
    own: Tensor, sender: Tensor, weight: Tensor, out_weight: Tensor, bias: Tensor, neighbors: Tensor, features: Tensor
) -> Tensor:
    """Compute relu(own[i] + sender[j] + features[i, j] @ weight) @ out_weight.T + bias on each edge.

    Args:
        own: (N, H).
        sender: (M, H).
        weight: (12, H).
        out_weight: (O, H).
        bias: (O,).
        neighbors: (N, k) int32 rows of `sender`.
        features: (N, k, 12); no gradient flows to them.

    Returns:
        (N, k, O).
    """
    if not torch_ops.has_loops(own):
        return torch_ops.edge_mlp(own, sender, weight, out_weight, bias, neighbors, features)
    return _EdgeMLP.apply(own, sender, weight, out_weight, bias, neighbors, features)


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def _zeros(like: Tensor) -> Tensor:
    return torch.zeros_like(like, memory_format=torch.contiguous_format)
