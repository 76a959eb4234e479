"""The compiled loops over edges against the same formulas written with PyTorch, forward and backward."""

import torch
from torch import Tensor

from jetnormal.networks.cloudfit.edge_kernels import FEATURES
from jetnormal.networks.cloudfit.edge_ops import edge_messages, edge_mlp


def graph() -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    return torch.randint(0, 40, (50, 16), dtype=torch.int32), torch.randn(50, 16, FEATURES)


def check_gradients(result: Tensor, expected: Tensor, inputs: list[Tensor]) -> None:
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-4)
    back = torch.randn_like(result)
    for ours, theirs in zip(
        torch.autograd.grad((result * back).sum(), inputs),
        torch.autograd.grad((expected * back).sum(), inputs),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


def test_messages_are_pooled_by_maximum_and_mean():
    neighbors, features = graph()
    own, sender, weight = (torch.randn(n, 24, requires_grad=True) for n in (50, 40, FEATURES))
    messages = torch.relu(own[:, None] + sender[neighbors.long()] + features @ weight)
    expected = torch.cat([messages[..., :12].amax(1), messages[..., 12:].mean(1)], 1)
    check_gradients(edge_messages(own, sender, weight, neighbors, features), expected, [own, sender, weight])


def test_edge_mlp_equals_its_formula():
    neighbors, features = graph()
    own, sender, weight = (torch.randn(n, 10, requires_grad=True) for n in (50, 40, FEATURES))
    out_weight, bias = torch.randn(3, 10, requires_grad=True), torch.randn(3, requires_grad=True)
    hidden = torch.relu(own[:, None] + sender[neighbors.long()] + features @ weight)
    expected = hidden @ out_weight.T + bias
    result = edge_mlp(own, sender, weight, out_weight, bias, neighbors, features)
    check_gradients(result, expected, [own, sender, weight, out_weight, bias])


def test_views_that_are_not_contiguous_are_understood():
    neighbors, features = graph()
    own, sender, weight = torch.randn(50, 30)[:, 3:27], torch.randn(24, 40).T, torch.randn(FEATURES, 24)
    expected = edge_messages(own.contiguous(), sender.contiguous(), weight, neighbors, features)
    assert torch.equal(edge_messages(own, sender, weight, neighbors, features), expected)
