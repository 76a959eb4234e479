"""Compiled loops over the edges of a neighbor graph. Each reads its edges once and stores nothing per edge and channel.

They run in one thread and release the interpreter lock: `networks.rows` shares the rows among threads.
Arrays are C-contiguous: float32 unless said otherwise, neighbors int32. Twelve numbers describe an edge
(`config.FEATURES`) and three weights are given to it (`config.BALLOTS`), for which the loops are written out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


# What makes these loops fast: whole rows of channels (the compiler takes 64 at a time and the rest one by one, so that
# half a row of 32 would be slow), no slices inside (each counts references atomically), sums in arrays of their own.


@compiled
def _invariants(q: F32, i: Any, j: Any) -> Any:
    """The twelve numbers of an edge."""
    return (
        q[i, j, 0], q[i, j, 1], q[i, j, 2], q[i, j, 3], q[i, j, 4], q[i, j, 5],
        q[i, j, 6], q[i, j, 7], q[i, j, 8], q[i, j, 9], q[i, j, 10], q[i, j, 11],
    )  # fmt: skip


@compiled
def _value(p: F32, i: Any, u: F32, n: Any, e: Any, w: F32, c: Any) -> Any:
    """Channel c of p[i] + u[n] + e @ w."""
    return (
        p[i, c] + u[n, c] + e[0] * w[0, c] + e[1] * w[1, c] + e[2] * w[2, c] + e[3] * w[3, c] + e[4] * w[4, c]
        + e[5] * w[5, c] + e[6] * w[6, c] + e[7] * w[7, c] + e[8] * w[8, c] + e[9] * w[9, c] + e[10] * w[10, c]
        + e[11] * w[11, c]
    )  # fmt: skip


def edge_messages(p: F32, u: F32, nbr: I32, q: F32, w: F32, out: F32) -> None:
    """Pool the messages m_ij = relu(p[i] + u[nbr[i, j]] + q[i, j] @ w) of each i.

    p (N, C), u (M, C), nbr (N, k), q (N, k, 12), w (12, C). The first half of the channels of out (N, C) is the
    maximum over j, the second half is the mean.
    """
    _pool_messages(p, u, nbr, q, w, np.empty((2, p.shape[1]), np.float32), out)


@compiled
def _pool_messages(p: F32, u: F32, nbr: I32, q: F32, w: F32, work: F32, out: F32) -> None:
    """`edge_messages` with memory to work in, (2, C)."""
    size = p.shape[1]
    half = size // 2
    share = np.float32(1 / nbr.shape[1])
    top, total = work[0], work[1]
    for i in range(len(out)):
        for c in range(size):
            top[c] = 0
            total[c] = 0
        for j in range(nbr.shape[1]):
            n, e = np.uint32(nbr[i, j]), _invariants(q, i, j)
            for c in range(size):
                value = _value(p, i, u, n, e, w, c)
                top[c] = max(top[c], value)
                total[c] += max(value, np.float32(0))
        for c in range(half):
            out[i, c] = top[c]
        for c in range(half, size):
            out[i, c] = share * total[c]


def edge_messages_backward(
    grad: F32, p: F32, u: F32, nbr: I32, q: F32, w: F32, grad_p: F32, grad_u: F32, grad_w: F32
) -> None:
    """Backpropagate grad (N, C) through `edge_messages`: add to the gradients of p, u, w; recompute the messages."""
    size = p.shape[1]
    of_maxima, of_means = np.zeros((size // 2, 12), np.float32), np.zeros((12, size), np.float32)
    work = np.empty((5, size), np.float32)
    _messages_backward(grad, p, u, nbr, q, w, work, of_maxima, of_means, grad_p, grad_u, grad_w)


@compiled
def _messages_backward(
    grad: F32, p: F32, u: F32, nbr: I32, q: F32, w: F32,
    work: F32, of_maxima: F32, of_means: F32, grad_p: F32, grad_u: F32, grad_w: F32,
) -> None:  # fmt: skip
    """`edge_messages_backward` with memory to work in, (5, C), and sums that begin with 0, (C / 2, 12) and (12, C)."""
    size = p.shape[1]
    half = size // 2
    share = np.float32(1 / nbr.shape[1])
    top, best, back, each, slope = work[0], work[1], work[2], work[3], work[4]
    for i in range(len(grad)):
        for c in range(size):
            top[c] = 0
            best[c] = -1
            back[c] = 0
            each[c] = share * grad[i, c] if c >= half else np.float32(0)
        for j in range(nbr.shape[1]):
            n, e, number = np.uint32(nbr[i, j]), _invariants(q, i, j), np.float32(j)
            for c in range(size):
                value = _value(p, i, u, n, e, w, c)
                best[c] = number if value > top[c] else best[c]
                top[c] = max(top[c], value)
                slope[c] = each[c] if value > 0 else np.float32(0)
            for c in range(size):
                back[c] += slope[c]
            for c in range(size):
                grad_u[n, c] += slope[c]
            for c in range(size):  # written out: a call costs more than the sum
                s = slope[c]
                of_means[0, c] += e[0] * s
                of_means[1, c] += e[1] * s
                of_means[2, c] += e[2] * s
                of_means[3, c] += e[3] * s
                of_means[4, c] += e[4] * s
                of_means[5, c] += e[5] * s
                of_means[6, c] += e[6] * s
                of_means[7, c] += e[7] * s
                of_means[8, c] += e[8] * s
                of_means[9, c] += e[9] * s
                of_means[10, c] += e[10] * s
                of_means[11, c] += e[11] * s
        for c in range(half):  # a maximum sends back along one edge
            if best[c] >= 0:
                along, g = np.uint32(best[c]), grad[i, c]
                back[c] += g
                grad_u[np.uint32(nbr[i, along]), c] += g
                for f in range(12):
                    of_maxima[c, f] += g * q[i, along, f]
        for c in range(size):
            grad_p[i, c] += back[c]
    for f in range(12):
        for c in range(half):
            grad_w[f, c] += of_maxima[c, f]
        for c in range(half, size):
            grad_w[f, c] += of_means[f, c]


@compiled
def edge_mlp(p: F32, r: F32, nbr: I32, q: F32, w: F32, v: F32, b: F32, out: F32) -> None:
    """out[i, j] = v @ relu(p[i] + r[nbr[i, j]] + q[i, j] @ w) + b.

    p (N, H), r (M, H), nbr (N, k), q (N, k, 12), w (12, H), v (3, H), b (3,), out (N, k, 3).
    """
    for i in range(len(out)):
        for j in range(nbr.shape[1]):
            n, e = np.uint32(nbr[i, j]), _invariants(q, i, j)
            x, y, z = b[0], b[1], b[2]
            for c in range(p.shape[1]):
                hidden = max(_value(p, i, r, n, e, w, c), np.float32(0))
                x += hidden * v[0, c]
                y += hidden * v[1, c]
                z += hidden * v[2, c]
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = x, y, z


@compiled
def layer_norm(x: F32, gain: F32, shift: F32) -> None:
    """Layer normalization of the rows of x (N, C), in place, as `torch.nn.LayerNorm`."""
    size = x.shape[1]
    for i in range(len(x)):
        total = np.float32(0)
        for c in range(size):
            total += x[i, c]
        mean = total / np.float32(size)
        total = np.float32(0)
        for c in range(size):
            total += (x[i, c] - mean) * (x[i, c] - mean)
        inverse = np.float32(1) / np.sqrt(total / np.float32(size) + np.float32(1e-5))
        for c in range(size):
            x[i, c] = (x[i, c] - mean) * inverse * gain[c] + shift[c]


def edge_mlp_backward(
    grad: F32, p: F32, r: F32, nbr: I32, q: F32, w: F32, v: F32,
    grad_p: F32, grad_r: F32, grad_w: F32, grad_v: F32, grad_b: F32,
) -> None:  # fmt: skip
    """Backpropagate grad (N, k, 3) through `edge_mlp`: add to the gradients of p, r, w, v, b; recompute the values."""
    size = p.shape[1]
    of_v, of_w = np.zeros((3, size), np.float32), np.zeros((12, size), np.float32)
    work = np.empty((2, size), np.float32)
    _mlp_backward(grad, p, r, nbr, q, w, v, work, of_v, of_w, grad_p, grad_r, grad_w, grad_v, grad_b)


@compiled
def _mlp_backward(
    grad: F32, p: F32, r: F32, nbr: I32, q: F32, w: F32, v: F32,
    work: F32, of_v: F32, of_w: F32, grad_p: F32, grad_r: F32, grad_w: F32, grad_v: F32, grad_b: F32,
) -> None:  # fmt: skip
    """`edge_mlp_backward` with memory to work in, (2, H), and two sums that begin with 0, (3, H) and (12, H)."""
    size = p.shape[1]
    slope, back = work[0], work[1]
    for i in range(nbr.shape[0]):
        for c in range(size):
            back[c] = 0
        for j in range(nbr.shape[1]):
            n, e = np.uint32(nbr[i, j]), _invariants(q, i, j)
            x, y, z = grad[i, j, 0], grad[i, j, 1], grad[i, j, 2]
            grad_b[0] += x
            grad_b[1] += y
            grad_b[2] += z
            for c in range(size):
                hidden = max(_value(p, i, r, n, e, w, c), np.float32(0))
                of_v[0, c] += x * hidden
                of_v[1, c] += y * hidden
                of_v[2, c] += z * hidden
                slope[c] = x * v[0, c] + y * v[1, c] + z * v[2, c] if hidden > 0 else np.float32(0)
            for c in range(size):
                back[c] += slope[c]
            for c in range(size):
                grad_r[n, c] += slope[c]
            for c in range(size):  # written out: a call costs more than the sum
                s = slope[c]
                of_w[0, c] += e[0] * s
                of_w[1, c] += e[1] * s
                of_w[2, c] += e[2] * s
                of_w[3, c] += e[3] * s
                of_w[4, c] += e[4] * s
                of_w[5, c] += e[5] * s
                of_w[6, c] += e[6] * s
                of_w[7, c] += e[7] * s
                of_w[8, c] += e[8] * s
                of_w[9, c] += e[9] * s
                of_w[10, c] += e[10] * s
                of_w[11, c] += e[11] * s
        for c in range(size):
            grad_p[i, c] += back[c]
    for c in range(size):
        for o in range(3):
            grad_v[o, c] += of_v[o, c]
        for f in range(12):
            grad_w[f, c] += of_w[f, c]


@compiled
def offset(x: F64, xj: F64, inverse: Any) -> tuple[Any, Any, Any]:
    """From x (3,) to xj (3,), times `inverse`; the difference is taken in float64, for far-away clouds."""
    return (
        np.float32(xj[0] - x[0]) * inverse,
        np.float32(xj[1] - x[1]) * inverse,
        np.float32(xj[2] - x[2]) * inverse,
    )


@compiled
def edge_features(
    xi: F64, ni: F32, mi: F32, ti: F32, li: F32, unit: F32,
    xj: F64, nj: F32, mj: F32, tj: F32, lj: F32, nbr: I32, out: F32,
) -> None:  # fmt: skip
    """The invariants of the edges to xi (N, 3) from xj (M, 3); l are logarithms of scales; see `layers.connect`."""
    for i in range(len(out)):
        inverse = np.float32(1) / unit[i]
        n0, n1, n2 = ni[i, 0], ni[i, 1], ni[i, 2]
        m0, m1, m2 = mi[i, 0], mi[i, 1], mi[i, 2]
        t, log_scale = ti[i], li[i]
        for k in range(nbr.shape[1]):
            j = np.uint32(nbr[i, k])
            d0, d1, d2 = offset(xi[i], xj[j], inverse)
            square = d0 * d0 + d1 * d1 + d2 * d2
            a = n0 * d0 + n1 * d1 + n2 * d2
            b = nj[j, 0] * d0 + nj[j, 1] * d1 + nj[j, 2] * d2
            c = n0 * nj[j, 0] + n1 * nj[j, 1] + n2 * nj[j, 2]
            e = out[i, k]
            e[0] = square
            e[1] = np.sqrt(square)
            e[2] = abs(a)
            e[3] = abs(b)
            e[4] = c * c
            e[5] = a * b * c
            e[6] = a * t
            e[7] = b * tj[j]
            e[8] = m0 * d0 + m1 * d1 + m2 * d2
            e[9] = mj[j, 0] * d0 + mj[j, 1] * d1 + mj[j, 2] * d2
            e[10] = c * t * tj[j]
            e[11] = lj[j] - log_scale
