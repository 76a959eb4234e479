"""What happens to a cloud between the scanner and the file: outliers, thinning, rounding, near-duplicates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jetnormal.data.scanners.scan import Scan, log_uniform, merged
from jetnormal.geometry.vectors import unit

OUTLIERS_SHARE = 0.15  # of the clouds; likewise below
DUPLICATES_SHARE = 0.12
ROUNDED_SHARE = 0.10
THINNED_SHARE = 0.15


def handled(scan: Scan, rng: np.random.Generator) -> Scan:
    """Do to a cloud what happens between the scanner and the file."""
    if rng.random() < OUTLIERS_SHARE:
        scan = _with_outliers(scan, rng)
    if rng.random() < THINNED_SHARE:
        scan = _thinned(scan, rng)
    if rng.random() < ROUNDED_SHARE:
        step = log_uniform(rng, 1e-3, 0.7) * _spacing(scan)
        scan = replace(scan, points=step * np.round(scan.points / step))
    if rng.random() < DUPLICATES_SHARE:
        scan = _with_duplicates(scan, rng)
    return scan


def _with_outliers(scan: Scan, rng: np.random.Generator) -> Scan:
    """Some points far off the surface: along their rays, or anywhere."""
    count = round(len(scan) * log_uniform(rng, 5e-4, 0.05))
    rows = rng.choice(len(scan), count, replace=False)
    points, labeled = scan.points.copy(), scan.labeled.copy()
    offset = log_uniform(rng, 0.005, 0.3) * rng.standard_normal((count, 1))
    along = rng.random(count)[:, None] < 0.7
    anywhere = rng.uniform(points.min(0), points.max(0), (count, 3))
    points[rows] = np.where(along, points[rows] + offset * unit(scan.sensors[rows] - points[rows]), anywhere)
    labeled[rows] = False
    return replace(scan, points=points, labeled=labeled)


def _thinned(scan: Scan, rng: np.random.Generator) -> Scan:
    """A random part of the points, or the first one of each voxel."""
    if rng.random() < 0.5:
        return scan.take(np.flatnonzero(rng.random(len(scan)) < rng.uniform(0.3, 0.9)))
    voxel = _spacing(scan) * rng.uniform(0.7, 2.5)
    cells = np.floor(scan.points / voxel).astype(np.int64)
    keys = cells @ np.array([1, 1 << 20, 1 << 40])
    return scan.take(np.sort(np.unique(keys, return_index=True)[1]))


def _with_duplicates(scan: Scan, rng: np.random.Generator) -> Scan:
    """A share of the points twice, the copy shifted by next to nothing, as when a cloud is merged with its copy."""
    rows = np.flatnonzero(rng.random(len(scan)) < rng.uniform(0.05, 1.0) / 2)
    copies = scan.take(rows)
    shift = log_uniform(rng, 1e-8, 0.03) * _spacing(scan)
    return merged([scan, replace(copies, points=copies.points + shift * rng.standard_normal(copies.points.shape))])


def _spacing(scan: Scan) -> float:
    """The side of the square that each point has if they share the surface of their bounding box evenly, halved."""
    x, y, z = np.ptp(scan.points, axis=0)
    return float(np.sqrt((x * y + y * z + z * x) / len(scan)))
