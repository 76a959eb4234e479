"""Ridges on a surface, as screw threads, corrugated sheets, knurls and folds have them.

Ridges are steep and may be as narrow as the noise is thick. A network that has never seen them takes the mean of their
flanks for the normal, which none of the flanks has.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.scanners.scan import log_uniform
from jetnormal.geometry.vectors import unit

Floats = NDArray[np.float64]

NARROWEST, WIDEST = 4.0, 40.0  # wavelengths, in units of the spacing of the points
FLATTEST, STEEPEST = 20.0, 60.0  # degrees of the flanks
ROUNDEST, SHARPEST = 0.7, 0.999  # a sine has 0, a triangle 1
ALIGNED = 0.6  # share of the ridges that run across a coordinate axis, as those of machine parts do
FACING = 0.6  # cosine to the axis of the ridges, above which a surface has none: the ends of a screw
REACH = (0.15, 1.0)  # radius of the part of a cloud that has ridges, of the diagonal


def add_ridges(points: Floats, normals: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Move a part of a surface along its normals by a wave along a random axis, and tilt the normals by its slope.

    The height is asin(s sin x) times an amplitude: the flanks are flat, and the nearer s is to 1, the sharper are the
    edges between them.

    Args:
        points: (N, 3) of a surface, without noise.
        normals: (N, 3) unit normals of the surface.
        rng: source of randomness.

    Returns:
        The moved points (N, 3), and the unit normals (N, 3) of the surface with the ridges; both as they were if all
        points lie in one place.
    """
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not diagonal:
        return points, normals
    axis = np.eye(3)[rng.integers(3)] if rng.random() < ALIGNED else unit(rng.normal(size=3))
    length = log_uniform(rng, NARROWEST, WIDEST) * diagonal / math.sqrt(len(points))
    slope, sharp = math.tan(math.radians(rng.uniform(FLATTEST, STEEPEST))), rng.uniform(ROUNDEST, SHARPEST)
    phase = points @ axis * (2 * np.pi / length) + rng.uniform(0, 2 * np.pi)
    # The steepest place of asin(s sin x) is x = 0, where it rises by s.
    height = slope * length / (2 * np.pi * sharp) * np.arcsin(sharp * np.sin(phase))
    rise = slope * np.cos(phase) / np.sqrt(1 - (sharp * np.sin(phase)) ** 2)
    middle, reach = points[rng.integers(len(points))], rng.uniform(*REACH) * diagonal
    ridged = (np.linalg.norm(points - middle, axis=1) < reach) & (np.abs(normals @ axis) < FACING)
    height, rise = np.where(ridged, height, 0.0)[:, None], np.where(ridged, rise, 0.0)[:, None]
    across = axis - (normals @ axis)[:, None] * normals
    return points + height * normals, unit(normals - rise * across)
