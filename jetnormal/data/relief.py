"""Fine relief on any surface: meshes are smooth where real objects have scales, chisel marks and carvings.

A network that has only seen smooth surfaces takes fine detail for noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.vectors import unit

Floats = NDArray[np.float64]

WAVES = 24  # plane waves in a relief
SHORTEST, LONGEST = 5.0, 50.0  # wavelengths, in units of the spacing of the points
WIDEST = 8.0  # ratio of the longest to the shortest wavelength of a relief, at most
FLATTEST, STEEPEST = 0.08, 0.7  # root mean square slope
CLEAR = 15.0  # wavelengths are at least this many times the noise, else points of one place would lie on other waves
SAMPLE, NEIGHBORS = 300, 12  # points and their neighbors, from which the noise is told


def add_relief(points: Floats, normals: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Move points along their normals by a random smooth field, and tilt the normals by its slope.

    The field is a sum of plane waves, equally steep at all wavelengths of a band of random width, times a mask that
    varies slowly from 0 to 1, so that smooth and rough regions lie side by side.

    Args:
        points: (N, 3) of a surface, perhaps with noise.
        normals: (N, 3) unit normals of the surface.
        rng: source of randomness.

    Returns:
        The moved points (N, 3) and the unit normals (N, 3) of the surface with the relief; both as they were if the
        noise leaves no room for one.
    """
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    spacing = diagonal / np.sqrt(len(points))
    least = max(SHORTEST * spacing, CLEAR * _noise(points, normals, rng))
    if least > LONGEST * spacing:
        return points, normals
    shortest = least * (LONGEST * spacing / least) ** rng.random()
    lengths = shortest * (WIDEST ** rng.random()) ** rng.random((WAVES, 1))
    waves = _directions(WAVES, rng) * (2 * np.pi / lengths)
    phases = points @ waves.T + rng.uniform(0, 2 * np.pi, WAVES)
    slope = FLATTEST * (STEEPEST / FLATTEST) ** rng.random()
    # A wave of amplitude a has a mean square slope of a^2 |w|^2 / 2, two thirds of which lie along a surface.
    amplitude = slope * np.sqrt(3 / WAVES) / np.linalg.norm(waves, axis=1)
    height, gradient = np.sin(phases) @ amplitude, (np.cos(phases) * amplitude) @ waves
    slow = _directions(1, rng)[0] * (2 * np.pi / (diagonal * rng.uniform(0.2, 1.5)))
    angle = points @ slow + rng.uniform(0, 2 * np.pi)
    mask, mask_gradient = (1 + np.sin(angle)) / 2, np.cos(angle)[:, None] * slow / 2
    gradient = mask[:, None] * gradient + height[:, None] * mask_gradient
    along = gradient - (gradient * normals).sum(axis=1, keepdims=True) * normals
    tilted = normals - along
    return points + (mask * height)[:, None] * normals, unit(tilted)


def _noise(points: Floats, normals: Floats, rng: np.random.Generator) -> float:
    """Standard deviation of the neighbors' heights over the true tangent plane, in the median over some points."""
    from scipy.spatial import cKDTree

    rows = rng.integers(len(points), size=SAMPLE)
    found = cKDTree(points).query(points[rows], min(NEIGHBORS, len(points)))[1]
    heights = np.einsum("ijk,ik->ij", points[found] - points[rows, None], normals[rows])
    return float(np.median(heights.std(axis=1)))


def _directions(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) unit vectors."""
    return unit(rng.normal(size=(count, 3)))
