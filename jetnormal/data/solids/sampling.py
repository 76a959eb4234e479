"""Helpers of sampling solids and measuring distances to them."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rejected(
    propose: Callable[[int], Floats],
    acceptance: Callable[[Floats], Floats],
    count: int,
    rng: np.random.Generator,
) -> Floats:
    """Draw `count` values by rejection sampling.

    Args:
        propose: returns as many proposals as asked for, along the first axis.
        acceptance: returns the probability of each to be kept.
        count: number of proposals to return.
        rng: source of randomness.
    """
    kept = propose(0)
    rate = 0.5
    while len(kept) < count:
        proposals = propose(int((count - len(kept)) / rate * 1.1) + 16)
        good = proposals[rng.random(len(proposals)) < acceptance(proposals)]
        rate = max(len(good) / len(proposals), 0.01)
        kept = np.concatenate([kept, good])
    return kept[:count]


def normalized(vectors: Floats) -> Floats:
    """Scale vectors (N, 3) to length one."""
    return vectors / np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]  # much faster than linalg.norm


def revolve(
    rho: Floats, z: Floats, outward: Floats, upward: Floats, radius: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Make a surface of revolution from points (rho, z) of a profile, each turned by a random angle around z.

    The points are moved by `radius` along their normals (outward, upward) first.
    """
    angle = rng.uniform(0, 2 * np.pi, len(rho))
    cos, sin = np.cos(angle), np.sin(angle)
    normals = np.stack([outward * cos, outward * sin, upward], axis=1)
    return np.stack([rho * cos, rho * sin, z], axis=1) + radius * normals, normals


def arc_angles(center: float, radius: float, reach: float, count: int, rng: np.random.Generator) -> Floats:
    """Draw angles in [-reach, reach] on a circle around rho = `center`, uniform by area once revolved."""
    return rejected(
        lambda n: rng.uniform(-reach, reach, n),
        lambda tilt: (center + radius * np.cos(tilt)) / (center + radius),
        count,
        rng,
    )


def distance_to_corner(offsets: Floats) -> Floats:
    """Compute the signed distance (N,) from offsets (N, D) to the corner region where all of them are negative."""
    outside = np.maximum(offsets, 0)
    largest = reduce(np.maximum, offsets.T)  # much faster than max(axis=1)
    return np.sqrt(np.einsum("ij,ij->i", outside, outside)) + np.minimum(largest, 0)
