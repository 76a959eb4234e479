"""The side of an open surface from which it was seen, if a scan was taken from one place.

One view of an object is a height field over a plane: no point hides another, neither from its sensor nor from behind.
The borders tell the two sides apart. What a sensor sees of an object ends where the surface turns away from it, so the
surface recedes from the sensor at its borders: the neighbors of a border point lie in front of it. Only where one
thing hides another does the hidden surface end anywhere.

1. The axis: the direction that as much of the consistently signed surface as possible faces.
2. All regions are turned to face along the axis (`agreement.relax` weighs that and their couplings).
3. The borders tell whether the axis points to the sensor or away from it.
4. Where much of the surface hides behind other surface along the axis, several sensors saw it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.vectors import unit
from jetnormal.orientation.agreement import Surface, chunks, relax
from jetnormal.orientation.parts import Parts
from jetnormal.orientation.visibility import along, below_topmost

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

Z = (0.0, 0.0, 1.0)  # where there is no direction
ROUNDS = 20
AXIS_WEIGHT = 0.1  # of the votes for the axis, over the couplings
AVERTED_WEIGHT = 5.0  # of surface that looks away from the axis: a view has none
LEAST_COSINE = 0.1  # of what a sensor sees, nearly
BORDER = 0.3  # distance from a border point to the mean of its neighbors, over the radius around these
MIN_BORDERS = 30  # points; fewer tell nothing
ONE_SIDE = 0.6  # of the area faces the axis in all views below
# In simulated range and depth views of objects, and in 10 of a real figurine, the borders lean by 0.11 or more, and
# always away from the sensor; in frames of rooms, tables and streets by 0.01 to 0.09.
LEAN = 0.1
# In the same views, up to 0.16 of the area is hidden; 0.4 of an object without a bottom that three stations saw.
HIDDEN = 0.2
BEHIND = 2.0  # pixels: surface so far behind the topmost of its pixel is hidden, a slope as many times more
PIXEL = 2.0  # side of a pixel, over the radius around the neighbors


@dataclass(frozen=True)
class View:
    """A surface as it may have been seen from one side.

    Attributes:
        belief: (M,) signs of the regions, -1 to 1, that show them to the sensor.
        facing: the share of the area that then faces the sensor, 0 to 1.
        lean: how far the surface recedes from the sensor at its borders, 0 (not at all) to 1.
        borders: how many points lie at borders.
        hidden: the share of the area that lies behind other surface.
    """

    belief: Floats
    facing: float
    lean: float
    borders: int
    hidden: float

    @property
    def several(self) -> bool:
        """Whether the surface must have been seen from several sides."""
        return self.hidden > HIDDEN

    @property
    def found(self) -> bool:
        """Whether this may be a view whose sides can be told apart."""
        return (
            not self.several
            and self.borders >= MIN_BORDERS
            and self.facing >= ONE_SIDE
            and self.lean > 1 / np.sqrt(self.borders)
        )

    @property
    def certain(self) -> bool:
        """Whether the surface recedes at its borders as clearly as those of objects do."""
        return self.found and self.lean >= LEAN


def as_seen(surface: Surface, parts: Parts, among: Bools) -> View:
    """Find the side of an open surface that one sensor saw.

    Args:
        surface: N points; normals are consistent in every region.
        parts: its M regions.
        among: (N,) which points are on it; the others are objects of their own.
    """
    area = surface.spacing**2 * among
    axis = _largest_side(surface, parts, area)
    for _ in range(ROUNDS):
        belief = _facing(surface, parts, area, axis)
        signs = np.where(belief < 0, -1.0, 1.0)[parts.region]
        cosine = signs * along(surface.normals, axis)
        weight = signs * area * np.where(cosine < LEAST_COSINE, AVERTED_WEIGHT, 1)
        before, axis = axis, unit((surface.normals * weight[:, None]).sum(axis=0), Z)
        if float((axis * before).sum()) > 0.9999:
            break
    belief = _facing(surface, parts, area, axis)
    cosine = np.where(belief < 0, -1.0, 1.0)[parts.region] * along(surface.normals, axis)
    lean, borders = _lean(surface, axis, among)
    facing = float(area[cosine > 0].sum() / area.sum())
    return View(belief if lean >= 0 else -belief, facing, abs(lean), borders, _hidden(surface, axis, area))


def _largest_side(surface: Surface, parts: Parts, area: Floats) -> Floats:
    """The mean direction (3,) of the largest component, with consistent signs."""
    start = np.array([0.48, 0.36, 0.8])  # any direction will do; this one is along no axis of a drawing
    signs = np.where(_facing(surface, parts, area, start, 1e-3) < 0, -1.0, 1.0)[parts.region]
    largest = parts.component == np.argmax(np.bincount(parts.component, area))
    return unit((surface.normals * (signs * area * largest)[:, None]).sum(axis=0), Z)


def _facing(surface: Surface, parts: Parts, area: Floats, axis: Floats, weight: float = AXIS_WEIGHT) -> Floats:
    """Signs of regions (M,), -1 to 1, with which they face an axis."""
    return relax(parts.coupling, weight * parts.by_region(area * along(surface.normals, axis)) / area.mean())


def _lean(surface: Surface, axis: Floats, among: Bools) -> tuple[float, int]:
    """How far the surface recedes, against the axis, at its borders, -1 to 1, and the number of border points."""
    if surface.neighbors.shape[1] < 3:
        return 0.0, 0
    around = [surface.points[surface.neighbors[rows]].mean(axis=1) for rows in chunks(len(surface.points))]
    inner = np.concatenate(around) - surface.points
    inner -= np.einsum("nd,nd->n", inner, surface.normals)[:, None] * surface.normals  # the rest of it is noise
    length = np.linalg.norm(inner, axis=1)
    border = among & (length > BORDER * surface.radius)
    if not border.any():
        return 0.0, 0
    return float((along(inner[border], axis) / length[border]).mean()), int(border.sum())


def _hidden(surface: Surface, axis: Floats, area: Floats) -> float:
    """The share of the area (N,) of surface that lies behind other surface, seen along an axis from far away."""
    pixel = PIXEL * float(np.median(surface.radius))
    rows = np.flatnonzero(area)
    cosine = np.clip(np.abs(along(surface.normals[rows], axis)), LEAST_COSINE, 1)
    slack = BEHIND * pixel * (1 + np.sqrt(1 - cosine**2) / cosine)
    behind = below_topmost(surface.points[rows], axis, pixel) > slack
    return float(area[rows[behind]].sum() / area.sum())
