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
from jetnormal.data.scanners.scenes import SceneTarget, scan_scene
from jetnormal.data.scanners.targets import Target

FAMILIES = {"stripe": 0.2, "depth": 0.2, "lidar": 0.2, "station": 0.12, "fused": 0.16, "photogrammetry": 0.12}
SMALLEST = 1 / 8  # a cloud has this share of the largest number of points, or more
LEAST_POINTS = 500  # a view that sees less of the target is drawn again
TRIES = 20


def random_scan(target: Target, largest: int, rng: np.random.Generator, kind: str | None = None) -> Scan:
    """Scan a surface by a scanner that is drawn at random.

    Args:
        target: the surface.
        largest: largest number of points; at least about an eighth as many are aimed at, several densities.
        rng: source of randomness.
        kind: a key of `FAMILIES`, or of `SCENE_SCANNERS` for a scene; None draws one by its share there.

    Raises:
        ValueError: nothing of the surface can be seen.
    """
    for _ in range(TRIES):
        count = max(1, round(largest * SMALLEST ** rng.random()))
        if isinstance(target, SceneTarget):
            scan = scan_scene(target, count, rng, kind)
        else:
            chosen = kind or str(rng.choice(list(FAMILIES), p=list(FAMILIES.values())))
            scan = OBJECT_SCANNERS[chosen](target, count, rng)
        if len(scan) >= min(LEAST_POINTS, count / 4):
            scan = handled(scan, rng)
            scan = scan if len(scan) <= largest else scan.take(np.sort(rng.choice(len(scan), largest, replace=False)))
            return replace(
                scan,
                points=target.center + target.size * scan.points,
                sensors=target.center + target.size * scan.sensors,
            )
    raise ValueError("the scanners saw next to nothing of the surface")
