"""The clouds that virtual scanners make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.vectors import unit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """A cloud as a scanner sees a surface.

    Attributes:
        kind: a key of `FAMILIES`.
        points: (N, 3) float64 as measured.
        normals: (N, 3) float64 unit normals of the clean surface where the ray met it, on the side of the sensor.
        sensors: (N, 3) float64 place of the sensor that saw each point.
        labeled: (N,) bool, False for outliers and for mixed pixels between two surfaces. Their normal is that of
            the surface which the ray met.
    """

    kind: str
    points: Floats
    normals: Floats
    sensors: Floats
    labeled: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Scan:
        """Return the scan of some of the points."""
        return Scan(self.kind, self.points[rows], self.normals[rows], self.sensors[rows], self.labeled[rows])


def merged(views: list[Scan]) -> Scan:
    """Join views of one kind into a scan."""
    arrays = ("points", "normals", "sensors", "labeled")
    joined = {name: np.concatenate([getattr(view, name) for view in views]) for name in arrays}
    return Scan(views[0].kind, **joined)


def registration_errors(
    rng: np.random.Generator, low: float, high: float
) -> Callable[[Scan, np.random.Generator], Scan]:
    """Move a view by an error of a size that the views of a cloud share; none in a quarter of the clouds."""
    size = 0.0 if rng.random() < 0.25 else log_uniform(rng, low, high)
    return partial(_misplaced, size=size)


def _misplaced(view: Scan, rng: np.random.Generator, size: float) -> Scan:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(size * rng.standard_normal(3)).as_matrix().T
    shift = size * rng.standard_normal(3)
    return replace(view, points=view.points @ turn + shift, sensors=view.sensors @ turn + shift)


def axes_along(forward: Floats, up: Floats) -> Floats:
    """Return rows right, up and forward of a frame, (3, 3); up is made perpendicular."""
    forward = unit(forward)
    right = unit(np.cross(up, forward))
    return np.stack([right, np.cross(forward, right), forward])


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform between those of two bounds."""
    return float(low * (high / low) ** rng.random())
