"""The dipole field of an oriented surface on a grid: a smoothed indicator, 1 inside and 0 outside.

As in Peng et al., "Shape As Points: A Differentiable Poisson Solver" (2021), the Poisson equation that turns oriented
points into an indicator is solved by Fourier transforms on a periodic grid. Each dipole is a pair of charges a cell
before and behind its point, so that the field is read where the charges are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.orientation.agreement import Labels, Surface, chunks
from jetnormal.orientation.kernels.fields import add_dipoles, add_falls
from jetnormal.support.device import available_cores

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NOISY = 0.15  # roughness over spacing
NOISY_SHARE = 0.01  # of an object's points; fewer are at edges
STRAY_RADII = 5.0  # neighborhood radius, over the median of an object
CELL_SPACINGS = 1.0  # side of the field's cells
MAX_CELL_SPACINGS = 4.0  # a coarser field knows less than the neighbors
MIN_CELLS, MAX_CELLS = 18, 256  # along the field's side
CELLS_PER_POINT = 40.0
ROUNDS = 4
BORDER = 3  # cells around the points' box: charges are a cell beside their points, and spread over the next
MARGIN = 1.3  # side of the periodic box over the largest extent of the points
SMOOTHING = 0.7  # standard deviation, in cells, of the Gaussian that hides the grid


def contradicted(surface: Surface, label: Labels) -> tuple[NDArray[np.bool_], Floats]:
    """Find noisy points that the field of their object's points contradicts.

    Each object has a field of its own: closed surfaces do not influence each other, and a common grid would be as
    coarse as they are far apart.

    Args:
        surface: N points with outward normals, most of them right.
        label: (N,) the object of each, or -1: it is left alone.

    Returns:
        Which normals to flip (N,), and how sure the field is of each sign then (N,), 0 to 1; 1 where it was not used.
    """
    strength = np.ones(len(label))
    noisy = (surface.roughness > NOISY * surface.spacing) & (label >= 0)
    flips = np.zeros(len(label), dtype=np.bool_)
    if not noisy.any():
        return flips, strength
    share = np.bincount(label[label >= 0], noisy[label >= 0]) / np.maximum(np.bincount(label[label >= 0]), 1)
    for one in np.flatnonzero(share > NOISY_SHARE):
        rows = np.flatnonzero(label == one)
        rows = rows[surface.radius[rows] <= STRAY_RADII * np.median(surface.radius[rows])]
        found = _field_strength(surface, rows, noisy[rows])
        strength[rows], flips[rows] = np.abs(found), found < 0
    return flips, strength


def _field_strength(surface: Surface, rows: Ints, noisy: NDArray[np.bool_]) -> Floats:
    """How far the field of points (n,) agrees with the normals of the noisy ones (n,), -1 to 1; 1 for the others."""
    strength = np.ones(len(rows))
    field = DipoleField(surface.points, rows, surface.spacing)
    asked = np.flatnonzero(noisy & (surface.spacing[rows] * MAX_CELL_SPACINGS > field.cell))
    for _ in range(ROUNDS if len(asked) else 0):  # of a cloud of many millions, the field knows less than the neighbors
        field.solve(surface.normals, surface.spacing, strength)
        drop = field.drop(surface.normals, rows[asked])
        scale = np.median(np.abs(drop))
        strength[asked] = np.clip(drop / scale, -1, 1) if scale > 0 else 1
    return strength


class DipoleField:
    """The field of points whose normals are outward, on a cubic grid around them.

    Args:
        points: (N, 3).
        rows: (n,) which of them have the field; they are not all in one place.
        spacing: (N,) distance between points around each.
    """

    def __init__(self, points: Floats, rows: Ints, spacing: Floats) -> None:
        parts = [rows[part] for part in chunks(len(rows))]
        low = np.min([points[part].min(axis=0) for part in parts], axis=0)
        high = np.max([points[part].max(axis=0) for part in parts], axis=0)
        extent = float((high - low).max())
        self._cells = _cells(extent, float(np.median(spacing[rows])), len(rows))
        self.cell = extent * MARGIN / self._cells
        # Around the box of the points, there are no charges, and nobody asks for the field.
        around = (self._cells - (high - low) / self.cell) / 2
        self._shape = self._cells - 2 * np.maximum(around.astype(np.int64) - BORDER, 0)
        self._corner = (low + high) / 2 - self.cell * self._shape / 2
        self._points, self._rows = points, rows
        self._response = _response(self._cells) * np.float32(self._cells**2 / self.cell**2)

    def solve(self, normals: Floats, spacing: Floats, strength: Floats) -> None:
        """Find the field of outward unit normals (N, 3), each times its strength (n,) and its spacing (N,) squared."""
        from scipy.fft import fft, ifft, irfft, rfft

        cells, (width, depth, height) = self._cells, self._shape
        workers = available_cores()  # the values do not depend on them
        values = np.zeros(self._shape, dtype=np.float32)
        moments = strength * spacing[self._rows] ** 2
        add_dipoles(self._points, normals, self._rows, moments, self._corner, self.cell, values)
        spectrum = fft(rfft(values, cells, axis=2, workers=workers), cells, axis=1, workers=workers)
        spectrum = fft(spectrum, cells, axis=0, workers=workers)
        spectrum *= self._response
        spectrum = ifft(spectrum, axis=0, workers=workers, overwrite_x=True)[:width]
        spectrum = ifft(spectrum, axis=1, workers=workers)[:, :depth]
        self._values = np.ascontiguousarray(irfft(spectrum, cells, axis=2, workers=workers)[:, :, :height])

    def drop(self, normals: Floats, rows: Ints) -> Floats:
        """How far the indicator falls across some points (Q,) along their normals, among all (N, 3), over two cells."""
        result = np.zeros(len(rows))
        add_falls(self._points, normals, rows, self._corner, self.cell, self._values, result)
        return result


def _cells(extent: float, spacing: float, points: int) -> int:
    """Cells along a field's side: as the spacing requires, but in all not many more than there are points."""
    from scipy.fft import next_fast_len

    wanted = MARGIN * extent / (CELL_SPACINGS * spacing)
    most = min(MAX_CELLS, np.cbrt(CELLS_PER_POINT * points))
    return int(next_fast_len(int(np.clip(wanted, MIN_CELLS, max(MIN_CELLS, most))), real=True))


def _response(cells: int) -> NDArray[np.float32]:
    """The smoothed field of a unit charge, at the wave numbers of a grid with cells of side one."""
    from scipy.fft import fftfreq

    wave = fftfreq(cells, 1 / cells) ** 2
    across = wave[:, None] + np.arange(cells // 2 + 1.0) ** 2
    response = np.empty((cells, *across.shape), dtype=np.float32)
    for plane, along in zip(response, wave, strict=True):  # all at once would take four times as much memory
        squared = along + across
        squared[0, 0] = squared[0, 0] or 1  # the constant, which is not known
        damping = np.exp(-0.5 * (2 * np.pi * SMOOTHING / cells) ** 2 * squared)
        plane[:] = damping / (squared * 2 * (2 * np.pi) ** 2)
    return response
