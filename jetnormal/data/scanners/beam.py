"""What the width of a stripe of light does to triangulated ranges: rounded creases, and edges that curl.

A camera takes the middle of the light that it sees for the middle of the stripe. Where a part of the stripe misses the
surface, or is hidden from the camera, the middle moves, and the range with it (Curless and Levoy, "Better optical
triangulation through spacetime analysis", ICCV 1995).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.scanners.range_errors import shifted
from jetnormal.geometry.vectors import unit

Floats = NDArray[np.float64]

REACH = 2.5  # standard deviations of the stripe to either side, where its light ends
STEEPEST = 3.0  # rise over run from pixel to pixel that still is one surface


@dataclass(frozen=True)
class Camera:
    """A camera beside a stripe of light.

    Attributes:
        offset: (3,) its place, seen from the light.
        axis: of the raster along which it stands beside the light: 0 across the rows, 1 across the columns.
        slope: how much farther a point seems for each length that the light moves to higher rows or columns.
    """

    offset: Floats
    axis: int
    slope: float


class Stripe(NamedTuple):
    """The light of a stripe, as a camera sees it.

    Attributes:
        distance: (rows, columns) of the points that are read.
        normals: (rows, columns, 3) of the surface, averaged over the light.
    """

    distance: Floats
    normals: Floats


def seen_stripe(
    distance: Floats, normals: Floats, strength: Floats, gap: Floats, width: float, camera: Camera
) -> Stripe:
    """Read a raster by a stripe of light of some width.

    Args:
        distance: (rows, columns) true distances; infinite where no light comes back.
        normals: (rows, columns, 3) of the surface there.
        strength: (rows, columns) of the light that comes back.
        gap: (rows, columns) from each ray to the next along the camera's axis, at the surface.
        width: standard deviation of the light across the stripe, in pixels.
        camera: what sees it.
    """
    lit = np.isfinite(distance)
    true = np.where(lit, distance, 0.0)
    parted = gap * (STEEPEST + width * abs(camera.slope))  # a jump of less does not part the light in two
    light = np.where(lit, strength, 0.0)
    total, aside = light, np.zeros_like(light)
    middle, facing = light * true, light[..., None] * normals
    for side in (-1, 1):
        joined, before = lit, true
        for step in range(1, int(np.ceil(REACH * width)) + 1):
            pixel = partial(shifted, step=side * step, axis=camera.axis)
            there = pixel(true)
            joined = joined & pixel(lit) & (np.abs(there - before) < parted)
            light = joined * pixel(strength) * np.exp(-0.5 * (step / width) ** 2)
            total = total + light
            aside += light * side * step * gap
            middle += light * there
            facing += light[..., None] * pixel(normals)
            before = there
    read = (middle + camera.slope * aside) / np.maximum(total, 1e-12)
    return Stripe(np.where(lit, read, np.inf), unit(facing))
