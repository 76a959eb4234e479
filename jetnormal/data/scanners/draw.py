"""Virtual scanners: clouds as sensors see a surface, with the true normals and the place of the sensor.

Six families, whose parameters are drawn over the wide ranges that such devices have:

    stripe          a laser line moved over the surface and triangulated by a camera beside it
    depth           a depth camera: structured light (steps of disparity, smooth errors) or time of flight
    lidar           a spinning multi-beam lidar at places along a way: lines far apart
    station         terrestrial scanners: an even grid of angles, dense near the station and sparse far from it
    fused           many views of the first two kinds, each with an error of its registration
    photogrammetry  density by texture, smooth errors of the surface, missing regions

Scenes are scanned from inside by stations, depth cameras, spinning lidars, a profile scanner on a vehicle ("mobile"),
strips of an airborne scanner ("airborne") and photogrammetry.

Any cloud may besides have outliers, rounded coordinates, near-duplicates, or have been thinned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jetnormal.data.scanners.handling import handled
from jetnormal.data.scanners.objects import OBJECT_SCANNERS
from jetnormal.data.scanners.scan import Scan
from jetnormal.data.scanners.scenes import SCENE_SCANNERS, SceneTarget, scene_shares
from jetnormal.data.scanners.targets import Target

FAMILIES = {"stripe": 0.2, "depth": 0.2, "lidar": 0.2, "station": 0.12, "fused": 0.16, "photogrammetry": 0.12}
SMALLEST = 1 / 8  # a cloud has this share of the largest number of points, or more
LEAST_POINTS = 500  # a view that sees less of the target is drawn again
TRIES = 20


def random_scan(target: Target, largest: int, rng: np.random.Generator) -> Scan:
    """Scan a surface by a scanner that is drawn at random.

    Args:
        target: the surface.
        largest: largest number of points; an eighth as many or more are aimed at, since clouds differ in density.
        rng: source of randomness.

    Raises:
        ValueError: nothing of the surface can be seen.
    """
    shares = scene_shares(target.kind) if isinstance(target, SceneTarget) else FAMILIES
    for _ in range(TRIES):
        kind = str(rng.choice(list(shares), p=list(shares.values())))
        seen = _attempt(target, kind, max(1, round(largest * SMALLEST ** rng.random())), rng)
        if seen is not None:
            return seen
    raise ValueError("the scanners saw next to nothing of the surface")


def scan(target: Target, kind: str, count: int, rng: np.random.Generator) -> Scan:
    """Scan a surface by a scanner of a kind, with parameters drawn at random.

    Args:
        target: the surface.
        kind: a key of `FAMILIES`, or of the scene's `SCENE_SCANNERS`.
        count: number of points that is aimed at, and the largest one.
        rng: source of randomness.

    Raises:
        ValueError: nothing of the surface can be seen.
    """
    for _ in range(TRIES):
        seen = _attempt(target, kind, count, rng)
        if seen is not None:
            return seen
    raise ValueError(f"a {kind} scanner saw next to nothing of the surface")


def _attempt(target: Target, kind: str, count: int, rng: np.random.Generator) -> Scan | None:
    """A scan in the surface's own coordinates, or None if it has too few points."""
    if isinstance(target, SceneTarget):
        seen = SCENE_SCANNERS[target.kind][kind][0](target, count, rng)
    else:
        seen = OBJECT_SCANNERS[kind](target, count, rng)
    if len(seen) < min(LEAST_POINTS, count / 4):
        return None
    seen = handled(seen, rng)
    seen = seen if len(seen) <= count else seen.take(np.sort(rng.choice(len(seen), count, replace=False)))
    points, sensors = (target.center + target.size * places for places in (seen.points, seen.sensors))
    return replace(seen, points=points, sensors=sensors)
