"""Directions: unit vectors, and even ones over the sphere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def unit(vectors: ArrayLike, otherwise: ArrayLike = 0.0) -> NDArray[np.float64]:
    """Scale vectors (..., 3) to length 1; those without a direction, or not finite, become `otherwise`."""
    given: NDArray[Any] = np.asarray(vectors, dtype=np.float64)
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    directed = (length > 0) & np.isfinite(length)
    return np.asarray(np.where(directed, given / np.where(directed, length, 1.0), otherwise))


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """Return nearly even unit vectors, (count, 3), from the pole at z = 1 down to that at z = -1."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
