"""Scanners of objects, which stand around them and look from outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jetnormal.data.scanners.beam import Camera
from jetnormal.data.scanners.devices import camera_errors, lidar_errors, station_errors, stripe_errors
from jetnormal.data.scanners.range_errors import RandomField, RangeErrors
from jetnormal.data.scanners.rasters import Pinhole, Sampling, Spherical, Sweep, read_raster, window_of
from jetnormal.data.scanners.scan import Scan, axes_along, log_uniform, merged, registration_errors
from jetnormal.data.scanners.targets import Floats, Target
from jetnormal.geometry.vectors import unit

STEEPEST_VIEW = 3.0  # one over the tangent of the angle between light and camera, at which edges curl most


def _stripe(target: Target, count: int, rng: np.random.Generator, errors: RangeErrors | None = None) -> Scan:
    """A laser line that sweeps over the target, seen by a camera beside the laser or in front of it."""
    distance = log_uniform(rng, 0.7, 3.0)
    eye, axes = pose(rng, distance)
    raster = Sweep(eye, axes) if rng.random() < 0.6 else Pinhole(eye, axes)
    sampling = Sampling(count, log_uniform(rng, 0.4, 10.0), rng.uniform(0, 0.1), rng.uniform(0, 0.3) ** 2)
    chosen = errors or stripe_errors(rng, distance, log_uniform(rng, 5e-5, 5e-3))
    # What the camera does not see, the laser lights in vain.
    baseline, beside = rng.uniform(0.1, 0.6) * rng.choice([-1, 1]), rng.integers(2)
    slope = float(np.clip(1 / baseline, -STEEPEST_VIEW, STEEPEST_VIEW))
    camera = Camera(distance * baseline * axes[beside], 1 - int(beside), chosen.curl * slope)
    window = window_of(target, raster, _closeness(rng), rng)
    return read_raster("stripe", target, raster, window, sampling, chosen, rng, camera)


def _depth(target: Target, count: int, rng: np.random.Generator, errors: RangeErrors | None = None) -> Scan:
    """One frame of a depth camera."""
    distance = log_uniform(rng, 0.6, 4.0)
    raster = Pinhole(*pose(rng, distance))
    sampling = Sampling(count, rng.uniform(0.8, 1.25))
    window = window_of(target, raster, _closeness(rng), rng)
    chosen = errors or camera_errors(rng, distance, log_uniform(rng, 1e-4, 6e-3))
    return read_raster("depth", target, raster, window, sampling, chosen, rng)


def _lidar(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """A multi-beam lidar that passes by, or goes around: lines far apart, the same beams at each place."""
    places = int(rng.integers(1, 9))
    far = log_uniform(rng, 0.7, 5.0)
    up = unit(rng.normal(size=3))
    start, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1]) * rng.uniform(0.05, 2 * np.pi / max(places, 2))
    height, tilt = rng.uniform(-0.3, 0.8), rng.choice([0.0, rng.uniform(0, 0.6)])
    sampling = Sampling(
        max(1, count // places), log_uniform(rng, 1.5, 16.0), rng.uniform(0, 0.15), rng.uniform(0, 0.5) ** 2
    )
    errors, registration = lidar_errors(rng, far, log_uniform(rng, 5e-5, 4e-3)), registration_errors(rng, 1e-5, 3e-3)
    views = []
    for place in range(places):
        distance = far * rng.uniform(0.8, 1.25)
        raster = Spherical(*_upright(up, start + place * turn, distance, height, tilt, rng))
        window = window_of(target, raster, 1.0, rng)
        views.append(registration(read_raster("lidar", target, raster, window, sampling, errors, rng), rng))
    return merged(views)


def _station(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Terrestrial scanners around the target, near and far."""
    places = int(rng.integers(1, 6))
    up = unit(rng.normal(size=3))
    angles = rng.uniform(0, 2 * np.pi) + np.arange(places) * 2 * np.pi / places + rng.normal(scale=0.4, size=places)
    sigma, registration = log_uniform(rng, 2e-5, 3e-3), registration_errors(rng, 1e-5, 3e-3)
    sampling = Sampling(max(1, count // places), log_uniform(rng, 0.5, 2.0), rng.uniform(0, 0.2))
    views = []
    for angle in angles:
        distance = log_uniform(rng, 0.56, 4.0)
        errors = station_errors(rng, 1.0, sigma)
        raster = Spherical(*_upright(up, angle, distance, rng.uniform(-0.3, 0.5), 0.0, rng))
        view = read_raster("station", target, raster, window_of(target, raster, 1.0, rng), sampling, errors, rng)
        views.append(registration(view, rng))
    return merged(views)


def _fused(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Views of one device from all sides, put together with errors of the registration."""
    places = round(log_uniform(rng, 3, 25))
    single, errors = (_stripe, stripe_errors) if rng.random() < 0.6 else (_depth, camera_errors)
    device = errors(rng, 1.5, log_uniform(rng, 5e-5, 4e-3))
    registration = registration_errors(rng, 1e-5, 6e-3)
    views = [registration(single(target, max(1, count // places), rng, device), rng) for _ in range(places)]
    return replace(merged(views), kind="fused")


def _photogrammetry(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Photographs from around the target."""
    return photographed(target, log_uniform(rng, 0.8, 3.0) * _directions(int(rng.integers(4, 40)), rng), count, rng)


def photographed(target: Target, eyes: Floats, count: int, rng: np.random.Generator) -> Scan:
    """Points that cameras at `eyes`, (K, 3), see in pairs: dense on texture, with the bumps that smoothing leaves."""
    steepest, contrast, bare = rng.uniform(0.05, 0.4), rng.uniform(0, 2), rng.uniform(-3, -1)
    texture = RandomField(log_uniform(rng, 0.05, 0.6), rng)
    parts: list[Scan] = []
    found = 0
    while found < count and len(parts) < 6:
        points, normals = target.sample(2 * count, rng)
        strength = texture(points)
        textured = (rng.random(len(points)) < np.exp(contrast * (strength - 1))) & (strength > bare)
        parts.append(_matched(target, points[textured], normals[textured], eyes, steepest, rng))
        found += len(parts[-1])
    clean = merged(parts)
    clean = clean if found <= count else clean.take(np.arange(count))
    return replace(clean, points=_bumpy(clean, rng))


def _matched(
    target: Target, points: Floats, normals: Floats, eyes: Floats, steepest: float, rng: np.random.Generator
) -> Scan:
    """Those of the points (N, 3) that two random eyes see from the same side, less steeply than by a cosine."""
    pair = [eyes[rng.integers(len(eyes), size=len(points))] for _ in range(2)]
    first, second = ((unit(eye - points) * normals).sum(1) for eye in pair)
    facing = np.flatnonzero((np.minimum(np.abs(first), np.abs(second)) > steepest) & (first * second > 0))
    for eye in pair:
        facing = facing[target.visible(points[facing], eye[facing])]
    toward = normals[facing] * np.sign(first[facing])[:, None]
    return Scan("photogrammetry", points[facing], toward, pair[0][facing], np.ones(len(facing), dtype=bool))


def _bumpy(clean: Scan, rng: np.random.Generator) -> Floats:
    """The points with errors that are smooth over the surface, and independent ones, larger along the line of sight."""
    bumps = np.zeros(len(clean))
    for _ in range(rng.integers(1, 4)):
        wavelength = log_uniform(rng, 0.01, 0.3)
        bumps += RandomField(wavelength, rng)(clean.points) * wavelength * log_uniform(rng, 1e-3, 2e-2)
    white = log_uniform(rng, 1e-4, 6e-3)
    across = white * rng.uniform(0.2, 1.0) * rng.standard_normal((len(clean), 3))
    along = white * rng.standard_normal((len(clean), 1)) * unit(clean.sensors - clean.points)
    return clean.points + bumps[:, None] * clean.normals + across + along


OBJECT_SCANNERS: dict[str, Callable[[Target, int, np.random.Generator], Scan]] = {
    "stripe": _stripe,
    "depth": _depth,
    "lidar": _lidar,
    "station": _station,
    "fused": _fused,
    "photogrammetry": _photogrammetry,
}


def _closeness(rng: np.random.Generator) -> float:
    """How much of the target a view shows: all of it, or a window of up to a fifth of its width."""
    return 1.0 if rng.random() < 0.6 else log_uniform(rng, 1.0, 5.0)


def pose(rng: np.random.Generator, distance: float) -> tuple[Floats, Floats]:
    """Return an eye at a distance from the origin in any direction, and axes (right, up, forward) of any roll."""
    eye = distance * unit(rng.normal(size=3))
    return eye, axes_along(-eye + rng.normal(scale=0.03, size=3), rng.normal(size=3))


def _upright(
    up: Floats, angle: float, distance: float, height: float, tilt: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """An eye at an angle around the axis "up" and a height over the middle; its axes stand upright but for a tilt."""
    right, ahead, _ = axes_along(up, np.array([0.3, 0.5, 0.8]))
    eye = distance * unit(np.cos(angle) * right + np.sin(angle) * ahead + height * up)
    level = -eye + (eye @ up) * up
    return eye, axes_along(level, up + tilt * unit(rng.normal(size=3)))


def _directions(count: int, rng: np.random.Generator) -> Floats:
    """Random unit vectors, (count, 3), over the sphere or in a cap of it."""
    directions = unit(rng.normal(size=(count, 3)))
    return directions if rng.random() < 0.6 else unit(directions + rng.uniform(1.0, 2.0) * unit(rng.normal(size=3)))
