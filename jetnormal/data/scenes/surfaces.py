"""Pieces of surface with exact normals, from which scenes are put together. Lengths are meters, z is up.

Pieces may be open, and may pass through each other: what is inside another piece cannot be seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jetnormal.data.solids.grids import open_grid_faces
from jetnormal.data.solids.starshaped import StarShaped
from jetnormal.geometry.vectors import unit

Floats = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class Piece:
    """A piece of surface.

    Attributes:
        vertices: (V, 3) float64.
        normals: (V, 3) float64 unit normals at the vertices; zero on what has no normal that can be measured, such as
            leaves.
        faces: (F, 3) int64.
    """

    vertices: Floats
    normals: Floats
    faces: NDArray[np.int64]

    def placed(self, shift: ArrayLike, yaw: float = 0.0) -> Piece:
        """Return the piece, turned around z and moved."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return Piece(self.vertices @ turn.T + np.asarray(shift), self.normals @ turn.T, self.faces)


def joined(pieces: Iterable[Piece]) -> Piece:
    """Join pieces into one."""
    pieces = list(pieces)
    starts = np.cumsum([0] + [len(piece.vertices) for piece in pieces[:-1]])
    return Piece(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.normals for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
    )


def grid(points: Floats, normals: Floats) -> Piece:
    """Make the surface through a grid of points (R, C, 3) with normals (R, C, 3), which need not have unit length."""
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = normals / np.where(length > 0, length, 1)
    faces = open_grid_faces(points.shape[0], points.shape[1])
    return Piece(points.reshape(-1, 3), unit.reshape(-1, 3), faces)


def rectangle(corner: ArrayLike, along: ArrayLike, across: ArrayLike) -> Piece:
    """Make a rectangle at a corner, with two sides; its normal is along x across."""
    corner, along, across = (np.asarray(value, dtype=np.float64) for value in (corner, along, across))
    points = np.array([[corner, corner + along], [corner + across, corner + along + across]])
    return grid(points, np.broadcast_to(np.cross(along, across), points.shape))


def box(size: ArrayLike, shift: ArrayLike = (0.0, 0.0, 0.0)) -> Piece:
    """Make a box of a size (3,) that stands on `shift`, (3,), the middle of its bottom."""
    x, y, z = np.asarray(size, dtype=np.float64)
    ex, ey, ez = np.diag([x, y, z])
    low, high = np.array([-x / 2, -y / 2, 0.0]), np.array([x / 2, y / 2, z])
    faces = [
        rectangle(low, ey, ex), rectangle(low, ex, ez), rectangle(low, ez, ey),
        rectangle(high, -ex, -ey), rectangle(high, -ez, -ex), rectangle(high, -ey, -ez),
    ]  # fmt: skip
    return joined(faces).placed(shift)


def frustum(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None) -> Piece:
    """Make a cylinder or cone between two points, closed by discs."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    end_radius = radius if end_radius is None else end_radius
    length = np.linalg.norm(end - start)
    axis = (end - start) / length
    side, other = perpendicular(axis)
    angle = np.linspace(0, 2 * np.pi, sides(max(radius, end_radius)) + 1)[None, :, None]
    around = np.cos(angle) * side + np.sin(angle) * other
    wall = grid(
        np.concatenate([start + radius * around, end + end_radius * around]),
        np.repeat(around + (radius - end_radius) / length * axis, 2, axis=0),
    )
    return joined([wall, _disc(start, around, radius, -axis), _disc(end, around, end_radius, axis)])


def _disc(middle: Floats, around: Floats, radius: float, normal: Floats) -> Piece:
    points = np.concatenate([np.broadcast_to(middle, around.shape), middle + radius * around])
    return grid(points, np.broadcast_to(normal, points.shape))


def tube(path: Sequence[ArrayLike], radius: float, bend: float) -> Piece:
    """Make a pipe along straight pieces between points, with elbows whose middle line has the radius `bend`."""
    corners = [np.asarray(point, dtype=np.float64) for point in path]
    pieces, begin = [], corners[0]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        into, out = unit(corner - before), unit(after - corner)
        turn = float(np.arccos(np.clip(into @ out, -1, 1)))
        if turn < 1e-6:
            continue
        cut = bend * np.tan(turn / 2)
        pieces.append(frustum(begin, corner - cut * into, radius))
        pieces.append(_elbow(corner - cut * into, into, out, turn, radius, bend))
        begin = corner + cut * out
    return joined([*pieces, frustum(begin, corners[-1], radius)])


def _elbow(start: Floats, into: Floats, out: Floats, turn: float, radius: float, bend: float) -> Piece:
    inner = unit(out - (out @ into) * into)  # toward the middle of the arc
    middle, across = start + bend * inner, np.cross(into, inner)
    swept = np.linspace(0, turn, 13)[:, None, None]
    outward = -np.cos(swept) * inner + np.sin(swept) * into
    angle = np.linspace(0, 2 * np.pi, sides(radius) + 1)[None, :, None]
    normals = np.cos(angle) * outward + np.sin(angle) * across
    return grid(middle + bend * outward + radius * normals, normals)


def turned(rho: ArrayLike, z: ArrayLike) -> Piece:
    """Turn a profile of straight pieces around z: (K,) distances from z and heights, bottom up along the outside."""
    rho, z = np.asarray(rho, dtype=np.float64), np.asarray(z, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, sides(rho.max()) + 1)[None, :]
    cos, sin = np.cos(angle), np.sin(angle)
    rings = []
    for lower, upper, low, high in zip(rho, rho[1:], z, z[1:], strict=False):
        across, along = high - low, lower - upper
        ends = np.array([[lower], [upper]]), np.array([[low], [high]])
        points = np.stack(np.broadcast_arrays(ends[0] * cos, ends[0] * sin, ends[1]), axis=-1)
        normals = np.stack(np.broadcast_arrays(across * cos, across * sin, along), axis=-1)
        rings.append(grid(points, np.repeat(normals, 2, axis=0)))
    return joined(rings)


def lathe(height: float, profile: Callable[[Floats], tuple[Floats, Floats]]) -> Piece:
    """Turn a smooth profile around z, from 0 to a height; it gives the distance from the axis and its slope."""
    z = np.linspace(0, height, 65)[:, None]
    rho, slope = profile(z)
    angle = np.linspace(0, 2 * np.pi, sides(float(rho.max())) + 1)[None, :]
    cos, sin = np.cos(angle), np.sin(angle)
    points = np.stack(np.broadcast_arrays(rho * cos, rho * sin, z), axis=-1)
    return grid(points, np.stack(np.broadcast_arrays(cos, sin, -slope), axis=-1))


def star(shape: StarShaped, shift: ArrayLike = (0.0, 0.0, 0.0), scale: float = 1.0, rows: int = 49) -> Piece:
    """Make an ellipsoid, superellipsoid or bumpy sphere around `shift`."""
    tilt = np.linspace(-np.pi / 2, np.pi / 2, rows)[:, None]
    angle = np.linspace(0, 2 * np.pi, 2 * rows - 1)
    directions = np.stack(
        np.broadcast_arrays(np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)), -1
    )
    points, normals = shape.at(directions.reshape(-1, 3))
    return grid((scale * points).reshape(directions.shape), normals.reshape(directions.shape)).placed(shift)


def height_field(x: Floats, y: Floats, height: Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]) -> Piece:
    """Make the surface z = height(x, y) over a grid of x (C,) and y (R,); height gives z and its two slopes."""
    grid_x, grid_y = np.meshgrid(x, y)
    z, slope_x, slope_y = height(grid_x, grid_y)
    return grid(np.stack([grid_x, grid_y, z], -1), np.stack([-slope_x, -slope_y, np.ones_like(z)], -1))


def standing_sheet(length: float, height: float, offset: Callable[[Floats], tuple[Floats, Floats]]) -> Piece:
    """Make a curtain or corrugated wall y = offset(x) for x from 0 to `length`, from the floor to a height."""
    x = np.linspace(0, length, max(9, round(length / 0.01)))
    y, slope = offset(x)
    points = np.stack([np.stack([x, y, np.full_like(x, level)], -1) for level in (0.0, height)])
    normals = np.stack([slope, -np.ones_like(x), np.zeros_like(x)], -1)
    return grid(points, np.stack([normals, normals]))


def wall(
    length: float, height: float, thickness: float, openings: Sequence[tuple[float, float, float, float]]
) -> Piece:
    """Make a wall from x = 0 to `length` between y = 0 and `thickness`, with openings (x, x, z, z)."""
    xs = sorted({0.0, length, *(value for opening in openings for value in opening[:2])})
    zs = sorted({0.0, height, *(value for opening in openings for value in opening[2:])})
    pieces = []
    for x0, x1 in itertools.pairwise(xs):
        for z0, z1 in itertools.pairwise(zs):
            x, z = (x0 + x1) / 2, (z0 + z1) / 2
            if not any(a < x < b and c < z < d for a, b, c, d in openings):
                size = np.array([x1 - x0, 0, 0]), np.array([0, 0, z1 - z0])
                pieces.append(rectangle([x0, 0, z0], size[0], size[1]))
                pieces.append(rectangle([x0, thickness, z0], size[1], size[0]))
    for a, b, c, d in [(0.0, length, 0.0, height), *openings]:
        deep = np.array([0, thickness, 0])
        long, tall = np.array([b - a, 0, 0]), np.array([0, 0, d - c])
        for corner, side in (([a, 0, c], long), ([a, 0, d], long), ([a, 0, c], tall), ([b, 0, c], tall)):
            pieces.append(rectangle(corner, side, deep))
    return joined(pieces)


def leaves(count: int, size: float, spread: ArrayLike, rng: np.random.Generator) -> Piece:
    """Make small triangles of any direction within an ellipsoid of semi-axes `spread`; their normals are zero."""
    middle = rng.normal(size=(count, 1, 3))
    middle *= rng.random((count, 1, 1)) ** (1 / 4) / np.linalg.norm(middle, axis=2, keepdims=True)
    vertices = middle * np.asarray(spread) + size * rng.normal(scale=0.5, size=(count, 3, 3))
    faces = np.arange(3 * count).reshape(-1, 3)
    return Piece(vertices.reshape(-1, 3), np.zeros((3 * count, 3)), faces)


def sides(radius: float) -> int:
    """Return the number of sides of a circle that stays within half a millimeter of it, or 0.1 % of its radius."""
    return int(np.clip(np.pi / np.sqrt(2 * max(5e-4 / max(radius, 1e-3), 1e-3)), 12, 96))


def perpendicular(axis: Floats) -> tuple[Floats, Floats]:
    """Find two unit vectors that make a right-handed frame with the unit vector `axis` as the third."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    first = unit(np.cross(helper, axis))
    return first, np.cross(axis, first)
