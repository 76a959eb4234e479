"""Principal curvatures from normals: how fast the normals of the neighbors turn.

The shape operator S of a surface is minus the derivative of its normal. At each point the symmetric (2, 2) matrix S
with n' - n = -S (x' - x) in the tangent plane is fitted by least squares over the neighbors of several levels (the
Weingarten map; on a sphere the equation is exact at any distance).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.networks.cloudfit.edge_kernels import F32, F64, I32
from jetnormal.support.compiled import compiled

SAME_SHEET = 0.5  # cosine between two normals, below which an edge or another sheet lies between


@compiled
def _tangents(n: F32) -> Any:
    """Two unit vectors (3,) that make a right-handed frame with n (Duff et al., 2017)."""
    sign = -1.0 if n[2] < 0 else 1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -np.float64(n[1]))


@compiled
def add_equations(x: F64, n: F32, at: NDArray[np.int64], xj: F64, nj: F32, nbr: I32, sums: F64) -> None:
    """Add the equations of one level's neighbors to the sums of each point.

    x (N, 3) and n (N, 3) are points and normals. Row at[i] of nbr (M, k) lists the neighbors of point i, among the m
    points xj (m, 3) with normals nj (m, 3). sums (N, 6) holds sum xx, xy, yy of the offsets (x, y) in the tangent
    plane, and sum x u, x v + y u, y v of the turns (u, v) of the normal.
    """
    for i in range(len(x)):
        first, second = _tangents(n[i])
        for k in range(nbr.shape[1]):
            j = nbr[at[i], k]
            cosine = n[i, 0] * nj[j, 0] + n[i, 1] * nj[j, 1] + n[i, 2] * nj[j, 2]
            if abs(cosine) < SAME_SHEET:
                continue
            side = 1.0 if cosine > 0 else -1.0
            p = q = u = v = 0.0
            for a in range(3):
                d = xj[j, a] - x[i, a]
                turn = side * nj[j, a] - n[i, a]
                p += d * first[a]
                q += d * second[a]
                u += turn * first[a]
                v += turn * second[a]
            sums[i, 0] += p * p
            sums[i, 1] += p * q
            sums[i, 2] += q * q
            sums[i, 3] += p * u
            sums[i, 4] += p * v + q * u
            sums[i, 5] += q * v


def principal(sums: F64) -> F32:
    """Return (N, 2) principal curvatures, the larger first, positive where the surface bends towards the normal.

    Args:
        sums: (N, 6) of `add_equations`; rows without neighbors give zeros.
    """
    xx, xy, yy, xu, mixed, yv = sums.T
    size = np.maximum(xx + yy, 1e-300)
    xx, xy, yy, xu, mixed, yv = (part / size for part in (xx, xy, yy, xu, mixed, yv))
    xx, yy = xx + 1e-6, yy + 1e-6  # offsets along one line do not determine the curvature across it
    # Cramer's rule for [[xx, xy, 0], [xy, xx + yy, xy], [0, xy, yy]] (a, b, c) = (xu, mixed, yv)
    both = xx + yy
    determinant = both * (xx * yy - xy * xy)
    a = xu * (both * yy - xy * xy) - xy * (mixed * yy - yv * xy)
    b = xx * (mixed * yy - yv * xy) - xu * xy * yy
    c = xx * (both * yv - mixed * xy) - xy * (xy * yv - xu * xy)
    a, b, c = -a / determinant, -b / determinant, -c / determinant
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    return np.stack([mean + half, mean - half], axis=1).astype(np.float32)
