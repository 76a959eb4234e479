"""Rasters of rays and what a scanner reads along them.

A raster has a frame: an eye and axes (3, 3) whose rows point right, up and forward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.scanners.beam import Camera, seen_stripe
from jetnormal.data.scanners.range_errors import RangeErrors
from jetnormal.data.scanners.scan import Scan
from jetnormal.data.scanners.targets import Floats, Target
from jetnormal.geometry.vectors import unit


class Raster(Protocol):
    """Turn columns u and rows v into rays."""

    def rays(self, u: Floats, v: Floats, /) -> tuple[Floats, Floats]:
        """Return origins and unit directions, (N, 3) each, of the rays at u (N,) and v (N,)."""
        ...

    def coordinates(self, points: Floats, /) -> Floats:
        """Return the (u, v), (N, 2), of the rays that pass through points (N, 3)."""
        ...


@dataclass(frozen=True)
class Pinhole:
    """An even grid on the image plane of a camera."""

    eye: Floats
    axes: Floats

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """See `Raster.rays`."""
        directions = unit(np.stack([u, v, np.ones_like(u)], axis=1) @ self.axes)
        return np.broadcast_to(self.eye, directions.shape), directions

    def coordinates(self, points: Floats) -> Floats:
        """See `Raster.coordinates`."""
        x, y, z = ((points - self.eye) @ self.axes.T).T
        return np.stack([x / z, y / z], axis=1)


@dataclass(frozen=True)
class Spherical:
    """An even grid of azimuths u, from forward to the right, and elevations v."""

    eye: Floats
    axes: Floats

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """See `Raster.rays`."""
        directions = np.stack([np.sin(u) * np.cos(v), np.sin(v), np.cos(u) * np.cos(v)], axis=1) @ self.axes
        return np.broadcast_to(self.eye, directions.shape), directions

    def coordinates(self, points: Floats) -> Floats:
        """See `Raster.coordinates`."""
        x, y, z = ((points - self.eye) @ self.axes.T).T
        return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=1)


@dataclass(frozen=True)
class Sweep:
    """A fan of rays in a plane across the axis "up", along which the sensor moves; v is the way that it went.

    The columns u are lengths across, at the distance of the origin.
    """

    eye: Floats
    axes: Floats

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """See `Raster.rays`."""
        slope = u / np.linalg.norm(self.eye)
        directions = unit(np.stack([slope, np.zeros_like(u), np.ones_like(u)], axis=1) @ self.axes)
        return self.eye + v[:, None] * self.axes[1], directions

    def coordinates(self, points: Floats) -> Floats:
        """See `Raster.coordinates`."""
        x, y, z = ((points - self.eye) @ self.axes.T).T
        return np.stack([x / z * np.linalg.norm(self.eye), y], axis=1)


@dataclass(frozen=True)
class Profile:
    """A fan of rays that turns in a plane across the axis "up", along which the sensor moves; v is the way it went.

    The columns u are lengths of arc at the distance `reach`, from forward to the right; "lean" tilts the plane forward.
    """

    eye: Floats
    axes: Floats
    reach: float
    lean: float = 0.0

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """See `Raster.rays`."""
        angle = u / self.reach
        directions = unit(np.stack([np.sin(angle), np.full_like(u, self.lean), np.cos(angle)], axis=1) @ self.axes)
        return self.eye + v[:, None] * self.axes[1], directions

    def coordinates(self, points: Floats) -> Floats:
        """See `Raster.coordinates`."""
        x, y, z = ((points - self.eye) @ self.axes.T).T
        return np.stack([self.reach * np.arctan2(x, z), y - self.lean * np.hypot(x, z)], axis=1)


@dataclass(frozen=True)
class Window:
    """The part of a raster that is scanned: (u, v) of its corners."""

    low: Floats
    high: Floats


def window_of(target: Target, raster: Raster, closeness: float, rng: np.random.Generator) -> Window:
    """Find the window that shows the whole target, or, with a closeness above 1, a part of it around a random point."""
    places = raster.coordinates(target.sample(1000, rng)[0])
    low, high = places.min(0), places.max(0)
    margin = 0.02 * (high - low)
    if closeness <= 1:
        return Window(low - margin, high + margin)
    half = (high - low) / (2 * closeness)
    middle = np.clip(places[0], low + half, high - half)
    return Window(middle - half, middle + half)


@dataclass(frozen=True)
class Sampling:
    """How a window is filled.

    Attributes:
        count: number of points to come back, about.
        spacing: distance of the rows over that of the columns.
        shake: standard deviation of the rays' angles, in spacings.
        uneven: likewise of the rows'.
    """

    count: int
    spacing: float
    shake: float = 0.0
    uneven: float = 0.0


def read_raster(
    kind: str, target: Target, raster: Raster, window: Window, sampling: Sampling, errors: RangeErrors,
    rng: np.random.Generator, camera: Camera | None = None,
) -> Scan:  # fmt: skip
    """Scan the window of a raster; with a camera, only what it sees, by a stripe of light as wide as `errors` says."""
    shape = _grid_shape(target, raster, window, sampling)
    pitch = (window.high - window.low) / [shape[1], shape[0]]
    v, u = ((np.arange(size) + 0.5) * pitch[axis] + window.low[axis] for size, axis in zip(shape, (1, 0), strict=True))
    v = v + sampling.uneven * pitch[1] * rng.standard_normal(shape[0])
    grid_u, grid_v = np.meshgrid(u, v)
    grid_u = grid_u + sampling.shake * pitch[0] * rng.standard_normal(shape)
    grid_v = grid_v + sampling.shake * pitch[1] / max(1.0, sampling.spacing) * rng.standard_normal(shape)
    origins, directions = raster.rays(grid_u.reshape(-1), grid_v.reshape(-1))
    hits = target.cast(origins, directions)
    bare = np.all(hits.normals == 0, axis=1)  # leaves, which have no normal to speak of
    normals = np.where(bare[:, None], -directions, hits.normals)
    cosine = np.abs((normals * directions).sum(1))
    distance = hits.distance.reshape(shape)
    if camera is not None:
        distance = np.where(_seen(target, origins, directions, distance, camera), distance, np.inf)
    gaps = _gaps(origins.reshape(*shape, 3), directions.reshape(*shape, 3), distance)
    if camera is not None and errors.beam > 0:
        gap = gaps[camera.axis]
        width = errors.beam * float(gaps[1].mean() / max(float(gap.mean()), 1e-12))
        stripe = seen_stripe(distance, normals.reshape(*shape, 3), cosine.reshape(shape), gap, width, camera)
        distance, normals = stripe.distance, stripe.normals.reshape(-1, 3)
    readings = errors.read(distance, cosine.reshape(shape), gaps, rng)
    kept = np.flatnonzero(readings.returned)
    points = origins[kept] + readings.distance.reshape(-1, 1)[kept] * directions[kept]
    labeled = readings.labeled.reshape(-1) & ~bare
    return Scan(kind, points, normals[kept], origins[kept], labeled[kept])


def _seen(target: Target, origins: Floats, directions: Floats, distance: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Which places that rays (N, 3) reach at distances (rows, columns) nothing hides from the camera."""
    seen = np.isfinite(distance)
    hit = np.flatnonzero(seen)
    places = origins[hit] + distance.reshape(-1, 1)[hit] * directions[hit]
    seen.reshape(-1)[hit] = target.visible(places, origins[hit] + camera.offset)
    return seen


def _gaps(origins: Floats, directions: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """How far each ray (rows, columns) is from the next of its column, and of its row, at the distance it reaches."""
    reach = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    gaps = []
    for axis in (0, 1):
        move, turn = (_steps(array, axis) for array in (origins, directions))
        gaps.append(np.linalg.norm(move + reach * turn, axis=-1))
    return gaps[0], gaps[1]


def _steps(array: Floats, axis: int) -> Floats:
    """From each entry to the next along an axis; the last is like the one before."""
    steps = np.diff(array, axis=axis)
    return np.concatenate([steps, np.take(steps, [-1], axis)], axis)


def _grid_shape(target: Target, raster: Raster, window: Window, sampling: Sampling) -> tuple[int, int]:
    """Rows and columns of which about `count` meet the target."""
    coarse = (np.arange(40) + 0.5) / 40
    u, v = np.meshgrid(*(window.low[:, None] + coarse * (window.high - window.low)[:, None]))
    met = np.isfinite(target.cast(*raster.rays(u.reshape(-1), v.reshape(-1))).distance).mean()
    cells = sampling.count / max(float(met), 0.1)  # at most ten rays a point
    width, height = window.high - window.low
    rows = max(2, round(np.sqrt(cells * height / (width * sampling.spacing))))
    return rows, max(2, round(cells / rows))
