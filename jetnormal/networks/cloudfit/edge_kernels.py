"""Compiled loops over the edges of a neighbor graph: each reads its edges once and keeps nothing per edge and channel.

They run in one thread and release the interpreter lock: `networks.rows` shares the rows among threads.
Arrays are C-contiguous: float32 unless said otherwise, neighbors int32. Twelve numbers describe an edge
(`config.FEATURES`), for which the loops are written out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


@compiled
def _values(own: F32, sent: F32, e: F32, w: F32, out: F32) -> None:
    """out = own + sent + e @ w, (C,); written out, so that it is one vectorized loop."""
    e0, e1, e2, e3, e4, e5 = e[0], e[1], e[2], e[3], e[4], e[5]
    e6, e7, e8, e9, e10, e11 = e[6], e[7], e[8], e[9], e[10], e[11]
    for c in range(out.size):
        out[c] = (
            own[c] + sent[c] + e0 * w[0, c] + e1 * w[1, c] + e2 * w[2, c] + e3 * w[3, c] + e4 * w[4, c] + e5 * w[5, c]
            + e6 * w[6, c] + e7 * w[7, c] + e8 * w[8, c] + e9 * w[9, c] + e10 * w[10, c] + e11 * w[11, c]
        )  # fmt: skip


@compiled
def edge_messages(p: F32, u: F32, nbr: I32, q: F32, w: F32, out: F32) -> None:
    """Pools the messages m_ij = relu(p[i] + u[nbr[i, j]] + q[i, j] @ w) of each i.

    p (N, C), u (M, C), nbr (N, k), q (N, k, 12), w (12, C). The first half of the channels of out (N, C) is the
    maximum over j, the second half is the mean.
    """
    half = p.shape[1] // 2
    share = np.float32(1 / nbr.shape[1])
    value = np.empty(p.shape[1], np.float32)
    for i in range(len(out)):
        own, top, mean = p[i], out[i, :half], out[i, half:]
        for c in range(half):
            top[c] = 0
            mean[c] = 0
        for j in range(nbr.shape[1]):
            _values(own, u[np.uint32(nbr[i, j])], q[i, j], w, value)
            first, second = value[:half], value[half:]  # views: loops from 0 are what the compiler vectorizes
            for c in range(half):
                top[c] = max(first[c], top[c])
            for c in range(half):
                mean[c] += share * max(second[c], np.float32(0))


@compiled
def edge_messages_backward(
    grad: F32, p: F32, u: F32, nbr: I32, q: F32, w: F32, grad_p: F32, grad_u: F32, grad_w: F32
) -> None:
    """Add to the gradients of `edge_messages`' p, u and w what grad (N, C) sends back; the messages are recomputed."""
    size = p.shape[1]
    half = size // 2
    share = np.float32(1 / nbr.shape[1])
    value, slope = np.empty(size, np.float32), np.empty(half, np.float32)
    transposed = np.zeros((half, 12), np.float32)
    top, best = np.empty(half, np.float32), np.empty(half, np.float32)
    for i in range(len(grad)):
        own, back, g, second_grad = p[i], grad_p[i], grad[i], grad[i, half:]
        top[:] = 0
        best[:] = -1
        for j in range(nbr.shape[1]):
            _values(own, u[np.uint32(nbr[i, j])], q[i, j], w, value)
            number = np.float32(j)
            for c in range(half):
                best[c] = number if value[c] > top[c] else best[c]
            for c in range(half):
                top[c] = max(value[c], top[c])
        for c in range(half):  # a maximum sends back along one edge
            if best[c] >= 0 and g[c] != 0:
                along = np.uint32(best[c])
                back[c] += g[c]
                grad_u[np.uint32(nbr[i, along]), c] += g[c]
                e, tw = q[i, along], transposed[c]
                for f in range(12):
                    tw[f] += g[c] * e[f]
        for j in range(nbr.shape[1]):
            _values(own, u[np.uint32(nbr[i, j])], q[i, j], w, value)
            second = value[half:]
            for c in range(half):
                slope[c] = share * second_grad[c] if second[c] > 0 else np.float32(0)
            to, own_back = grad_u[np.uint32(nbr[i, j]), half:], back[half:]
            for c in range(half):
                own_back[c] += slope[c]
                to[c] += slope[c]
            for f in range(12):
                ef, gw = q[i, j, f], grad_w[f, half:]
                for c in range(half):
                    gw[c] += ef * slope[c]
    for c in range(half):
        for f in range(12):
            grad_w[f, c] += transposed[c, f]


# A slice of an array in a loop over edges counts references atomically. For the few channels of `edge_mlp` that costs
# more than the arithmetic, so it indexes whole arrays; for many channels slices are faster: they vectorize better.


@compiled
def _values_at(own: F32, i: Any, sent: F32, n: Any, q: F32, j: Any, w: F32, out: F32) -> None:
    """out = own[i] + sent[n] + q[i, j] @ w, (C,)."""
    e0, e1, e2, e3, e4, e5 = q[i, j, 0], q[i, j, 1], q[i, j, 2], q[i, j, 3], q[i, j, 4], q[i, j, 5]
    e6, e7, e8, e9, e10, e11 = q[i, j, 6], q[i, j, 7], q[i, j, 8], q[i, j, 9], q[i, j, 10], q[i, j, 11]
    for c in range(out.size):
        out[c] = (
            own[i, c] + sent[n, c] + e0 * w[0, c] + e1 * w[1, c] + e2 * w[2, c] + e3 * w[3, c] + e4 * w[4, c]
            + e5 * w[5, c] + e6 * w[6, c] + e7 * w[7, c] + e8 * w[8, c] + e9 * w[9, c] + e10 * w[10, c] + e11 * w[11, c]
        )  # fmt: skip


@compiled
def edge_mlp(p: F32, r: F32, nbr: I32, q: F32, w: F32, v: F32, b: F32, out: F32) -> None:
    """out[i, j] = v @ relu(p[i] + r[nbr[i, j]] + q[i, j] @ w) + b.

    p (N, H), r (M, H), nbr (N, k), q (N, k, 12), w (12, H), v (O, H), b (O,), out (N, k, O).
    """
    size = p.shape[1]
    hidden = np.empty(size, np.float32)
    for i in range(len(out)):
        for j in range(nbr.shape[1]):
            _values_at(p, i, r, np.uint32(nbr[i, j]), q, j, w, hidden)
            for c in range(size):
                hidden[c] = max(hidden[c], np.float32(0))
            for o in range(v.shape[0]):
                total = b[o]
                for c in range(size):
                    total += hidden[c] * v[o, c]
                out[i, j, o] = total


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


@compiled
def edge_mlp_backward(
    grad: F32, p: F32, r: F32, nbr: I32, q: F32, w: F32, v: F32,
    grad_p: F32, grad_r: F32, grad_w: F32, grad_v: F32, grad_b: F32,
) -> None:  # fmt: skip
    """Add to the gradients of `edge_mlp`'s p, r, w, v, b what grad (N, k, O) sends back; the values are recomputed."""
    size = p.shape[1]
    hidden, slope = np.empty(size, np.float32), np.empty(size, np.float32)
    for i in range(nbr.shape[0]):
        for j in range(nbr.shape[1]):
            sender = np.uint32(nbr[i, j])
            _values_at(p, i, r, sender, q, j, w, hidden)
            for c in range(size):
                hidden[c] = max(hidden[c], np.float32(0))
                slope[c] = 0
            for o in range(v.shape[0]):
                g = grad[i, j, o]
                grad_b[o] += g
                for c in range(size):
                    grad_v[o, c] += g * hidden[c]
                for c in range(size):
                    slope[c] += g * v[o, c]
            for c in range(size):
                slope[c] = slope[c] if hidden[c] > 0 else np.float32(0)
            for c in range(size):
                grad_p[i, c] += slope[c]
            for c in range(size):
                grad_r[sender, c] += slope[c]
            for f in range(12):
                ef = q[i, j, f]
                for c in range(size):
                    grad_w[f, c] += ef * slope[c]


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
    xi: F64, ni: F32, mi: F32, ti: F32, si: F32, unit: F32,
    xj: F64, nj: F32, mj: F32, tj: F32, sj: F32, nbr: I32, out: F32,
) -> None:  # fmt: skip
    """The invariants of the edges to xi (N, 3) from xj (M, 3); see `layers.connect`."""
    for i in range(len(out)):
        inverse = np.float32(1) / unit[i]
        n0, n1, n2 = ni[i, 0], ni[i, 1], ni[i, 2]
        m0, m1, m2 = mi[i, 0], mi[i, 1], mi[i, 2]
        t, scale = ti[i], si[i]
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
            e[11] = np.log(sj[j] / scale)
