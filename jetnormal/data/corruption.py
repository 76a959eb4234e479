"""Corruption of clean points: noise, uneven density and missing regions.

The levels and the density patterns are those of the PCPNet data set (Guerrero et al., "PCPNet: Learning
Local Shape Properties from Raw Point Clouds", Eurographics 2018).
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.ridges import add_ridges

# Standard deviation of the noise as a fraction of the bounding box's diagonal, as in PCPNet's test set (its
# training set has 1.2e-3 for "low").
NOISE_LEVELS = {"low": 1.25e-3, "medium": 6.0e-3, "high": 1.2e-2}

STRIPES = 10  # along the axis of the bounding box, every other one thinned
STRIPE_DENSITY = 0.05  # of a thinned stripe, relative to its neighbors
GRADIENT_DENSITY = 0.01  # at the sparse end, relative to the dense end

# How often a generated cloud is corrupted in which way.
CORRUPTION_SHARES = {
    "clean": 0.24,
    "low": 0.17,
    "medium": 0.18,
    "high": 0.14,
    "varied": 0.12,
    "gradient": 0.075,
    "striped": 0.075,
}
VARIED_NOISE = (2e-4, 8e-3)  # between PCPNet's levels and below them, which real scans do not keep to
NOISE_JITTER = 1.3  # a noise level is multiplied by a factor between 1/1.3 and 1.3
UNIFORM_NOISE_SHARE = 0.15  # of the noisy clouds; the others are Gaussian
RIDGES_SHARE = 0.10  # of all generated clouds, whatever else happens to them
HOLES_SHARE = 0.10  # likewise
DENSE_FACTOR = 4  # thinned clouds are drawn from this many times as many points


class Surface(Protocol):
    """Something to draw points from: a mesh, a solid or a dense cloud."""

    def sample(self, count: int, rng: np.random.Generator, /) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (count, 3) and outward unit normals (count, 3)."""
        ...


def scan(
    surface: Surface, largest: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], str]:
    """Draw points from a surface, some of them with ridges, and corrupt them as a scanner would.

    Args:
        surface: where the points come from.
        largest: largest number of points; at least half as many are drawn, before holes are cut.
        rng: source of randomness.

    Returns:
        Points (N, 3), the normals (N, 3) of the clean surface below them, ridges included, and the kind of
        corruption, a key of `CORRUPTION_SHARES`.
    """
    kind = str(rng.choice(list(CORRUPTION_SHARES), p=list(CORRUPTION_SHARES.values())))
    count = max(1, round(largest * 0.5 ** rng.random()))  # log-uniform: several densities
    if kind in ("gradient", "striped"):
        pattern: Literal["gradient", "striped"] = "gradient" if kind == "gradient" else "striped"
        points, normals = surface.sample(DENSE_FACTOR * count, rng)
        keep = thin(points, pattern, max(1, len(points) // DENSE_FACTOR), rng)
        points, normals = points[keep], normals[keep]
    else:
        points, normals = surface.sample(count, rng)
    if rng.random() < RIDGES_SHARE:
        points, normals = add_ridges(points, normals, rng)
    level = _noise_level(kind, rng)
    if level:
        uniform = rng.random() < UNIFORM_NOISE_SHARE
        points = add_noise(points, level, rng, "uniform" if uniform else "gaussian")
    if rng.random() < HOLES_SHARE:
        keep = punch_holes(points, rng)
        points, normals = points[keep], normals[keep]
    return points, normals, kind


def _noise_level(kind: str, rng: np.random.Generator) -> float:
    """Standard deviation of the noise of a kind of corruption, as a fraction of the diagonal; 0 for none."""
    if kind == "varied":
        low, high = VARIED_NOISE
        return low * (high / low) ** rng.random()
    if kind in NOISE_LEVELS:
        return NOISE_LEVELS[kind] * NOISE_JITTER ** rng.uniform(-1, 1)
    return 0.0


def add_noise(
    points: NDArray[np.float64],
    sigma_fraction: float,
    rng: np.random.Generator,
    kind: Literal["gaussian", "uniform"] = "gaussian",
) -> NDArray[np.float64]:
    """Displace each coordinate independently.

    Args:
        points: (N, 3) float64.
        sigma_fraction: standard deviation of the displacement as a fraction of the bounding box's diagonal.
        rng: source of randomness.
        kind: distribution of the displacement; both kinds have the same standard deviation.

    Returns:
        (N, 3) float64, a new array.
    """
    sigma = sigma_fraction * np.linalg.norm(np.ptp(points, axis=0))
    if kind == "gaussian":
        return points + rng.normal(scale=sigma, size=points.shape)
    half_width = np.sqrt(3.0) * sigma
    return points + rng.uniform(-half_width, half_width, size=points.shape)


def thin(
    points: NDArray[np.float64], kind: Literal["gradient", "striped"], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Choose `count` of the points, with a density that varies along a random coordinate axis; return indices.

    Args:
        points: (N, 3) float64, of even density. The pattern is pronounced when N is a few times `count`.
        kind: "gradient" falls linearly to a hundredth; "striped" thins every other tenth to a twentieth.
        count: number of points to keep, at most N.
        rng: source of randomness.
    """
    axis = points[:, rng.integers(3)]
    position = (axis - axis.min()) / max(np.ptp(axis), np.finfo(float).tiny)
    if kind == "gradient":
        density = 1.0 - (1.0 - GRADIENT_DENSITY) * position
    else:
        density = np.where(np.floor(position * STRIPES) % 2 == 0, 1.0, STRIPE_DENSITY)
    # The smallest of exponential variables with these rates are a weighted draw without replacement
    # (Efraimidis and Spirakis, "Weighted random sampling with a reservoir", 2006).
    arrival = rng.exponential(size=len(points)) / density
    return np.sort(np.argpartition(arrival, count - 1)[:count])


def punch_holes(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Cut out one to five balls around random points; return the indices of the points that remain.

    The balls' radii are 3 to 10 % of the bounding box's diagonal, as where a scanner saw nothing. At least
    half of the points remain.
    """
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    missing = np.zeros(len(points), dtype=bool)
    for center in points[rng.integers(len(points), size=rng.integers(1, 6))]:
        radius = rng.uniform(0.03, 0.10) * diagonal
        grown = missing | (((points - center) ** 2).sum(1) < radius**2)
        if 2 * grown.sum() <= len(points):
            missing = grown
    return np.flatnonzero(~missing)
