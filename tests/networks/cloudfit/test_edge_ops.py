"""The compiled loops over edges against the same operations in PyTorch, forward and backward."""

import numpy as np
import torch
from torch import Tensor

from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit import torch_ops
from jetnormal.networks.cloudfit.config import FEATURES
from jetnormal.networks.cloudfit.edge_ops import edge_messages, edge_mlp
from jetnormal.networks.cloudfit.layers import Nodes, connect


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
    expected = torch_ops.edge_messages(own, sender, weight, neighbors, features)
    check_gradients(edge_messages(own, sender, weight, neighbors, features), expected, [own, sender, weight])
    message = torch.relu(own[3] + sender[neighbors[3].long()] + features[3] @ weight)  # by hand
    torch.testing.assert_close(expected[3], torch.cat([message[:, :12].amax(0), message[:, 12:].mean(0)]))


def test_edge_mlp_equals_that_of_pytorch():
    neighbors, features = graph()
    own, sender, weight = (torch.randn(n, 10, requires_grad=True) for n in (50, 40, FEATURES))
    out_weight, bias = torch.randn(3, 10, requires_grad=True), torch.randn(3, requires_grad=True)
    expected = torch_ops.edge_mlp(own, sender, weight, out_weight, bias, neighbors, features)
    result = edge_mlp(own, sender, weight, out_weight, bias, neighbors, features)
    check_gradients(result, expected, [own, sender, weight, out_weight, bias])


def test_views_that_are_not_contiguous_are_understood():
    neighbors, features = graph()
    own, sender, weight = torch.randn(50, 30)[:, 3:27], torch.randn(24, 40).T, torch.randn(FEATURES, 24)
    expected = edge_messages(own.contiguous(), sender.contiguous(), weight, neighbors, features)
    assert torch.equal(edge_messages(own, sender, weight, neighbors, features), expected)


def test_invariants_of_edges_equal_those_of_pytorch():
    pyramid = build_pyramid(np.random.default_rng(0).random((300, 3)), 2)
    fine, coarse = (Nodes.of(level, torch.device("cpu")) for level in pyramid.levels)
    parents = torch.from_numpy(pyramid.levels[0].parents)
    compiled = connect(fine, coarse, parents, fine.scale).features
    with torch_ops.plain_torch():
        plain = connect(fine, coarse, parents, fine.scale).features
    torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-5)
