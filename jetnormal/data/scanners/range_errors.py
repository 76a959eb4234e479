"""What goes wrong between a scanner and a surface: errors of the ranges of a raster, and returns that are missing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

STEEPEST = 0.2  # cosine of the incidence at which errors stop to grow


class Readings(NamedTuple):
    """What a scanner reads from a raster of rays.

    Attributes:
        distance: (rows, columns) along the rays; without meaning where nothing came back.
        returned: (rows, columns) which rays gave a point at all.
        labeled: (rows, columns) which of these lie on one surface, and not between two.
    """

    distance: Floats
    returned: Flags
    labeled: Flags


@dataclass(frozen=True)
class RangeErrors:
    """The errors of a scanner. Lengths are in units of the target's size, at the distance `reference`.

    Attributes:
        reference: distance at which the errors have their stated size.
        white: standard deviation of the independent error of each range.
        waves: standard deviation of an error that is smooth over neighboring pixels.
        wave_rows: over how many rows it is smooth; 0 for independent rows.
        wave_columns: over how many columns it is smooth.
        line: standard deviation of an error that all points of a row share.
        range_power: the errors grow with this power of the distance.
        grazing_power: and with this power of one over the cosine of the incidence.
        step: the ranges are multiples of this; 0 leaves them.
        disparity: whether the steps are even in one over the range, as a camera pair measures it.
        beam: standard deviation of the light across a stripe, in gaps between columns, where a camera triangulates.
        curl: how far ranges follow the middle of the light that is left at an edge: 0 not at all, 1 in full.
        mixed: share of the pixels at a jump of depth that lie between the two surfaces.
        grazing: cosine of the incidence at which half of the returns are lost.
        lost: share of the returns that is lost anywhere.
        jump: least step between the depths of two surfaces.
        reach: what is farther away does not return.
    """

    reference: float
    white: float = 0.0
    waves: float = 0.0
    wave_rows: float = 0.0
    wave_columns: float = 1.0
    line: float = 0.0
    range_power: float = 0.0
    grazing_power: float = 0.0
    step: float = 0.0
    disparity: bool = False
    beam: float = 0.0
    curl: float = 0.0
    mixed: float = 0.0
    grazing: float = 0.05
    lost: float = 0.0
    jump: float = 0.005
    reach: float = np.inf

    def read(self, distance: Floats, cosine: Floats, gaps: tuple[Floats, Floats], rng: np.random.Generator) -> Readings:
        """Measure true distances.

        Args:
            distance: (rows, columns) along the rays; infinite where there is no surface.
            cosine: (rows, columns) of the incidence there.
            gaps: (rows, columns) between each ray and the next of its column, and the next of its row, at the surface.
            rng: source of randomness.
        """
        hit = np.isfinite(distance)
        true = np.where(hit, distance, 0.0)
        returned = hit & (rng.random(true.shape) > self.lost) & self._strong(cosine, rng)
        mixed, between = self._mixed_pixels(true, hit, cosine, gaps, rng)
        growth = (true / self.reference) ** self.range_power / np.maximum(cosine, STEEPEST) ** self.grazing_power
        measured = self._rounded(between + growth * self._unit_errors(true.shape, rng))
        returned &= (measured > 0) & (true < self.reach)
        return Readings(measured, returned, returned & ~mixed)

    def _strong(self, cosine: Floats, rng: np.random.Generator) -> Flags:
        """Which returns are strong enough: all near the perpendicular, half at the cosine `grazing`, none at zero."""
        return cosine > self.grazing * 2 * rng.random(cosine.shape)

    def _mixed_pixels(
        self, true: Floats, hit: Flags, cosine: Floats, gaps: tuple[Floats, Floats], rng: np.random.Generator
    ) -> tuple[Flags, Floats]:
        """Which pixels lie between two surfaces, and the distances with those.

        A beam is about as wide as the columns are apart, so that rows farther apart seldom share one.
        """
        mixed, between = np.zeros(true.shape, dtype=bool), true.copy()
        if self.mixed == 0:
            return mixed, between
        slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, 0.05)
        narrow = np.minimum(gaps[1].mean() / max(float(gaps[0].mean()), 1e-12), 1.0)
        for axis, step, share in ((0, -1, narrow), (0, 1, narrow), (1, -1, 1.0), (1, 1, 1.0)):
            other, present, steep = (shifted(array, step, axis) for array in (true, hit, slope))
            # One surface, seen at this angle, changes by the gap times the slope from ray to ray.
            jump = np.abs(other - true) > self.jump + 3 * gaps[axis] * np.maximum(slope, steep)
            edge = hit & present & jump & ~mixed & (rng.random(true.shape) < self.mixed * share)
            between = np.where(edge, true + rng.random(true.shape) * (other - true), between)
            mixed |= edge
        return mixed, between

    def _unit_errors(self, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
        """Errors at the reference distance, seen perpendicularly."""
        errors = self.white * rng.standard_normal(shape)
        if self.waves:
            errors += self.waves * smooth_noise(shape, (self.wave_rows, self.wave_columns), rng)
        if self.line:
            errors += self.line * rng.standard_normal((shape[0], 1))
        return errors

    def _rounded(self, distance: Floats) -> Floats:
        """The distances in steps, which have the stated size at the reference."""
        if self.step == 0:
            return distance
        if not self.disparity:
            return self.step * np.round(distance / self.step)
        # A step ds of s = 1 / t is a step t^2 ds of t.
        ds = self.step / self.reference**2
        inverse = ds * np.maximum(np.round(1 / np.maximum(distance, 1e-6) / ds), 1)
        return 1 / inverse


def shifted(array: NDArray[Any], step: int, axis: int) -> NDArray[Any]:
    """Return what lies `step` pixels further along an axis of a raster; zero beyond its border."""
    result = np.zeros_like(array)
    source, goal = [slice(None)] * array.ndim, [slice(None)] * array.ndim
    size = array.shape[axis]
    if abs(step) < size:
        source[axis] = slice(max(step, 0), size + min(step, 0))
        goal[axis] = slice(max(-step, 0), size + min(-step, 0))
        result[tuple(goal)] = array[tuple(source)]
    return result


def smooth_noise(shape: tuple[int, ...], width: tuple[float, float], rng: np.random.Generator) -> Floats:
    """Gaussian noise (rows, columns) of unit variance, smooth over `width` rows and columns."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(rng.standard_normal(shape).astype(np.float32), width, mode="reflect", truncate=3.0)
    return noise.astype(np.float64) / max(float(noise.std()), 1e-12)


class RandomField:
    """A smooth random function of the place, with about zero mean and unit variance.

    A sum of plane waves with normally distributed wave vectors, which is nearly a Gaussian process of Gaussian
    covariance.
    """

    _WAVES = 48

    def __init__(self, wavelength: float, rng: np.random.Generator) -> None:
        """Draw the function; its bumps and dents are about half a wavelength wide."""
        self._vectors = rng.normal(scale=2 * np.pi / wavelength, size=(3, self._WAVES)).astype(np.float32)
        self._phases = rng.uniform(0, 2 * np.pi, self._WAVES).astype(np.float32)

    def __call__(self, points: Floats) -> Floats:
        """Evaluate the function at points (N, 3): (N,)."""
        angles = points.astype(np.float32) @ self._vectors + self._phases
        return np.asarray(np.cos(angles).sum(1) * np.sqrt(2 / self._WAVES), dtype=np.float64)
