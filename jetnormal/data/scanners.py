"""Virtual scanners: clouds as sensors see a surface, with the true normals and the place of the sensor.

Six families, whose parameters are drawn over the wide ranges that such devices have:

    stripe          a laser line moved over the surface and triangulated by a camera beside it
    depth           a depth camera: structured light (steps of disparity, smooth errors) or time of flight
    lidar           a spinning multi-beam lidar at places along a way: lines far apart
    station         terrestrial scanners: an even grid of angles, dense near the station and sparse far from it
    fused           many views of the first two kinds, each with an error of its registration
    photogrammetry  density by texture, smooth errors of the surface, missing regions

Any cloud may besides have outliers, rounded coordinates, near-duplicates, or have been thinned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.range_errors import RandomField, RangeErrors
from jetnormal.data.targets import Floats, Target

FAMILIES = {"stripe": 0.2, "depth": 0.2, "lidar": 0.2, "station": 0.12, "fused": 0.16, "photogrammetry": 0.12}
SMALLEST = 1 / 8  # a cloud has this share of the largest number of points, or more
LEAST_POINTS = 500  # a view that sees less of the target is drawn again
TRIES = 20

OUTLIERS_SHARE = 0.15  # of the clouds; likewise below
DUPLICATES_SHARE = 0.12
ROUNDED_SHARE = 0.10
THINNED_SHARE = 0.15


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
        """The scan of some of the points."""
        return Scan(self.kind, self.points[rows], self.normals[rows], self.sensors[rows], self.labeled[rows])


def random_scan(target: Target, largest: int, rng: np.random.Generator, kind: str | None = None) -> Scan:
    """Scan a surface by a scanner that is drawn at random.

    Args:
        target: the surface.
        largest: largest number of points; at least about an eighth as many are aimed at, several densities.
        rng: source of randomness.
        kind: a key of `FAMILIES`; None draws one by its share there.

    Raises:
        ValueError: the surface cannot be seen from outside.
    """
    for _ in range(TRIES):
        chosen = kind or str(rng.choice(list(FAMILIES), p=list(FAMILIES.values())))
        count = max(1, round(largest * SMALLEST ** rng.random()))
        scan = _SCANNERS[chosen](target, count, rng)
        if len(scan) >= min(LEAST_POINTS, count / 4):
            scan = _handled(scan, rng)
            scan = scan if len(scan) <= largest else scan.take(np.sort(rng.choice(len(scan), largest, replace=False)))
            return replace(
                scan,
                points=target.center + target.size * scan.points,
                sensors=target.center + target.size * scan.sensors,
            )
    raise ValueError("the scanners saw next to nothing of the surface")


# ---------------------------------------------------------------------------------------------------------------------
# Rasters of rays. Each has a frame: an eye and axes (3, 3) whose rows point right, up and forward.


class Raster(Protocol):
    """Turns columns u and rows v into rays."""

    def rays(self, u: Floats, v: Floats, /) -> tuple[Floats, Floats]:
        """Return origins and unit directions, (N, 3) each, of the rays at u (N,) and v (N,)."""
        ...

    def coordinates(self, points: Floats, /) -> Floats:
        """The (u, v), (N, 2), of the rays that pass through points (N, 3)."""
        ...


@dataclass(frozen=True)
class Pinhole:
    """An even grid on the image plane of a camera."""

    eye: Floats
    axes: Floats

    def rays(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """See `Raster.rays`."""
        directions = _unit(np.stack([u, v, np.ones_like(u)], axis=1) @ self.axes)
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
        directions = _unit(np.stack([slope, np.zeros_like(u), np.ones_like(u)], axis=1) @ self.axes)
        return self.eye + v[:, None] * self.axes[1], directions

    def coordinates(self, points: Floats) -> Floats:
        """See `Raster.coordinates`."""
        x, y, z = ((points - self.eye) @ self.axes.T).T
        return np.stack([x / z * np.linalg.norm(self.eye), y], axis=1)


@dataclass(frozen=True)
class _Window:
    """The part of a raster that is scanned: (u, v) of its corners."""

    low: Floats
    high: Floats


def _window(target: Target, raster: Raster, closeness: float, rng: np.random.Generator) -> _Window:
    """The window that shows the whole target, or, with a closeness above 1, a part of it around a random point."""
    places = raster.coordinates(target.sample(1000, rng)[0])
    low, high = places.min(0), places.max(0)
    margin = 0.02 * (high - low)
    if closeness <= 1:
        return _Window(low - margin, high + margin)
    half = (high - low) / (2 * closeness)
    middle = np.clip(places[0], low + half, high - half)
    return _Window(middle - half, middle + half)


@dataclass(frozen=True)
class _Sampling:
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


def _scan(
    kind: str, target: Target, raster: Raster, window: _Window, sampling: _Sampling, errors: RangeErrors,
    rng: np.random.Generator,
) -> Scan:  # fmt: skip
    """Scan the window of a raster."""
    shape = _grid_shape(target, raster, window, sampling)
    pitch = (window.high - window.low) / [shape[1], shape[0]]
    v, u = ((np.arange(size) + 0.5) * pitch[axis] + window.low[axis] for size, axis in zip(shape, (1, 0), strict=True))
    v = v + sampling.uneven * pitch[1] * rng.standard_normal(shape[0])
    grid_u, grid_v = np.meshgrid(u, v)
    grid_u = grid_u + sampling.shake * pitch[0] * rng.standard_normal(shape)
    grid_v = grid_v + sampling.shake * pitch[1] / max(1.0, sampling.spacing) * rng.standard_normal(shape)
    origins, directions = raster.rays(grid_u.reshape(-1), grid_v.reshape(-1))
    hits = target.cast(origins, directions)
    cosine = np.abs((hits.normals * directions).sum(1))
    distance = hits.distance.reshape(shape)
    gaps = _gaps(origins.reshape(*shape, 3), directions.reshape(*shape, 3), distance)
    readings = errors.read(distance, cosine.reshape(shape), gaps, rng)
    kept = np.flatnonzero(readings.returned)
    points = origins[kept] + readings.distance.reshape(-1, 1)[kept] * directions[kept]
    return Scan(kind, points, hits.normals[kept], origins[kept], readings.labeled.reshape(-1)[kept])


def _gaps(origins: Floats, directions: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """How far each ray (rows, columns) is from the next of its column, and of its row, at the distance it reaches."""
    reach = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    gaps = []
    for axis in (0, 1):
        apart = np.roll(origins, -1, axis) - origins + reach * (np.roll(directions, -1, axis) - directions)
        gaps.append(np.linalg.norm(apart, axis=-1))
    return gaps[0], gaps[1]


def _grid_shape(target: Target, raster: Raster, window: _Window, sampling: _Sampling) -> tuple[int, int]:
    """Rows and columns of which about `count` meet the target."""
    coarse = (np.arange(40) + 0.5) / 40
    u, v = np.meshgrid(*(window.low[:, None] + coarse * (window.high - window.low)[:, None]))
    met = np.isfinite(target.cast(*raster.rays(u.reshape(-1), v.reshape(-1))).distance).mean()
    cells = sampling.count / max(float(met), 0.1)  # at most ten rays a point
    width, height = window.high - window.low
    rows = max(2, round(np.sqrt(cells * height / (width * sampling.spacing))))
    return rows, max(2, round(cells / rows))


# ---------------------------------------------------------------------------------------------------------------------
# The families


def _stripe(target: Target, count: int, rng: np.random.Generator, errors: RangeErrors | None = None) -> Scan:
    """A laser line that sweeps over the target, seen by a camera beside the laser or in front of it."""
    distance = _log_uniform(rng, 0.7, 3.0)
    eye, axes = _pose(rng, distance)
    raster = Sweep(eye, axes) if rng.random() < 0.6 else Pinhole(eye, axes)
    sampling = _Sampling(count, _log_uniform(rng, 0.4, 10.0), rng.uniform(0, 0.1), rng.uniform(0, 0.3) ** 2)
    scan = _scan("stripe", target, raster, _window(target, raster, _closeness(rng), rng), sampling,
                 errors or _stripe_errors(rng, distance), rng)  # fmt: skip
    # What the camera does not see, the laser lights in vain.
    baseline = distance * rng.uniform(0.1, 0.6) * rng.choice([-1, 1])
    across = axes[rng.integers(2)]  # beside the stripe or along the sweep
    return scan.take(_seen(target, scan, scan.sensors + baseline * across))


def _stripe_errors(rng: np.random.Generator, distance: float) -> RangeErrors:
    """Speckle: errors smooth along the line; steps of the camera's pixels."""
    sigma = _log_uniform(rng, 5e-5, 5e-3)
    return RangeErrors(
        distance,
        white=sigma * rng.uniform(0, 1),
        waves=sigma * _log_uniform(rng, 0.3, 2.0),
        wave_rows=rng.choice([0.0, rng.uniform(0.3, 2.0)]),
        wave_columns=_log_uniform(rng, 0.5, 20.0),
        line=sigma * rng.choice([0.0, _log_uniform(rng, 0.05, 0.7)]),
        range_power=2.0,
        grazing_power=rng.uniform(0, 1),
        step=rng.choice([0.0, sigma * _log_uniform(rng, 0.3, 4.0)], p=[0.4, 0.6]),
        disparity=bool(rng.random() < 0.5),
        mixed=rng.choice([0.0, rng.uniform(0, 0.5)]),
        grazing=rng.uniform(0.02, 0.4),
        lost=rng.uniform(0, 0.2) ** 2,
    )


def _depth(target: Target, count: int, rng: np.random.Generator, errors: RangeErrors | None = None) -> Scan:
    """One frame of a depth camera."""
    distance = _log_uniform(rng, 0.6, 4.0)
    raster = Pinhole(*_pose(rng, distance))
    sampling = _Sampling(count, rng.uniform(0.8, 1.25))
    window = _window(target, raster, _closeness(rng), rng)
    chosen = errors or (_light_errors if rng.random() < 0.6 else _flight_errors)(rng, distance)
    return _scan("depth", target, raster, window, sampling, chosen, rng)


def _light_errors(rng: np.random.Generator, distance: float) -> RangeErrors:
    """Structured light or stereo: errors that grow with the square of depth, smooth over the matching window."""
    sigma = _log_uniform(rng, 2e-4, 1e-2)
    width = _log_uniform(rng, 0.6, 8.0)
    return RangeErrors(
        distance,
        white=sigma * rng.uniform(0, 0.7),
        waves=sigma * rng.uniform(0.2, 1.2),
        wave_rows=width,
        wave_columns=width,
        range_power=2.0,
        grazing_power=rng.uniform(0, 1),
        step=rng.choice([0.0, sigma * _log_uniform(rng, 0.5, 5.0)], p=[0.3, 0.7]),
        disparity=True,
        mixed=rng.uniform(0, 0.7),
        grazing=rng.uniform(0.05, 0.35),
        lost=rng.uniform(0, 0.3) ** 2,
    )


def _flight_errors(rng: np.random.Generator, distance: float) -> RangeErrors:
    """Time of flight: independent errors by the strength of the return, wide waves of multiple paths."""
    sigma = _log_uniform(rng, 2e-4, 1e-2)
    width = _log_uniform(rng, 4.0, 60.0)
    return RangeErrors(
        distance,
        white=sigma,
        waves=sigma * _log_uniform(rng, 0.05, 1.0),
        wave_rows=width,
        wave_columns=width,
        range_power=rng.uniform(1, 2),
        grazing_power=rng.uniform(0.3, 1.0),
        step=sigma * rng.choice([0.0, _log_uniform(rng, 0.05, 1.0)]),
        mixed=rng.uniform(0.2, 0.9),
        grazing=rng.uniform(0.02, 0.25),
        lost=rng.uniform(0, 0.2) ** 2,
    )


def _lidar(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """A multi-beam lidar that passes by, or goes around: lines far apart, the same beams at each place."""
    places = int(rng.integers(1, 9))
    far = _log_uniform(rng, 0.7, 5.0)
    up = _unit(rng.normal(size=3))
    start, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1]) * rng.uniform(0.05, 2 * np.pi / max(places, 2))
    height, tilt = rng.uniform(-0.3, 0.8), rng.choice([0.0, rng.uniform(0, 0.6)])
    sampling = _Sampling(
        max(1, count // places), _log_uniform(rng, 1.5, 25.0), rng.uniform(0, 0.15), rng.uniform(0, 0.5) ** 2
    )
    errors, registration = _lidar_errors(rng, far), _registration(rng)
    views = []
    for place in range(places):
        distance = far * rng.uniform(0.8, 1.25)
        raster = Spherical(*_upright(up, start + place * turn, distance, height, tilt, rng))
        window = _window(target, raster, 1.0, rng)
        views.append(registration(_scan("lidar", target, raster, window, sampling, errors, rng), rng))
    return _merged(views)


def _lidar_errors(rng: np.random.Generator, distance: float) -> RangeErrors:
    """Independent errors, a bias of each beam, and centimeters as steps."""
    sigma = _log_uniform(rng, 5e-5, 6e-3)
    return RangeErrors(
        distance,
        white=sigma,
        waves=sigma * rng.choice([0.0, rng.uniform(0, 1)]),
        wave_columns=_log_uniform(rng, 1.0, 30.0),
        line=sigma * rng.choice([0.0, rng.uniform(0, 1)]),
        range_power=rng.uniform(0, 1),
        grazing_power=rng.uniform(0, 1),
        step=sigma * rng.choice([0.0, _log_uniform(rng, 0.1, 3.0)]),
        mixed=rng.uniform(0, 0.5),
        grazing=rng.uniform(0.01, 0.15),
        lost=rng.uniform(0, 0.3) ** 2,
    )


def _station(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Terrestrial scanners around the target, near and far."""
    places = int(rng.integers(1, 6))
    up = _unit(rng.normal(size=3))
    angles = rng.uniform(0, 2 * np.pi) + np.arange(places) * 2 * np.pi / places + rng.normal(scale=0.4, size=places)
    sigma, registration = _log_uniform(rng, 2e-5, 3e-3), _registration(rng)
    sampling = _Sampling(max(1, count // places), _log_uniform(rng, 0.5, 2.0), rng.uniform(0, 0.2))
    views = []
    for angle in angles:
        distance = _log_uniform(rng, 0.56, 4.0)
        errors = RangeErrors(
            1.0,
            white=sigma,
            range_power=rng.uniform(0, 1),
            grazing_power=rng.uniform(0, 1),
            mixed=rng.uniform(0, 0.8),
            grazing=rng.uniform(0.01, 0.2),
            lost=rng.uniform(0, 0.2) ** 2,
        )
        raster = Spherical(*_upright(up, angle, distance, rng.uniform(-0.3, 0.5), 0.0, rng))
        view = _scan("station", target, raster, _window(target, raster, 1.0, rng), sampling, errors, rng)
        views.append(registration(view, rng))
    return _merged(views)


def _fused(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Views of one device from all sides, put together with errors of the registration."""
    places = round(_log_uniform(rng, 3, 25))
    single = _stripe if rng.random() < 0.6 else _depth
    errors = {_stripe: _stripe_errors, _depth: _light_errors if rng.random() < 0.6 else _flight_errors}[single](
        rng, 1.5
    )
    registration = _registration(rng)
    views = [registration(single(target, max(1, count // places), rng, errors), rng) for _ in range(places)]
    return replace(_merged(views), kind="fused")


def _photogrammetry(target: Target, count: int, rng: np.random.Generator) -> Scan:
    """Points that cameras see in pairs: dense on texture, with the bumps that smoothing leaves."""
    eyes = _log_uniform(rng, 0.8, 3.0) * _directions(int(rng.integers(4, 40)), rng)
    steepest, contrast, bare = rng.uniform(0.05, 0.4), rng.uniform(0, 2), rng.uniform(-3, -1)
    texture = RandomField(_log_uniform(rng, 0.05, 0.6), rng)
    parts: list[Scan] = []
    found = 0
    while found < count and len(parts) < 6:
        part = _matched(target, eyes, 2 * count, steepest, rng)
        strength = texture(part.points)
        dense = rng.random(len(part)) < np.exp(contrast * (strength - 1))
        parts.append(part.take(dense & (strength > bare)))
        found += len(parts[-1])
    clean = _merged(parts)
    clean = clean if found <= count else clean.take(np.arange(count))
    return replace(clean, points=_bumpy(clean, rng))


def _matched(target: Target, eyes: Floats, count: int, steepest: float, rng: np.random.Generator) -> Scan:
    """Those of `count` points that two random eyes see from the same side, less steeply than by a cosine."""
    points, normals = target.sample(count, rng)
    pair = [eyes[rng.integers(len(eyes), size=count)] for _ in range(2)]
    first, second = ((_unit(eye - points) * normals).sum(1) for eye in pair)
    facing = np.flatnonzero((np.minimum(np.abs(first), np.abs(second)) > steepest) & (first * second > 0))
    for eye in pair:
        facing = facing[target.visible(points[facing], eye[facing])]
    toward = normals[facing] * np.sign(first[facing])[:, None]
    return Scan("photogrammetry", points[facing], toward, pair[0][facing], np.ones(len(facing), dtype=bool))


def _bumpy(clean: Scan, rng: np.random.Generator) -> Floats:
    """The points with errors that are smooth over the surface, and independent ones, larger along the line of sight."""
    bumps = np.zeros(len(clean))
    for _ in range(rng.integers(1, 4)):
        wavelength = _log_uniform(rng, 0.01, 0.3)
        bumps += RandomField(wavelength, rng)(clean.points) * wavelength * _log_uniform(rng, 1e-3, 2e-2)
    white = _log_uniform(rng, 1e-4, 6e-3)
    across = white * rng.uniform(0.2, 1.0) * rng.standard_normal((len(clean), 3))
    along = white * rng.standard_normal((len(clean), 1)) * _unit(clean.sensors - clean.points)
    return clean.points + bumps[:, None] * clean.normals + across + along


_SCANNERS: dict[str, Callable[[Target, int, np.random.Generator], Scan]] = {
    "stripe": _stripe,
    "depth": _depth,
    "lidar": _lidar,
    "station": _station,
    "fused": _fused,
    "photogrammetry": _photogrammetry,
}


# ---------------------------------------------------------------------------------------------------------------------
# Poses, registration, and what happens to a cloud afterwards


def _closeness(rng: np.random.Generator) -> float:
    """How much of the target a view shows: all of it, or a window of up to a fifth of its width."""
    return 1.0 if rng.random() < 0.6 else _log_uniform(rng, 1.0, 5.0)


def _pose(rng: np.random.Generator, distance: float) -> tuple[Floats, Floats]:
    """An eye at a distance from the origin in any direction, and axes (right, up, forward) of any roll."""
    eye = distance * _unit(rng.normal(size=3))
    return eye, _axes(-eye + rng.normal(scale=0.03, size=3), rng.normal(size=3))


def _upright(
    up: Floats, angle: float, distance: float, height: float, tilt: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """An eye at an angle around the axis "up" and a height over the middle; its axes stand upright but for a tilt."""
    right, ahead, _ = _axes(up, np.array([0.3, 0.5, 0.8]))
    eye = distance * _unit(np.cos(angle) * right + np.sin(angle) * ahead + height * up)
    level = -eye + (eye @ up) * up
    return eye, _axes(level, up + tilt * _unit(rng.normal(size=3)))


def _axes(forward: Floats, up: Floats) -> Floats:
    """Rows right, up and forward of a frame, (3, 3); up is made perpendicular."""
    forward = _unit(forward)
    right = _unit(np.cross(up, forward))
    return np.stack([right, np.cross(forward, right), forward])


def _registration(rng: np.random.Generator) -> Callable[[Scan, np.random.Generator], Scan]:
    """Moves a view by an error of a size that the views of a cloud share; none in a quarter of the clouds."""
    size = 0.0 if rng.random() < 0.25 else _log_uniform(rng, 1e-5, 6e-3)
    return partial(_misplaced, size=size)


def _misplaced(view: Scan, rng: np.random.Generator, size: float) -> Scan:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(size * rng.standard_normal(3)).as_matrix().T
    shift = size * rng.standard_normal(3)
    return replace(view, points=view.points @ turn + shift, sensors=view.sensors @ turn + shift)


def _seen(target: Target, scan: Scan, eyes: Floats) -> NDArray[np.bool_]:
    """Which points of a scan nothing hides from eyes (N, 3); the measured ones stand for the true ones."""
    # Lifted off the surface by more than the noise would sink them: only what is clearly hidden counts.
    lift = 0.004 * scan.normals
    return target.visible(scan.points + lift, eyes)


def _merged(views: list[Scan]) -> Scan:
    arrays = ("points", "normals", "sensors", "labeled")
    joined = {name: np.concatenate([getattr(view, name) for view in views]) for name in arrays}
    return Scan(views[0].kind, **joined)


def _handled(scan: Scan, rng: np.random.Generator) -> Scan:
    """What is done to a cloud between the scanner and the file."""
    if rng.random() < OUTLIERS_SHARE:
        scan = _with_outliers(scan, rng)
    if rng.random() < THINNED_SHARE:
        scan = _thinned(scan, rng)
    if rng.random() < ROUNDED_SHARE:
        step = _log_uniform(rng, 1e-3, 0.7) * _spacing(scan)
        scan = replace(scan, points=step * np.round(scan.points / step))
    if rng.random() < DUPLICATES_SHARE:
        scan = _with_duplicates(scan, rng)
    return scan


def _with_outliers(scan: Scan, rng: np.random.Generator) -> Scan:
    """Some points far off the surface: along their rays, or anywhere."""
    count = round(len(scan) * _log_uniform(rng, 5e-4, 0.05))
    rows = rng.choice(len(scan), count, replace=False)
    points, labeled = scan.points.copy(), scan.labeled.copy()
    offset = _log_uniform(rng, 0.005, 0.3) * rng.standard_normal((count, 1))
    along = rng.random(count)[:, None] < 0.7
    anywhere = rng.uniform(points.min(0), points.max(0), (count, 3))
    points[rows] = np.where(along, points[rows] + offset * _unit(scan.sensors[rows] - points[rows]), anywhere)
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
    shift = _log_uniform(rng, 1e-8, 0.03) * _spacing(scan)
    return _merged([scan, replace(copies, points=copies.points + shift * rng.standard_normal(copies.points.shape))])


def _spacing(scan: Scan) -> float:
    """The side of the square that each point has if they share the surface of their bounding box evenly, halved."""
    x, y, z = np.ptp(scan.points, axis=0)
    return float(np.sqrt((x * y + y * z + z * x) / len(scan)))


def _directions(count: int, rng: np.random.Generator) -> Floats:
    """Random unit vectors, (count, 3), over the sphere or in a cap of it."""
    directions = _unit(rng.normal(size=(count, 3)))
    return directions if rng.random() < 0.6 else _unit(directions + rng.uniform(1.0, 2.0) * _unit(rng.normal(size=3)))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
