"""Meshes of surfaces that are grids: of a half circle turned around z, or of the directions of the sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.mesh import Mesh

Floats = NDArray[np.float64]
SIDES = 192  # of a full turn


def revolved(rho: Floats, z: Floats, *, ring: bool = False) -> Mesh:
    """Turn a profile (K,) around z.

    Args:
        rho: distances from the axis, bottom up along the outside.
        z: heights.
        ring: whether the profile is closed; otherwise it starts and ends on the axis.
    """
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    vertices = np.stack(np.broadcast_arrays(
        rho[:, None] * np.cos(angle), rho[:, None] * np.sin(angle), z[:, None]), axis=-1)  # fmt: skip
    return Mesh(vertices.reshape(-1, 3), grid_faces(len(rho), SIDES, rows_wrap=ring))


def half_circle(start: float, end: float, count: int) -> tuple[Floats, Floats]:
    """Return cosines and sines of `count` angles from start to end."""
    angle = np.linspace(start, end, count)
    return np.cos(angle), np.sin(angle)


def grid_faces(rows: int, columns: int, *, rows_wrap: bool = False) -> NDArray[np.int64]:
    """Return triangles (F, 3) of a grid of vertices, row by row, whose columns close to rings; rows, too, if asked."""
    row, column = np.meshgrid(np.arange(rows if rows_wrap else rows - 1), np.arange(columns), indexing="ij")
    corner = (row * columns + column).ravel()
    beside = (row * columns + (column + 1) % columns).ravel()
    above = ((row + 1) % rows * columns + column).ravel()
    across = ((row + 1) % rows * columns + (column + 1) % columns).ravel()
    return np.concatenate([np.stack([corner, beside, across], 1), np.stack([corner, across, above], 1)])


def open_grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Return triangles (F, 3) of a grid of vertices, row by row, that closes nowhere."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    across = corner + columns + 1
    return np.concatenate([np.stack([corner, corner + 1, across], 1), np.stack([corner, across, corner + columns], 1)])
