"""Loops over the field of oriented points: winding numbers, and dipoles on a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.support.compiled import compiled

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


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
            squared, flux = softening[i], 0.0
            for axis in range(3):
                step = points[i, axis] - places[q, axis]
                squared += step * step
                flux += moments[i, axis] * step
            result[q] += flux / (squared * np.sqrt(squared))


@compiled
def sum_solid_angles(
    places: Singles, first: Ints, points: Singles, moments: Singles, softening: Singles, start: Ints, each: Singles,
    total: Singles,
) -> None:  # fmt: skip
    """Sum the solid angles of groups of oriented points, see `solid_angles`, over groups of places.

    Args:
        places: (Q, 3).
        first: (R + 1,) where each group of places begins, and its end.
        points, moments: (3, N).
        softening: (N,).
        start: (S + 1,) where each group of points begins, and its end.
        each: (N,), overwritten.
        total: (R, S), overwritten: the sums.
    """
    for r in range(len(total)):
        for i in range(len(each)):
            each[i] = 0
        for q in range(first[r], first[r + 1]):
            x, y, z = places[q, 0], places[q, 1], places[q, 2]
            for i in range(len(each)):
                to_x, to_y, to_z = points[0, i] - x, points[1, i] - y, points[2, i] - z
                squared = softening[i] + to_x * to_x + to_y * to_y + to_z * to_z
                flux = moments[0, i] * to_x + moments[1, i] * to_y + moments[2, i] * to_z
                each[i] += flux / (squared * np.sqrt(squared))
        for s in range(len(start) - 1):
            angle = np.float32(0)
            for i in range(start[s], start[s + 1]):
                angle += each[i]
            total[r, s] = angle


@compiled
def _along_axis(coordinate: float, corner: float, cell: float) -> Any:
    """The two places around a coordinate along one axis of a grid, each with its linear weight."""
    position = (coordinate - corner) / cell
    base = np.floor(position)
    low = np.int64(base)
    return (low, base + 1 - position), (low + 1, position - base)


@compiled
def _grid_places(points: Floats, normals: Floats, i: Any, step: Any, corner: Floats, cell: float) -> Any:
    """For each axis of a grid, the two places around what lies a step from point i along its normal."""
    return (
        _along_axis(points[i, 0] + step * normals[i, 0], corner[0], cell),
        _along_axis(points[i, 1] + step * normals[i, 1], corner[1], cell),
        _along_axis(points[i, 2] + step * normals[i, 2], corner[2], cell),
    )


@compiled
def add_dipoles(
    points: Floats, normals: Floats, rows: Ints, moments: Floats, corner: Floats, cell: float, grid: Singles
) -> None:
    """Add a charge m (n,) a cell behind each of some points (N, 3), seen along its normal (N, 3), and -m as far before.

    Charges are spread over the eight nearest places of a grid (X, Y, Z), whose first is at `corner`.
    """
    for r in range(len(rows)):
        i = rows[r]
        for side in (-1, 1):
            across, along, up = _grid_places(points, normals, i, side * cell, corner, cell)
            for x, in_x in across:
                for y, in_y in along:
                    for z, in_z in up:
                        grid[x, y, z] -= side * moments[r] * in_x * in_y * in_z


@compiled
def add_falls(
    points: Floats, normals: Floats, rows: Ints, corner: Floats, cell: float, grid: Singles, result: Floats
) -> None:
    """Add how far the values of a grid, see `add_dipoles`, fall across some points along their normals to result (n,).

    They are interpolated a cell behind and a cell before each point.
    """
    for r in range(len(rows)):
        i = rows[r]
        for side in (-1, 1):
            across, along, up = _grid_places(points, normals, i, side * cell, corner, cell)
            for x, in_x in across:
                for y, in_y in along:
                    for z, in_z in up:
                        result[r] -= side * in_x * in_y * in_z * grid[x, y, z]
