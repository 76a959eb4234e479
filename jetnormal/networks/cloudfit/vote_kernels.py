"""Compiled loops that turn weighted neighbors into a vote for a normal or into a jet, and their gradients.

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
def _monomials(x: float, y: float, order: int, out: F64) -> None:
    """The monomials of an n-jet in the order of `geometry.jet.exponents`."""
    out[0] = 1.0
    start = 0
    for degree in range(order):
        for column in range(degree + 1):
            out[start + degree + 1 + column] = out[start + column] * x
        out[start + 2 * degree + 2] = out[start + degree] * y
        start += degree + 1


@compiled
def _solve(a: F64, b: F64) -> None:
    """Cholesky's solution of a b' = b, in place; a is positive definite and becomes its factor."""
    size = len(b)
    for i in range(size):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(max(total, 1e-30)) if i == j else total / a[j, j]
    _solve_again(a, b)


@compiled
def _solve_again(factor: F64, b: F64) -> None:
    size = len(b)
    for i in range(size):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@compiled
def jets(points: F32, weight: F32, order: int, ridge: F64, beta: F32, factors: F64, scales: F64) -> None:
    """Fits z = J(x, y) to points (N, k, 3): coefficients (N, T), and for the way back the normal matrices' factors
    (N, T, T) and the scale (N, T) of each monomial."""
    size = len(ridge)
    phi = np.empty(size)
    for i in range(len(beta)):
        factor, scale = factors[i], scales[i]
        total, spread = 1e-30, 1e-30
        for k in range(points.shape[1]):
            total += weight[i, k]
            spread += weight[i, k] * (abs(points[i, k, 0]) + abs(points[i, k, 1]))
        unit = 2 * total / spread if spread > 1e-12 * total else 1.0
        right = np.zeros(size)
        factor[:] = 0
        for k in range(points.shape[1]):
            w = weight[i, k] / total
            _monomials(points[i, k, 0] * unit, points[i, k, 1] * unit, order, phi)
            for a in range(size):
                right[a] += w * phi[a] * points[i, k, 2]
                for b in range(a + 1):
                    factor[a, b] += w * phi[a] * phi[b]
        for a in range(size):
            scale[a] = 1 / np.sqrt(max(factor[a, a], 1e-30))
        for a in range(size):
            right[a] *= scale[a]
            for b in range(a + 1):
                factor[a, b] *= scale[a] * scale[b]
            factor[a, a] += ridge[a]
        _solve(factor, right)
        power, start = 1.0, 0
        for degree in range(order + 1):
            for a in range(start, start + degree + 1):
                scale[a] *= power
                beta[i, a] = right[a] * scale[a]
            start += degree + 1
            power *= unit


@compiled
def jets_backward(
    points: F32, weight: F32, order: int, beta: F32, factors: F64, scales: F64, grad: F32, out: F32
) -> None:
    """out (N, k): the gradient of the weights of `jets` for a grad (N, T) of its coefficients."""
    size = beta.shape[1]
    phi = np.empty(size)
    back = np.empty(size)
    for i in range(len(points)):
        total = 1e-30
        for k in range(points.shape[1]):
            total += weight[i, k]
        for a in range(size):
            back[a] = grad[i, a] * scales[i, a]
        _solve_again(factors[i], back)
        for a in range(size):
            back[a] *= scales[i, a]
        for k in range(points.shape[1]):
            _monomials(points[i, k, 0], points[i, k, 1], order, phi)
            residual = np.float64(points[i, k, 2])
            along = 0.0
            for a in range(size):
                residual -= phi[a] * beta[i, a]
                along += phi[a] * back[a]
            out[i, k] = along * residual / total
