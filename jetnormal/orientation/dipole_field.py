"""The dipole field of an oriented surface on a grid: a smoothed indicator, 1 inside and 0 outside.

As in Peng et al., "Shape As Points: A Differentiable Poisson Solver" (2021), the Poisson equation that turns oriented
points into an indicator is solved by Fourier transforms on a periodic grid. Each dipole is a pair of charges a cell
before and behind its point, so that the field is read where the charges are.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MARGIN = 1.3  # side of the periodic box over the largest extent of the points
SMOOTHING = 1.0  # standard deviation, in cells, of the Gaussian that hides the grid


class DipoleField:
    """The field of points whose normals are outward, with the areas that they stand for.

    Args:
        points: (N, 3), not all in one place.
        moments: (N, 3) outward unit normals times areas.
        cells: along each side of the cubic grid.
    """

    def __init__(self, points: Floats, moments: Floats, cells: int) -> None:
        from scipy.fft import fftfreq, irfftn, rfftn

        low, high = points.min(axis=0), points.max(axis=0)
        self._centre = (low + high) / 2
        self._cells = cells
        self.cell = float((high - low).max()) * MARGIN / cells
        charge = np.linalg.norm(moments, axis=1)
        offset = moments * (self.cell / np.where(charge > 0, charge, 1))[:, None]
        grid = np.zeros(cells**3)
        for side in (1, -1):
            for index, weight in self._corners(points - side * offset):
                np.add.at(grid, index, side * charge * weight)
        wave = fftfreq(cells, 1 / cells)
        squared = wave[:, None, None] ** 2 + wave[:, None] ** 2 + np.arange(cells // 2 + 1.0) ** 2
        squared[0, 0, 0] = 1  # the constant, which is not known
        kernel = np.exp(-0.5 * (2 * np.pi * SMOOTHING / cells) ** 2 * squared) / squared
        kernel *= cells**2 / (2 * (2 * np.pi * self.cell) ** 2)
        values = irfftn(rfftn(grid.reshape((cells,) * 3)) * kernel, s=(cells,) * 3)
        self._values = values.ravel() - values[0, 0, 0]  # a corner is farthest from all points

    def at(self, places: Floats) -> Floats:
        """The indicator (Q,) at places (Q, 3) in the points' box or near it."""
        values = np.zeros(len(places))
        for index, weight in self._corners(places):
            values += weight * self._values[index]
        return values

    def drop(self, points: Floats, normals: Floats) -> Floats:
        """How far the indicator falls (Q,) across points (Q, 3) along their normals, over two cells."""
        return self.at(points - normals * self.cell) - self.at(points + normals * self.cell)

    def _corners(self, places: Floats) -> Iterator[tuple[NDArray[np.int64], Floats]]:
        """For each of the eight grid points around places, its indices (Q,) and trilinear weights (Q,)."""
        cells = self._cells
        position = (places - self._centre) / self.cell + cells / 2
        base = np.floor(position)
        weights = base + 1 - position, position - base
        low = base.astype(np.int64)
        for x, y, z in np.ndindex(2, 2, 2):
            index = ((low[:, 0] + x) % cells * cells + (low[:, 1] + y) % cells) * cells + (low[:, 2] + z) % cells
            yield index, weights[x][:, 0] * weights[y][:, 1] * weights[z][:, 2]
