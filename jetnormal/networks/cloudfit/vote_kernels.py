"""Compiled loops that turn weighted neighbors into a vote for a normal, and their gradient.

They run in one thread and release the interpreter lock.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jetnormal.networks.cloudfit.edge_kernels import F32, F64, I32, offset
from jetnormal.support.compiled import compiled


@compiled
def _mirrored(n0: Any, n1: Any, n2: Any, d0: Any, d1: Any, d2: Any) -> tuple[Any, Any, Any]:
    """A normal n mirrored on the plane that bisects the offset d."""
    turn = 2 * (n0 * d0 + n1 * d1 + n2 * d2) / (d0 * d0 + d1 * d1 + d2 * d2 + np.float32(1e-12))
    return n0 - turn * d0, n1 - turn * d1, n2 - turn * d2


@compiled
def votes(x: F64, unit: F32, xj: F64, nj: F32, nbr: I32, weight: F32, out: F32) -> None:
    """out (N, 3, 3): covariance of the neighbors by weight[..., 0], minus the votes for their normals by weight[..., 1]
    and for these normals mirrored on the bisecting plane of the edge by weight[..., 2]."""
    for i in range(len(out)):
        inverse = np.float32(1) / unit[i]
        total = np.float32(1e-6)
        s0 = s1 = s2 = np.float32(0)
        xx = xy = xz = yy = yz = zz = np.float32(0)
        for k in range(nbr.shape[1]):
            j = np.uint32(nbr[i, k])
            d0, d1, d2 = offset(x[i], xj[j], inverse)
            n0, n1, n2 = nj[j, 0], nj[j, 1], nj[j, 2]
            r0, r1, r2 = _mirrored(n0, n1, n2, d0, d1, d2)
            a, b, e = weight[i, k, 0], weight[i, k, 1], weight[i, k, 2]
            total += a
            s0 += a * d0
            s1 += a * d1
            s2 += a * d2
            xx += a * d0 * d0 - b * n0 * n0 - e * r0 * r0
            xy += a * d0 * d1 - b * n0 * n1 - e * r0 * r1
            xz += a * d0 * d2 - b * n0 * n2 - e * r0 * r2
            yy += a * d1 * d1 - b * n1 * n1 - e * r1 * r1
            yz += a * d1 * d2 - b * n1 * n2 - e * r1 * r2
            zz += a * d2 * d2 - b * n2 * n2 - e * r2 * r2
        m = out[i]
        m[0, 0] = xx - s0 * s0 / total
        m[1, 1] = yy - s1 * s1 / total
        m[2, 2] = zz - s2 * s2 / total
        m[0, 1] = m[1, 0] = xy - s0 * s1 / total
        m[0, 2] = m[2, 0] = xz - s0 * s2 / total
        m[1, 2] = m[2, 1] = yz - s1 * s2 / total


@compiled
def votes_backward(x: F64, unit: F32, xj: F64, nj: F32, nbr: I32, weight: F32, grad: F32, out: F32) -> None:
    """out (N, k, 3): the gradient of the weights of `votes` for a symmetric grad (N, 3, 3)."""
    for i in range(nbr.shape[0]):
        inverse = np.float32(1) / unit[i]
        g = grad[i]
        g00, g11, g22 = g[0, 0], g[1, 1], g[2, 2]
        g01, g02, g12 = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
        total = np.float32(1e-6)
        s0 = s1 = s2 = np.float32(0)
        for k in range(nbr.shape[1]):
            j = np.uint32(nbr[i, k])
            a = weight[i, k, 0] * inverse
            total += weight[i, k, 0]
            s0 += a * np.float32(xj[j, 0] - x[i, 0])
            s1 += a * np.float32(xj[j, 1] - x[i, 1])
            s2 += a * np.float32(xj[j, 2] - x[i, 2])
        s0, s1, s2 = s0 / total, s1 / total, s2 / total
        for k in range(nbr.shape[1]):
            j = np.uint32(nbr[i, k])
            d0, d1, d2 = offset(x[i], xj[j], inverse)
            n0, n1, n2 = nj[j, 0], nj[j, 1], nj[j, 2]
            r0, r1, r2 = _mirrored(n0, n1, n2, d0, d1, d2)
            d0, d1, d2 = d0 - s0, d1 - s1, d2 - s2
            out[i, k, 0] = g00 * d0 * d0 + g11 * d1 * d1 + g22 * d2 * d2 + g01 * d0 * d1 + g02 * d0 * d2 + g12 * d1 * d2
            out[i, k, 1] = -(
                g00 * n0 * n0 + g11 * n1 * n1 + g22 * n2 * n2 + g01 * n0 * n1 + g02 * n0 * n2 + g12 * n1 * n2
            )
            out[i, k, 2] = -(
                g00 * r0 * r0 + g11 * r1 * r1 + g22 * r2 * r2 + g01 * r0 * r1 + g02 * r0 * r2 + g12 * r1 * r2
            )


@compiled
def smallest_eigenvectors(matrix: F32, out: F32) -> None:
    """out (N, 3): unit eigenvectors of the smallest eigenvalues of symmetric matrices (N, 3, 3), of any sign.

    The eigenvalue is by the trigonometric solution of the cubic (Smith, 1961), in float64; the vector is the longest
    cross product of two rows of m - value I, all of which are orthogonal to it.
    """
    for i in range(len(matrix)):
        size = 1e-30
        for a in range(3):
            for b in range(3):
                size = max(size, abs(matrix[i, a, b]))
        xx, yy, zz = matrix[i, 0, 0] / size, matrix[i, 1, 1] / size, matrix[i, 2, 2] / size
        xy, xz, yz = matrix[i, 0, 1] / size, matrix[i, 0, 2] / size, matrix[i, 1, 2] / size
        mean = (xx + yy + zz) / 3
        a, b, c = xx - mean, yy - mean, zz - mean
        p = max(np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6), 1e-30)
        half = (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (2 * p * p * p)
        value = mean + 2 * p * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3 + 2 * np.pi / 3)
        xx, yy, zz = xx - value, yy - value, zz - value
        best = 1e-40
        x, y, z = 0.0, 0.0, 1.0
        for pair in range(3):
            if pair == 0:
                u, v, w = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
            elif pair == 1:
                u, v, w = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
            else:
                u, v, w = yz * xz - zz * xy, zz * xx - xz * xz, xz * xy - yz * xx
            square = u * u + v * v + w * w
            if square > best:
                best = square
                length = np.sqrt(square)
                x, y, z = u / length, v / length, w / length
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
