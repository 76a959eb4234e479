"""Visibility of a surface from far away: whoever sees a closed surface stands outside of it.

The votes of regions for the side that infinity sees are those of Takayama et al., "A simple method for correcting facet
orientations in polygon meshes based on ray casting" (2014), with orthographic depth maps instead of rays. What is
visible from a near place is found as in Katz et al., "Direct visibility of point sets" (2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import Labels, Surface
from jetnormal.orientation.kernels.views import see

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

VIEWS = 48
PIXEL_SPACINGS = 2.5  # side of a pixel: it holds six points on average, so that few let the eye through
SLACK = 0.3  # of a pixel's side: a point this far below the topmost one of its pixel is still seen
MIN_COSINE = 0.3  # a look along the surface tells nothing
MAX_OCTAVES = 6  # of the spacing, above the median of an object; what is sparser hides nothing
LEVEL_SHARE = 0.01  # of an object's points have a level of their own; fewer are strays, which hide nothing
SPARE_PIXELS = 1.25  # of the table, over one for each point; most pixels hold several
FARTHEST = 2.0**40  # pixels; what is farther away is drawn there
FARTHEST_COUNTED = 1e9  # the same where rows and columns make one number
EXTREME_SHARE = 0.01  # of a component's points vote, in each direction
MIN_PURITY = 0.2  # votes for outward and inward that nearly cancel mean that there is no outside
FIELD_OF_VIEW = 0.8  # of a depth camera: the tangent of half its angle is smaller
STRAYS = 0.01  # of the points may lie outside of it, where it moved a little, and as many nearer or farther
DEPTH_RANGE = 2.0  # it sees near and far things; heights over the sea are all alike
SAMPLE = 10_000  # points tell how much a place sees
SEES_MORE = 0.01  # of the points: what chance does not explain
FLIP_RADII = 1000.0  # radius of the flip, over that of the points: what is larger sees through surfaces


@dataclass(frozen=True)
class Votes:
    """For each of R points, sums over the directions D that it is seen from.

    Attributes:
        outward: of n.D.
        total: of |n.D|.
        upward: of n.D where D points up.
    """

    outward: Floats
    total: Floats
    upward: Floats


def look(surface: Surface, component: Labels, *, alone: bool) -> Votes:
    """Look at all points of a surface from all around.

    Pixels are as large as points are apart: sparse parts are drawn into images with large pixels, dense parts into
    images with small ones. A point is hidden if one image hides it. Distances between objects do not matter.

    Args:
        surface: N points.
        component: (N,) the component of each.
        alone: whether each component is looked at as if there were no others; otherwise they hide each other.
    """
    unit, level = _levels(surface, component)
    label = component if alone else np.zeros_like(component)
    hides, lowest, highest = _pictures(level, label)
    level = (level - lowest.min()).astype(np.int16)
    unit *= 2.0 ** float(lowest.min())
    lowest, highest = lowest - lowest.min(), highest - lowest.min()
    size = 1 << int(SPARE_PIXELS * max(1, hides.sum())).bit_length()
    key, top, bottom = np.zeros(size, dtype=np.uint64), np.empty(size), np.empty(size)
    votes = np.zeros((len(level), 3))
    limit = FARTHEST * unit * PIXEL_SPACINGS
    is_far = max(surface.points.max(), -surface.points.min()) > limit
    points = np.clip(surface.points, -limit, limit) if is_far else surface.points
    for up in directions()[: VIEWS // 2]:
        see(
            points, surface.normals, axes_across(up), PIXEL_SPACINGS * unit, MIN_COSINE, surface.roughness, SLACK,
            level, hides, label, lowest, highest, key, top, bottom, votes,
        )  # fmt: skip
    return Votes(*votes.T)


def _levels(surface: Surface, component: Labels) -> tuple[float, Ints]:
    """Find a spacing and, for each point (N,), how many times it is to be doubled for the point's pixels.

    That is the median spacing of the point's component, or more by up to MAX_OCTAVES where the component is sparser.
    """
    spacing = surface.spacing
    order = np.lexsort((spacing, component))
    sizes = np.bincount(component)
    starts = np.cumsum(sizes) - sizes
    typical = spacing[order][starts + sizes // 2]
    unit = float(np.median(spacing))
    if unit <= 0:  # a single point
        return 1.0, np.zeros(len(spacing), dtype=np.int64)
    base = np.round(np.log2(np.maximum(typical, 1e-300) / unit)).astype(np.int64)
    octave = np.ceil(np.log2(np.maximum(spacing / (unit * 2.0 ** base[component]), 1) - 1e-9))
    return unit, base[component] + np.minimum(octave, MAX_OCTAVES + 1).astype(np.int64)


def _pictures(level: Ints, label: Labels) -> tuple[Bools, Ints, Ints]:
    """Which points (N,) hide others, and the lowest and highest level (L,) of those with each label.

    Levels with few points of a label are taken for those of stray points.
    """
    count = int(label.max()) + 1
    low = int(level.min())
    width = int(level.max()) - low + 1
    place = label.astype(np.int64) * width + level - low
    filled = np.bincount(place, minlength=count * width)
    sizes = np.bincount(label, minlength=count)
    usual = filled.reshape(count, width) >= np.maximum(LEVEL_SHARE * sizes, 1)[:, None]
    lowest = low + usual.argmax(axis=1)
    highest = low + width - 1 - usual[:, ::-1].argmax(axis=1)
    return usual.ravel()[place], lowest, highest


def axes_across(direction: Floats) -> Floats:
    """Two unit vectors across a direction, and itself (3, 3)."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction])


def below_topmost(points: Floats, direction: Floats, pixel: float) -> Floats:
    """Find how far points (N, 3) lie below the topmost one of their pixel (N,), seen from far away in a direction."""
    side, across, _ = axes_across(direction)
    place = [np.floor(along(points, axis) / pixel) for axis in (side, across)]
    row, column = np.clip(place, -FARTHEST_COUNTED, FARTHEST_COUNTED).astype(np.int64)
    # Of objects that lie apart, most pixels are empty.
    pixels, key = np.unique((row - row.min()) * (np.ptp(column) + 1) + column - column.min(), return_inverse=True)
    height, top = along(points, direction), np.full(len(pixels), -np.inf)
    np.maximum.at(top, key, height)
    return np.asarray(top[key] - height)


def extremes_look_inward(surface: Surface, component: Labels, stray: Bools) -> Bools:
    """Which components (C,) have normals that look inward at the points that are farthest out; an open sheet, down.

    In every direction D, a component's farthest points vote n.D, which is positive for an outward normal
    whatever the shape: one point in 100, so that outliers near the surface are outvoted.

    Args:
        surface: N points.
        component: (N,) the component of each.
        stray: (N,) points that have no vote; no component consists of them alone.
    """
    order = np.argsort(component, kind="stable")
    order = order[~stray[order]]
    label, points, normals = component[order], surface.points[order], surface.normals[order]
    sizes = np.bincount(label)
    starts = np.cumsum(sizes) - sizes
    voters = np.ceil(EXTREME_SHARE * sizes).astype(np.int64)
    score, total = np.zeros((2, len(sizes)))
    points -= (points.min(axis=0) + points.max(axis=0)) / 2
    for direction in directions():
        height = along(points, direction)
        least = np.maximum.reduceat(height, starts)
        for c in np.flatnonzero(voters > 1):
            own = height[starts[c] : starts[c] + sizes[c]]
            least[c] = np.partition(own, -voters[c])[-voters[c]]
        extreme = np.flatnonzero(height >= least[label])
        vote = along(normals[extreme], direction)
        count = np.bincount(label[extreme])  # more than the voters where a flat face is the extreme
        score += np.bincount(label[extreme], vote) / count
        total += np.bincount(label[extreme], np.abs(vote)) / count
    sheet = np.abs(score) < MIN_PURITY * total
    return np.where(sheet, looks_down(np.add.reduceat(normals, starts, axis=0)), score < 0)


def taken_from_origin(points: Floats) -> bool:
    """Whether a depth camera at the origin seems to have taken the points (N, 3).

    They lie within its field of view, along z as is usual in a camera's own frame, some far and some near, and it sees
    more of them than any place as far away on their other side, since surfaces hide what is behind them.
    """
    depth = np.abs(points[:, 2])
    near, far = np.quantile(depth, [STRAYS, 1 - STRAYS])
    ahead = abs(int(np.sign(points[:, 2]).sum())) == len(points)
    on_axis = (points[:, :2].min(axis=0) < 0).all() and (points[:, :2].max(axis=0) > 0).all()
    outside = np.mean(np.abs(points[:, :2]).max(axis=1) > FIELD_OF_VIEW * depth)
    if not ahead or not on_axis or outside > STRAYS or far < DEPTH_RANGE * near:
        return False
    sample = points[np.random.default_rng(0).permutation(len(points))[:SAMPLE]]
    middle = sample.mean(axis=0)
    around = middle + directions() * np.linalg.norm(middle)
    behind = around[along(directions(), middle) > 0]
    return _visible_share(sample, np.zeros(3)) > max(_visible_share(sample, place) for place in behind) + SEES_MORE


def _visible_share(points: Floats, place: Floats) -> float:
    """Share of points (N, 3) that can be seen from a place: those on the hull of all, turned inside out around it."""
    from scipy.spatial import ConvexHull, QhullError

    sights = points - place
    length = np.maximum(np.linalg.norm(sights, axis=1, keepdims=True), 1e-300)
    flipped = sights * (2 * FLIP_RADII * length.max() / length - 1)
    try:
        hull = ConvexHull(np.vstack([flipped, np.zeros(3)]))
    except QhullError:  # all in one plane with the place
        return 0.0
    return (len(hull.vertices) - 1) / len(points)


def looks_down(normals: Floats) -> Bools:
    """Which normals (N, 3) have a negative z, or y where z is zero, or x where both are."""
    x, y, z = normals.T
    return np.where(z != 0, z, np.where(y != 0, y, x)) < 0


def directions(count: int = VIEWS) -> Floats:
    """Unit vectors (count, 3), an even number: half a Fibonacci lattice of the sphere, z > 0, and their opposites."""
    half = count // 2
    i = np.arange(half)
    z = (i + 0.5) / half
    angle = i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    upper = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return np.concatenate([upper, -upper])


def along(vectors: Floats, direction: Floats) -> Floats:
    """Products with a direction. BLAS would round them differently on each number of threads."""
    return vectors[:, 0] * direction[0] + vectors[:, 1] * direction[1] + vectors[:, 2] * direction[2]
