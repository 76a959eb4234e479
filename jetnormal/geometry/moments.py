"""Moments of the neighbors of each point: scale, plane, variances, centroid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

# Of n points: scale (n,), normals (n, 3), variances (n, 3) and centroids (n, 3); see `pyramid.Neighborhood`.
Moments = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


@compiled
def _principal(m: NDArray[np.float64], values: NDArray[np.float64], normal: NDArray[np.float64]) -> None:
    """Ascending eigenvalues of a symmetric (3, 3) matrix of trace about 1, and a unit eigenvector of the smallest.

    The largest eigenvalue is by the trigonometric solution of the cubic (Smith, 1961); the vector is the longest cross
    product of two rows of m - value I, all of which are orthogonal to it.
    """
    mean = (m[0, 0] + m[1, 1] + m[2, 2]) / 3
    a, b, c = m[0, 0] - mean, m[1, 1] - mean, m[2, 2] - mean
    d, e, f = m[0, 1], m[0, 2], m[1, 2]
    p = np.sqrt((a * a + b * b + c * c + 2 * (d * d + e * e + f * f)) / 6)
    values[:] = mean
    if p > 1e-200:
        half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2 * p * p * p)
        values[2] = mean + 2 * p * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3)
        # the smaller two from their sum and product: the cubic's own solution would lose half the digits
        together = max(3 * mean - values[2], 0.0)
        determinant = m[0, 0] * (m[1, 1] * m[2, 2] - f * f) - d * (d * m[2, 2] - f * e) + e * (d * f - m[1, 1] * e)
        # rounding of collinear points must not look like a width: eigenvalues are not negative, and real
        product = min(max(determinant / values[2], 0.0), together * together / 4)
        values[1] = (together + np.sqrt(max(together * together - 4 * product, 0.0))) / 2
        values[0] = product / values[1] if values[1] > 1e-200 else 0.0
    longest = 0.0
    normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    for row in range(3):
        other = (row + 1) % 3
        u0, u1, u2 = m[row, 0], m[row, 1], m[row, 2]
        v0, v1, v2 = m[other, 0], m[other, 1], m[other, 2]
        if row == 0:
            u0, v1 = u0 - values[0], v1 - values[0]
        elif row == 1:
            u1, v2 = u1 - values[0], v2 - values[0]
        else:
            u2, v0 = u2 - values[0], v0 - values[0]
        x, y, z = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        square = x * x + y * y + z * z
        if square > longest and square > 1e-60:
            longest = square
            length = np.sqrt(square)
            normal[0], normal[1], normal[2] = x / length, y / length, z / length


def moments_of(points: NDArray[np.float64], others: NDArray[np.float64], neighbors: NDArray[np.int32]) -> Moments:
    """Compute scale, normal, variances and centroid of each point's neighborhood among others, itself included."""
    count = len(points)
    scale, normals = np.empty(count, np.float32), np.empty((count, 3), np.float32)
    variance, centroid = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    _moments(points, others, neighbors, np.empty((6, 3)), scale, normals, variance, centroid)
    return scale, normals, variance, centroid


@compiled
def _moments(
    points: NDArray[np.float64],
    others: NDArray[np.float64],
    neighbors: NDArray[np.int32],
    work: NDArray[np.float64],
    scale: NDArray[np.float32],
    normals: NDArray[np.float32],
    variance: NDArray[np.float32],
    centroid: NDArray[np.float32],
) -> None:
    """`moments_of` into arrays; work is (6, 3)."""
    k = neighbors.shape[1]
    mean, values, normal, covariance = work[0], work[1], work[2], work[3:]
    for i in range(len(points)):
        mean[:] = 0
        covariance[:] = 0
        for j in neighbors[i]:
            for a in range(3):
                d = others[j, a] - points[i, a]
                mean[a] += d
                for b in range(a + 1):
                    covariance[a, b] += d * (others[j, b] - points[i, b])
        square = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
        size = np.sqrt(square / k) if square > 0 else 1.0
        scale[i] = size
        for a in range(3):
            centroid[i, a] = mean[a] / (k * size)
            for b in range(a + 1):
                covariance[a, b] = (covariance[a, b] - mean[a] * mean[b] / (k + 1)) / (size * size)
                covariance[b, a] = covariance[a, b]
        _principal(covariance, values, normal)
        total = max(values[0] + values[1] + values[2], 1e-30)
        for a in range(3):
            normals[i, a] = normal[a]
            variance[i, a] = max(values[a], 0.0) / total
