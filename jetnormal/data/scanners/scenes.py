"""Scanners of scenes, which stand or move inside them, or fly over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jetnormal.data.scanners.devices import camera_errors, lidar_errors, station_errors
from jetnormal.data.scanners.objects import photographed
from jetnormal.data.scanners.range_errors import RangeErrors
from jetnormal.data.scanners.rasters import Pinhole, Profile, Sampling, Spherical, Window, read_raster
from jetnormal.data.scanners.scan import Scan, axes_along, log_uniform, merged, registration_errors
from jetnormal.data.scanners.targets import Floats, MeshTarget
from jetnormal.data.scenes.layout import Scene
from jetnormal.geometry.vectors import unit

UP = np.array([0.0, 0.0, 1.0])
ROOM_TO_STAND = 0.25  # meters between a sensor and the nearest surface
JUMP = 0.04  # meters between the depths of two surfaces


class SceneTarget(MeshTarget):
    """A scene as a target, in a frame where its bounding box has a diagonal of one.

    Attributes:
        kind: of the scene.
        stands: (K, 3) places for sensors, with some room around them.
        trip: (2, 3) ends of a way.
        meter: one meter in the frame.
    """

    def __init__(self, scene: Scene) -> None:
        """Build the search structure once.

        Raises:
            ResourceError: Open3D, which casts the rays, cannot be loaded.
        """
        super().__init__(scene.sampler())
        self.kind = scene.kind
        self.meter = 1 / self.size
        self.trip = (scene.trip - self.center) / self.size
        self.stands = self._roomy((scene.stands - self.center) / self.size)

    def _roomy(self, places: Floats) -> Floats:
        """Those of the places (K, 3) that are away from surfaces, at least the best one."""
        toward = np.random.default_rng(0).normal(size=(64, 3))
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        hits = self.cast(np.repeat(places, len(toward), axis=0), np.tile(toward, (len(places), 1)))
        nearest = hits.distance.reshape(len(places), -1).min(1)
        return places[(nearest > ROOM_TO_STAND * self.meter) | (nearest == nearest.max())]


def _stations(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """A scanner on a tripod at one to five places, each seeing all around but for a cone below."""
    places = target.stands[: rng.integers(1, 6)]
    device = _scaled(station_errors(rng, 10.0, log_uniform(rng, 3e-4, 1e-2)), target)
    sampling = Sampling(max(1, count // len(places)), log_uniform(rng, 0.5, 2.0), rng.uniform(0, 0.2))
    registration = registration_errors(rng, 2e-4 * target.meter, 0.03 * target.meter)
    window = _angles(rng, np.pi, -rng.uniform(0.8, 1.2), np.pi / 2)
    views = []
    for eye in places:
        raster = Spherical(eye, _level(rng.uniform(0, 2 * np.pi)))
        views.append(registration(read_raster("station", target, raster, window, sampling, device, rng), rng))
    return merged(views)


def _frames(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """A frame of a depth camera, or several put together."""
    frames = 1 if rng.random() < 0.5 else round(log_uniform(rng, 3, 30))
    device = _scaled(camera_errors(rng, 2.5, log_uniform(rng, 5e-4, 3e-2)), target)
    device = replace(device, reach=rng.uniform(4, 10) * target.meter)
    registration = registration_errors(rng, 1e-3 * target.meter, 0.05 * target.meter)
    wide = np.tan(rng.uniform(0.4, 0.65))
    window = Window(np.array([-wide, -0.75 * wide]), np.array([wide, 0.75 * wide]))
    sampling = Sampling(max(1, count // frames), rng.uniform(0.8, 1.25))
    views = []
    for _ in range(frames):
        eye = target.stands[rng.integers(len(target.stands))] + rng.normal(scale=0.08 * target.meter, size=3)
        angle, tilt = rng.uniform(0, 2 * np.pi), rng.normal(scale=0.35)
        forward = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
        raster = Pinhole(eye, axes_along(forward, UP + rng.normal(scale=0.05, size=3)))
        views.append(registration(read_raster("depth", target, raster, window, sampling, device, rng), rng))
    return merged(views) if frames == 1 else replace(merged(views), kind="fused")


def _spinning(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """A multi-beam lidar: one turn of it, or some along a way."""
    turns = 1 if rng.random() < 0.5 else round(log_uniform(rng, 2, 25))
    device = _scaled(lidar_errors(rng, 15.0, log_uniform(rng, 2e-3, 5e-2)), target)
    device = replace(device, reach=rng.uniform(20, 120) * target.meter)
    registration = registration_errors(rng, 2e-3 * target.meter, 0.1 * target.meter)
    middle, half = rng.choice([-0.1, 0.0]), rng.uniform(0.2, 0.7)
    window = _angles(rng, np.pi, middle - half, middle + half)
    # The beams are a fraction of a degree to two degrees apart, the columns 0.1 to 0.4 degrees.
    sampling = Sampling(
        max(1, count // turns), log_uniform(rng, 1.5, 12.0), rng.uniform(0, 0.1), rng.uniform(0, 0.5) ** 2
    )
    heading, tilt = rng.uniform(0, 2 * np.pi), rng.normal(scale=rng.choice([0.0, 0.3]), size=3)
    views = []
    for eye in _along(target, turns, rng):
        axes = _level(heading) @ axes_along(np.array([0, 0, 1.0]), np.array([0, 1.0, 0]))
        axes = axes_along(axes[2] + 0.2 * tilt, UP + tilt)
        raster = Spherical(eye, axes)
        views.append(registration(read_raster("lidar", target, raster, window, sampling, device, rng), rng))
    return merged(views)


def _along(target: SceneTarget, count: int, rng: np.random.Generator) -> Floats:
    """Places (count, 3) along the trip of a street, or on a walk between the stands."""
    if target.kind == "street":
        share = (rng.uniform(0.1, 0.9) + np.linspace(-0.4, 0.4, count) * rng.random()).clip(0, 1)
        return target.trip[0] + share[:, None] * (target.trip[1] - target.trip[0])
    drift = rng.normal(scale=0.3 * target.meter, size=(count, 3)).cumsum(0) * [1, 1, 0.1] / np.sqrt(count)
    return target.stands[rng.integers(len(target.stands))] + drift * (count > 1)


def _mobile(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """A profile scanner on a vehicle: full turns across the way, lines apart by its speed."""
    start, end = target.trip
    reach = rng.uniform(4, 10) * target.meter
    device = _scaled(lidar_errors(rng, 10.0, log_uniform(rng, 1e-3, 3e-2)), target)
    axes = np.stack([np.cross(unit(end - start), UP), unit(end - start), UP])
    raster = Profile(start, axes, reach, lean=rng.choice([-1, 0, 1]) * rng.uniform(0, 1))
    whole = float(np.linalg.norm(end - start))
    first, part = rng.uniform(0, 0.5) * whole, rng.uniform(0.15, 0.5) * whole
    window = Window(np.array([-np.pi * reach, first]), np.array([np.pi * reach, first + part]))
    sampling = Sampling(count, log_uniform(rng, 0.8, 12.0), rng.uniform(0, 0.1))
    return read_raster("mobile", target, raster, window, sampling, device, rng)


def _airborne(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """Strips of an airborne laser scanner."""
    strips = int(rng.integers(1, 4))
    device = _scaled(lidar_errors(rng, 500.0, log_uniform(rng, 5e-3, 0.1)), target)
    device = replace(device, range_power=0.0)
    registration = registration_errors(rng, 0.01 * target.meter, 0.2 * target.meter)
    forward = unit(target.trip[1] - target.trip[0])
    across = np.cross(forward, UP)
    ground = target.stands[:, 2].mean()
    high = float(target.trip[0, 2] - ground)
    width = min(float(np.ptp(target.sample(2000, rng)[0][:, :2])), 2 * high)
    sampling = Sampling(max(1, count // strips), log_uniform(rng, 0.3, 5.0), rng.uniform(0, 0.3), rng.uniform(0, 0.2))
    views = []
    for _ in range(strips):
        shift = rng.normal(scale=0.3) * width * across
        raster = Profile(target.trip[0] + shift, np.stack([across, forward, -UP]), high)
        window = Window(
            np.array([-width / 2, 0.0]), np.array([width / 2, float(np.linalg.norm(target.trip[1] - target.trip[0]))])
        )
        views.append(registration(read_raster("airborne", target, raster, window, sampling, device, rng), rng))
    return merged(views)


def _photographed(target: SceneTarget, count: int, rng: np.random.Generator) -> Scan:
    """Photogrammetry from places in the room or street, or from a drone."""
    eyes = target.stands + rng.normal(scale=0.1 * target.meter, size=target.stands.shape)
    if target.kind != "room":
        lifted = eyes[rng.integers(len(eyes), size=30)] + rng.normal(scale=10 * target.meter, size=(30, 3)) * [1, 1, 0]
        eyes = lifted + rng.uniform(2, 40) * target.meter * UP
    return photographed(target, eyes, count, rng)


_Scanner = Callable[[SceneTarget, int, np.random.Generator], Scan]
SCENE_SCANNERS: dict[str, dict[str, tuple[_Scanner, float]]] = {
    "room": {
        "station": (_stations, 0.35),
        "depth": (_frames, 0.35),
        "lidar": (_spinning, 0.2),
        "photogrammetry": (_photographed, 0.1),
    },
    "street": {
        "station": (_stations, 0.2),
        "depth": (_frames, 0.1),
        "lidar": (_spinning, 0.35),
        "mobile": (_mobile, 0.25),
        "photogrammetry": (_photographed, 0.1),
    },
    "terrain": {
        "station": (_stations, 0.2),
        "airborne": (_airborne, 0.5),
        "lidar": (_spinning, 0.1),
        "photogrammetry": (_photographed, 0.2),
    },
}


def scene_shares(kind: str) -> dict[str, float]:
    """Tell how often each scanner scans a scene of a kind: shares by their names."""
    return {name: share for name, (_, share) in SCENE_SCANNERS[kind].items()}


def _scaled(errors: RangeErrors, target: SceneTarget) -> RangeErrors:
    """Errors in meters, in the frame of a target."""
    lengths = {name: getattr(errors, name) * target.meter for name in ("reference", "white", "waves", "line", "step")}
    return replace(errors, **lengths, jump=JUMP * target.meter)


def _angles(rng: np.random.Generator, half_turn: float, low: float, high: float) -> Window:
    return Window(np.array([-half_turn, low]), np.array([half_turn, high]))


def _level(heading: float) -> Floats:
    """Upright axes whose forward direction has a heading."""
    return axes_along(np.array([np.cos(heading), np.sin(heading), 0.0]), UP)
