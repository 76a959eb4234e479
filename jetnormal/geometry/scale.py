"""Scale clouds of any size to size one, so that later steps may round to float32 and square."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FARTHEST = 2.0**100  # extents of the cloud: whatever lies beyond is moved here, from where nothing looks different


def unit_scale(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Scale a cloud by a power of two, which is exact, so that most of it is about one in size.

    The size is the median distance from the median, axis by axis, so that no few points decide on it.

    Args:
        points: (N, 3) finite, N >= 1.

    Returns:
        The scaled points (N, 3), those beyond 2^100 sizes moved there, and the exponent of the factor.
    """
    middle = np.median(points, axis=0)
    offsets = np.abs(points - middle)
    size = float(np.median(offsets, axis=0).max()) or float(offsets.max())
    if size == 0:
        return points, 0
    exponent = 1 - int(np.frexp(size)[1])
    if offsets.max() > FARTHEST * size:
        points = np.clip(points, middle - FARTHEST * size, middle + FARTHEST * size)
    return np.ldexp(points, exponent), exponent
