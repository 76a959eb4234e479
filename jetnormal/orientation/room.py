"""Whether a closed surface is a room that was scanned from inside.

The walls of a room look like an object to whoever is far away: nothing in them tells that they were seen from the other
side. What stands in the room does. No place outside sees it, while a few places inside see nearly all of it, and the
walls too. Of an object, places in its matter see only walls around them, and what is hidden from afar are the bottoms
of holes. What is hidden in a part of its own, behind a gap, may be a cavity as well as a thing in a room: it tells
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.neighbors import NeighborIndex, distinct
from jetnormal.orientation.agreement import Surface
from jetnormal.orientation.kernels.fields import solid_angles
from jetnormal.orientation.visibility import look

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SAMPLE, MIN_POINTS = 12_000, 200
STRAYS = 0.005  # of the points may lie outside the box of places, on each side
CANDIDATES, PLACES, STATIONS = 400, 60, 8
IN_MATTER = 0.5  # winding number of the surface turned outward
SIDE = 12  # pixels along the side of a picture; six pictures show all that is around a place
SLACK = 0.3  # of a pixel's width: a point this far behind the nearest one of its pixel is still seen
MIN_COSINE = 0.1  # a look along the surface shows nothing
SEEN_NEIGHBORS = 0.1  # share of a point's neighbors that are seen from outside; below, noise does not hide it
# Tuned on 19 scans of rooms with closed walls that hide anything: these find 9 and suspect 8; of 135 clouds of objects,
# some with deep holes, none and 4. Of ten other such scans they find 1 and suspect 6, of 78 other clouds of objects
# none. To take an object for a room costs all its signs.
HIDDEN, WALLS_SEEN, THINGS_SEEN, AT_ONCE = 0.08, 0.96, 0.975, 0.55
SUSPECT_HIDDEN, SUSPECT_WALLS_SEEN, SUSPECT_THINGS_SEEN, SUSPECT_AT_ONCE = 0.045, 0.9, 0.93, 0.51


@dataclass(frozen=True)
class Room:
    """What places outside and inside of a closed surface see of it.

    Attributes:
        hidden: share of the points that no place outside sees.
        walls_seen: share of the others that a few places inside see.
        things_seen: share of the hidden ones that the same places see.
        at_once: share of all that one place sees.
    """

    hidden: float
    walls_seen: float
    things_seen: float
    at_once: float

    @property
    def found(self) -> bool:
        """Whether it is a room."""
        return self._reaches(HIDDEN, WALLS_SEEN, THINGS_SEEN, AT_ONCE)

    @property
    def suspected(self) -> bool:
        """Whether it may be one."""
        return self._reaches(SUSPECT_HIDDEN, SUSPECT_WALLS_SEEN, SUSPECT_THINGS_SEEN, SUSPECT_AT_ONCE)

    def _reaches(self, hidden: float, walls_seen: float, things_seen: float, at_once: float) -> bool:
        return (
            self.hidden >= hidden
            and self.walls_seen >= walls_seen
            and self.things_seen >= things_seen
            and self.at_once >= at_once
        )


def look_inside(points: Floats, normals: Floats) -> Room | None:
    """Find what places inside see of a closed surface; None if hardly anything is hidden from outside.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) unit vectors, turned outward; 0 where there is no direction.
    """
    random = np.random.default_rng(0)
    rows = np.flatnonzero(normals.any(axis=1))
    rows = rows[random.permutation(len(rows))[:SAMPLE]]
    rows = rows[distinct(points[rows])[0]]
    if len(rows) < MIN_POINTS:
        return None
    surface = Surface(points[rows] - np.median(points[rows], axis=0), normals[rows].copy())
    hidden = _hidden(surface)
    if hidden.mean() < SUSPECT_HIDDEN:
        return None
    places = _clear_places(surface, random)
    if not len(places):
        return None
    seen = np.stack([_seen_from(place, surface) for place in places])
    inside = np.zeros(len(rows), dtype=np.bool_)
    weight = np.where(hidden, 1 / hidden.sum(), 1 / max(1, (~hidden).sum()))
    for _ in range(STATIONS):
        inside |= seen[((seen & ~inside) * weight).sum(axis=1).argmax()]
    return Room(
        float(hidden.mean()),
        float(inside[~hidden].mean()),
        float(inside[hidden].mean()),
        float(seen.mean(axis=1).max()),
    )


def _hidden(surface: Surface) -> Bools:
    """Which points (N,) of the largest component infinity does not see."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    count, degree = surface.neighbors.shape
    ends = surface.neighbors.ravel(), np.arange(count + 1) * degree
    graph = csr_matrix((np.ones(count * degree), *ends), (count, count))
    component = connected_components(graph, directed=False)[1]
    seen = look(surface, np.zeros(count, dtype=np.int32), alone=True).total > 0
    near = (seen + seen[surface.neighbors].sum(axis=1)) / (1 + degree)
    return np.asarray((near < SEEN_NEIGHBORS) & (component == np.bincount(component).argmax()))


def _clear_places(surface: Surface, random: np.random.Generator) -> Floats:
    """Places (P, 3) inside, from the half of them that is farther from all points."""
    low, high = np.quantile(surface.points, [STRAYS, 1 - STRAYS], axis=0)
    places = random.uniform(low, high, (CANDIDATES, 3))
    area = surface.spacing**2
    winding = solid_angles(places, surface.points, surface.normals * area[:, None], area / 4)
    places = places[winding > IN_MATTER]
    if not len(places):
        return places
    distance = NeighborIndex(surface.points).query(places, 1)[1][:, 0]
    clear = places[np.argsort(-distance, kind="stable")[: (len(places) + 1) // 2]]
    return clear[:: -(-len(clear) // PLACES)]


def _seen_from(place: Floats, surface: Surface) -> Bools:
    """Which points (N,) a place sees: no other in the same pixel of a cube around it is much nearer."""
    sights = surface.points - place
    distance = np.maximum(np.sqrt(np.square(sights).sum(axis=1)), 1e-300)
    face = np.abs(sights).argmax(axis=1)
    rows = np.arange(len(sights))
    depth = np.maximum(np.abs(sights[rows, face]), 1e-300)
    pixel = 2 * face + (sights[rows, face] > 0)
    for turn in (1, 2):
        across = (sights[rows, (face + turn) % 3] / depth + 1) / 2 * SIDE
        pixel = pixel * SIDE + np.minimum(across.astype(np.int64), SIDE - 1)
    nearest = np.full(6 * SIDE**2, np.inf)
    np.minimum.at(nearest, pixel, distance)
    slack = np.maximum(SLACK * 2 / SIDE * distance, 2 * surface.spacing)
    facing = np.abs((sights * surface.normals).sum(axis=1)) > MIN_COSINE * distance
    return np.asarray((distance <= nearest[pixel] + slack) & facing)
