"""The operations on edges in plain PyTorch: for CUDA, and the reference for the compiled loops.

Each gathers what the neighbors send, so it needs memory for every edge and channel; the compiled loops of
`edge_kernels` and `vote_kernels` do not, and are several times as fast on a CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

_plain = False


@contextmanager
def plain_torch() -> Iterator[None]:
    """Use these operations inside the block on the CPU as well."""
    global _plain
    before, _plain = _plain, True
    try:
        yield
    finally:
        _plain = before


def has_loops(tensor: Tensor) -> bool:
    """Tell whether the compiled loops take a tensor: it is on the CPU, and `plain_torch` is not asked for."""
    return tensor.device.type == "cpu" and not _plain


def edge_messages(own: Tensor, sender: Tensor, weight: Tensor, neighbors: Tensor, features: Tensor) -> Tensor:
    """See `edge_ops.edge_messages`."""
    messages = torch.relu(own[:, None] + sender[neighbors.long()] + features @ weight)
    half = own.shape[1] // 2
    return torch.cat([messages[..., :half].amax(1), messages[..., half:].mean(1)], 1)


def edge_mlp(
    own: Tensor, sender: Tensor, weight: Tensor, out_weight: Tensor, bias: Tensor, neighbors: Tensor, features: Tensor
) -> Tensor:
    """See `edge_ops.edge_mlp`."""
    hidden = torch.relu(own[:, None] + sender[neighbors.long()] + features @ weight)
    return hidden @ out_weight.T + bias


def edge_features(own: tuple[Tensor, ...], unit: Tensor, sender: tuple[Tensor, ...], neighbors: Tensor) -> Tensor:
    """Return (N, k, 12) invariants of edges, see `layers.connect`.

    Args:
        own: positions (N, 3) float64, normals (N, 3), centroids (N, 3), signs (N,) and scales (N,) of the receivers.
        unit: (N,) unit of length.
        sender: the same of the M senders.
        neighbors: (N, k) int32 rows of the senders.
    """
    x, n, m, t, s = own
    index = neighbors.long()
    xj, nj, mj, tj, sj = (values[index] for values in sender)
    d = (xj - x[:, None]).float() / unit[:, None, None]
    square = d.square().sum(2)
    a, b = (n[:, None] * d).sum(2), (nj * d).sum(2)
    c = (n[:, None] * nj).sum(2)
    t = t[:, None]
    m_d, mj_d = (m[:, None] * d).sum(2), (mj * d).sum(2)
    log = torch.log(sj / s[:, None])
    columns = [
        square,
        square.sqrt(),
        a.abs(),
        b.abs(),
        c.square(),
        a * b * c,
        a * t,
        b * tj,
        m_d,
        mj_d,
        c * t * tj,
        log,
    ]
    return torch.stack(columns, 2)


def votes(weights: Tensor, x: Tensor, unit: Tensor, xj: Tensor, nj: Tensor, neighbors: Tensor) -> Tensor:
    """See `vote_ops.votes`."""
    index = neighbors.long()
    d = (xj[index] - x[:, None]).float() / unit[:, None, None]
    n = nj[index]
    mirrored = n - 2 * (n * d).sum(2, keepdim=True) / (d.square().sum(2, keepdim=True) + 1e-12) * d
    a, b, c = weights.unbind(2)
    mean = (a[..., None] * d).sum(1) / (a.sum(1, keepdim=True) + 1e-6)
    spread = (
        torch.einsum("nk,nki,nkj->nij", a, d, d) - (a.sum(1) + 1e-6)[:, None, None] * mean[:, :, None] * mean[:, None]
    )
    return spread - torch.einsum("nk,nki,nkj->nij", b, n, n) - torch.einsum("nk,nki,nkj->nij", c, mirrored, mirrored)
