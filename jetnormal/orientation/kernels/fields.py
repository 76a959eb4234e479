"""Loops over the field of oriented points: winding numbers, and dipoles on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@compiled
def solid_angle(places: Floats, q: int, points: Floats, moments: Floats, softening: Floats, i: int) -> Any:
    """Find the solid angle of the oriented point i, see `solid_angles`, at the place q."""
    squared, flux = softening[i], 0.0
    for axis in range(3):
        step = points[i, axis] - places[q, axis]
        squared += step * step
        flux += moments[i, axis] * step
    return flux / (squared * np.sqrt(squared))


def solid_angles(places: Floats, points: Floats, moments: Floats, softening: Floats) -> Floats:
    """Find the winding number (Q,) at places (Q, 3) of oriented points (N, 3) with moments (N, 3): normals times areas.

    softening (N,) is added to each squared distance: a point is no nearer than the area it stands for is wide.
    """
    result = np.zeros(len(places))
    _add_solid_angles(places, points, moments, softening, result)
    return result / (4 * np.pi)


@compiled
def _add_solid_angles(places: Floats, points: Floats, moments: Floats, softening: Floats, result: Floats) -> None:
    for q in range(len(places)):
        for i in range(len(points)):
            result[q] += solid_angle(places, q, points, moments, softening, i)


@compiled
def add_windings(
    places: Floats, receiver: Ints, points: Floats, moments: Floats, softening: Floats, sender: Ints, total: Any
) -> None:
    """Add the solid angles of oriented points (N, 3), see `solid_angles`, at places (Q, 3) to total (R, S), float32.

    receiver (Q,) and sender (N,): the row and the column to which a place and a point belong.
    """
    for q in range(len(places)):
        for i in range(len(points)):
            total[receiver[q], sender[i]] += solid_angle(places, q, points, moments, softening, i)


@compiled
def grid_axis(coordinate: float, corner: float, cell: float, cells: int) -> Any:
    """The two places around a coordinate along one axis of a periodic grid, each with its linear weight."""
    position = (coordinate - corner) / cell
    base = np.floor(position)
    low = np.int64(base) % cells
    return (low, base + 1 - position), ((low + 1) % cells, position - base)


@compiled
def add_dipoles(points: Floats, moments: Floats, corner: Floats, cell: float, grid: Any) -> None:
    """Add charges |m| a cell behind each point (N, 3), seen along its moment m (N, 3), and -|m| as far before it.

    Charges are spread over the eight nearest places of a periodic grid (G, G, G), float32, whose first is at `corner`.
    """
    for i in range(len(points)):
        charge = np.sqrt(moments[i, 0] ** 2 + moments[i, 1] ** 2 + moments[i, 2] ** 2)
        if charge == 0:
            continue
        for side in (charge, -charge):
            step = -cell / side
            across = grid_axis(points[i, 0] + step * moments[i, 0], corner[0], cell, len(grid))
            along = grid_axis(points[i, 1] + step * moments[i, 1], corner[1], cell, len(grid))
            up = grid_axis(points[i, 2] + step * moments[i, 2], corner[2], cell, len(grid))
            for x, in_x in across:
                for y, in_y in along:
                    for z, in_z in up:
                        grid[x, y, z] += side * in_x * in_y * in_z


def read_grid(places: Floats, corner: Floats, cell: float, grid: Any) -> Floats:
    """Interpolate a periodic grid (G, G, G), float32, whose first place is at `corner`, at places (Q, 3)."""
    result = np.zeros(len(places))
    _add_grid(places, corner, cell, grid, result)
    return result


@compiled
def _add_grid(places: Floats, corner: Floats, cell: float, grid: Any, result: Floats) -> None:
    for i in range(len(places)):
        across = grid_axis(places[i, 0], corner[0], cell, len(grid))
        along = grid_axis(places[i, 1], corner[1], cell, len(grid))
        up = grid_axis(places[i, 2], corner[2], cell, len(grid))
        for x, in_x in across:
            for y, in_y in along:
                for z, in_z in up:
                    result[i] += in_x * in_y * in_z * grid[x, y, z]
