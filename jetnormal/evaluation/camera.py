"""Views of a cloud for heatmaps. Each pixel knows the point that it shows, so one view serves for many colorings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex

WIDTH, HEIGHT = 420, 380  # pixels of a picture
OVERSAMPLING = 2  # rendered that much larger and averaged, against jagged edges
MARGIN = 0.06  # of the picture, on each side
ELEVATIONS = (20.0, 40.0)  # degrees over the horizon, and
AZIMUTHS = 24  # directions around the shape, from which the camera may look
DISK = 1.6  # radius of a point's disk over the distance to its fourth neighbor
CHUNK_PIXELS = 1_000_000  # drawn at a time: about 50 MB
TRIAL_POINTS = 5000  # by which views are compared,
TRIAL_CELLS = 40  # on a grid of so many cells


class Camera:
    """An orthographic view of a shape from a side that shows much of it; y is up, as in PCPNet.

    Attributes:
        axes: (3, 3) rows: right, up and towards the camera.
    """

    def __init__(self, points: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
        """Choose the view for points (N, 3) with normals (N, 3), which then fill the picture."""
        step = max(1, len(points) // TRIAL_POINTS)
        turns = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
        views = [_axes(azimuth, np.radians(elevation)) for elevation in ELEVATIONS for azimuth in turns]
        self.axes = max(views, key=lambda axes: _interest(points[::step] @ axes.T, normals[::step]))
        seen = points @ self.axes.T
        self._middle = (seen.min(axis=0) + seen.max(axis=0))[:2] / 2
        self._size = OVERSAMPLING * np.array([WIDTH, HEIGHT])
        self._scale = (1 - 2 * MARGIN) * float((self._size / _span(seen)).min())
        self._radius = max(1, round(DISK * _spacing(points) * self._scale))

    def render(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """Find the point (N, 3) seen in each pixel, or -1: every point is a disk, and the nearest one wins."""
        seen = points @ self.axes.T
        far_to_near = np.argsort(seen[:, 2], kind="stable")
        places = (seen[far_to_near, :2] - self._middle) * self._scale * [1, -1] + self._size / 2
        centers = np.floor(places).astype(np.int64)
        disk = np.stack(np.meshgrid(*[np.arange(-self._radius, self._radius + 1)] * 2), axis=-1).reshape(-1, 2)
        disk = disk[(disk**2).sum(axis=1) <= self._radius**2]
        index = np.full(self._size[::-1], -1)
        step = max(1, CHUNK_PIXELS // len(disk))
        for start in range(0, len(points), step):
            covered = centers[start : start + step, None] + disk
            inside = ((covered >= 0) & (covered < self._size)).all(axis=2)
            column, row = covered[inside].T
            index[row, column] = np.repeat(far_to_near[start : start + step], inside.sum(axis=1))  # the last one stays
        return index


def paint(index: NDArray[np.int64], colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give each pixel the color (N, 3) of its point, white without one, and average the oversampled pixels."""
    image = np.where(index[..., None] >= 0, colors[index], 1.0)
    height, width = (length // OVERSAMPLING for length in index.shape)
    return image.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3).mean(axis=(1, 3))


def _axes(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Return the axes right, up and towards the camera as rows; angles are in radians, azimuth 0 looks along -z."""
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    level = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
    towards = np.cos(elevation) * level + np.array([0.0, np.sin(elevation), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _interest(seen: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """How much a view shows: entropy of the directions that the visible surface faces, times its size in the picture.

    Args:
        seen: (N, 3) points in the camera's axes.
        normals: (N, 3) in any axes.
    """
    span = _span(seen)
    cell = ((seen[:, :2] - seen[:, :2].min(axis=0)) / span.max() * TRIAL_CELLS).astype(int) @ [TRIAL_CELLS + 1, 1]
    order = np.lexsort((-seen[:, 2], cell))
    front = order[np.r_[True, np.diff(cell[order]) > 0]]
    facing = np.round(1.2 * normals[front]).astype(int) @ [9, 3, 1]  # 26 directions
    share = np.unique(facing, return_counts=True)[1] / len(front)
    entropy = -(share * np.log(share)).sum()
    size = np.sqrt(len(front)) / TRIAL_CELLS * span.max() * min(WIDTH / span[0], HEIGHT / span[1])
    return float(entropy * size)


def _span(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Measure the width and height (2,) of points (N, 3) along the camera's axes; never zero."""
    return np.maximum(np.ptp(seen[:, :2], axis=0), 1e-9 * max(1e-300, float(np.abs(seen).max())))


def _spacing(points: NDArray[np.float64]) -> float:
    """Measure the median distance to the fourth neighbor, on a sample."""
    sample = points[:: max(1, len(points) // 2000)]
    return float(np.median(NeighborIndex(points).query(sample, min(5, len(points)))[1][:, -1]))
