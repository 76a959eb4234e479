"""Where a picture is taken from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import UsageError

Floats = NDArray[np.float64]

VIEWS = {
    "iso": (1.0, -1.4, 0.9),
    "front": (0.0, -1.0, 0.0),
    "back": (0.0, 1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
}
"""Directions from the object to the camera, where z is up."""
ONE_SIDED = 0.35  # length of the mean normal from which on a surface is seen from one side only
FIELD_OF_VIEW = np.deg2rad(28)
MARGIN = 0.05  # of the picture, on each side
OUTLIERS = 0.05  # percent of the points that may fall outside the picture, on each side
FRONTS = 0.8  # share of outer sides with which the usual view is good enough
ELEVATIONS = (20.0, 40.0)  # degrees over the horizon, and
AZIMUTHS = 24  # directions around the object, from which the most interesting view is chosen
TRIAL_POINTS = 5000  # by which views are compared,
TRIAL_CELLS = 40  # on a grid of so many cells at most,
CROWD = 8  # with so many points each on average
FLATTEST, SLIMMEST = 0.5, 2.0  # height over width of a picture


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in front of the origin.

    Its frame has x to the right, y up and z towards the camera, and its origin at that of the scene.

    Attributes:
        axes: (3, 3), the frame's axes in rows.
        distance: from the origin.
        scale: pixels per unit at distance 1 from the camera.
        corner: (2,) pixel coordinates, right and down, of the point straight ahead.
        width, height: in pixels.
    """

    axes: Floats
    distance: float
    scale: float
    corner: Floats
    width: int
    height: int

    def to_frame(self, vectors: Floats) -> Floats:
        """Turn points or directions of the scene, (N, 3), into the camera's frame."""
        return vectors @ self.axes.T

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Find pixel coordinates (N, 2), right and down, and depths (N,) of points (N, 3) in the camera's frame."""
        depth = self.distance - points[:, 2]
        return self.corner + self.scale * points[:, :2] * [1, -1] / depth[:, None], depth

    def rays(self) -> Floats:
        """Return (H, W, 3) directions through the middles of the pixels, in its frame, with a depth of 1."""
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        x, y = (column - self.corner[0]) / self.scale, (self.corner[1] - row) / self.scale
        return np.stack([x, y, np.full_like(x, -1.0)], axis=-1)


def make_camera(points: Floats, towards: Floats, size: int) -> Camera:
    """Make the camera in a direction that has all points but outliers in its picture.

    Args:
        points: (N, 3), of the scene.
        towards: (3,) from the origin to the camera.
        size: pixels of the picture's longer side.
    """
    axes = camera_axes(towards)
    frame = points @ axes.T
    radius = max(float(np.percentile(np.linalg.norm(frame, axis=1), 100 - OUTLIERS)), 1e-12)
    distance = radius / np.sin(FIELD_OF_VIEW / 2)
    flat = frame[:, :2] / np.maximum(distance - frame[:, 2:], 0.05 * distance)
    low, high = np.percentile(flat, [OUTLIERS, 100 - OUTLIERS], axis=0)
    extent = np.maximum(high - low, 1e-6)
    ratio = float(np.clip(extent[1] / extent[0], FLATTEST, SLIMMEST))
    width, height = round(min(size, size / ratio)), round(min(size, size * ratio))
    scale = float(((1 - 2 * MARGIN) * np.array([width, height]) / extent).min())
    middle = (low + high) / 2
    corner = np.array([width / 2 - scale * middle[0], height / 2 + scale * middle[1]])
    return Camera(axes, distance, scale, corner, width, height)


def check_view(view: str) -> None:
    """Refuse what `view_direction` does not know.

    Raises:
        UsageError: there is no such view.
    """
    if view != "auto" and view not in VIEWS:
        _angles(view)


def _angles(view: str) -> tuple[float, float]:
    """Azimuth and elevation, in radians, of a text such as "30:20"."""
    try:
        azimuth, elevation = (np.deg2rad(float(part)) for part in view.split(":"))
        if np.isfinite([azimuth, elevation]).all():
            return float(azimuth), float(elevation)
    except ValueError:
        pass
    names = ", ".join(["auto", *VIEWS])
    raise UsageError(f"{view!r} is no view; choose from {names}, or AZIMUTH:ELEVATION in degrees")


def view_direction(view: str, points: Floats, normals: Floats) -> Floats:
    """Find the direction (3,) from the object to the camera.

    Args:
        view: a name in `VIEWS`; AZIMUTH:ELEVATION in degrees, 0:0 being the front and 90:0 the right; or "auto":
            what was scanned from one side is seen from there, everything else from where it shows its outer sides.
        points: (N, 3) of the scene.
        normals: (N, 3) of the scene, zero where unknown.

    Raises:
        UsageError: there is no such view.
    """
    if view in VIEWS:
        return np.array(VIEWS[view])
    if view == "auto":
        mean = normals[normals.any(axis=1)].mean(axis=0) if normals.any() else np.zeros(3)
        if np.linalg.norm(mean) < ONE_SIDED:
            return _outer_side(points, normals)
        right, up, towards = camera_axes(mean)
        return towards + 0.35 * right + 0.30 * up
    azimuth, elevation = _angles(view)
    around = np.array([np.sin(azimuth), -np.cos(azimuth), 0])
    return np.cos(elevation) * around + np.sin(elevation) * np.array([0, 0, 1.0])


def camera_axes(towards: Floats) -> Floats:
    """Return right, up and towards the camera, in rows (3, 3).

    Up is z. Seen along z it is y where the camera looks down, as on a map, and -y where it looks up: that is the
    frame of depth cameras, whose y points down and whose z points ahead.
    """
    towards = towards / np.linalg.norm(towards)
    up = np.array([0.0, 0.0, 1.0])
    if abs(towards[2]) > 0.85:
        up = np.array([0.0, np.sign(towards[2]), 0.0])
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _outer_side(points: Floats, normals: Floats) -> Floats:
    """The direction as in "iso" if that shows outer sides; else the one of a few that shows most of them."""
    step = max(1, len(points) // TRIAL_POINTS)
    x, y, z = VIEWS["iso"]
    directions = [np.array(one) for one in ((x, y, z), (-x, y, z), (x, -y, z), (-x, -y, z), (x, y, -z), VIEWS["top"])]
    shares = [_share_of_fronts(points[::step], normals[::step], towards) for towards in directions]
    return directions[0] if shares[0] > FRONTS else directions[int(np.argmax(shares))]


def _share_of_fronts(points: Floats, normals: Floats, towards: Floats) -> float:
    """Of the points that are seen first, the share whose normal looks to the camera."""
    axes = camera_axes(towards)
    cells = min(TRIAL_CELLS, int(np.sqrt(len(points) / CROWD)) + 1)  # so many points hide what is behind them
    front = _foremost(points @ axes.T, cells)
    return float((normals[front] @ axes[2] >= 0).mean())


def interesting_direction(points: Floats, normals: Floats) -> Floats:
    """Find the direction (3,) from the object to the camera in which most is to be seen.

    That is where the visible surface faces many directions (by entropy) and fills the picture.

    Args:
        points: (N, 3), of the scene.
        normals: (N, 3) of the scene.
    """
    step = max(1, len(points) // TRIAL_POINTS)
    directions = []
    for elevation in np.deg2rad(ELEVATIONS):
        for turn in np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS:
            around = np.array([np.sin(turn), -np.cos(turn), 0])
            directions.append(np.cos(elevation) * around + np.sin(elevation) * np.array([0, 0, 1.0]))
    return max(directions, key=lambda towards: _interest(points[::step] @ camera_axes(towards).T, normals[::step]))


def _interest(seen: Floats, normals: Floats) -> float:
    """How much a view shows of points (N, 3) in the camera's axes, whose normals (N, 3) may be in any."""
    front = _foremost(seen, TRIAL_CELLS)
    facing = np.round(1.2 * normals[front]).astype(int) @ [9, 3, 1]  # 26 directions
    share = np.unique(facing, return_counts=True)[1] / len(front)
    entropy = -(share * np.log(share)).sum()
    filled = np.sqrt(len(front)) / TRIAL_CELLS
    return float(entropy * filled)


def _foremost(seen: Floats, cells: int) -> NDArray[np.int64]:
    """The points that are in front on a grid of so many cells a side, of points (N, 3) in the camera's axes."""
    span = np.maximum(np.ptp(seen[:, :2], axis=0), 1e-9 * max(1e-300, float(np.abs(seen).max())))
    cell = ((seen[:, :2] - seen[:, :2].min(axis=0)) / span.max() * cells).astype(int) @ [cells + 1, 1]
    order = np.lexsort((-seen[:, 2], cell))
    return order[np.r_[True, np.diff(cell[order]) > 0]]
