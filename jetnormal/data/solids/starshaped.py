"""Smooth primitives around the origin, a radius for each direction: ellipsoids, superellipsoids and bumpy spheres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from jetnormal.data.solids.grids import SIDES, half_circle, revolved
from jetnormal.data.solids.sampling import Floats, normalized, rejected
from jetnormal.geometry.vectors import fibonacci_sphere
from jetnormal.mesh import Mesh


class StarShaped:
    """A surface met once by each ray from the origin.

    A subclass gives `_radius` and `_normals`. A cone of directions d_omega cuts out the area
    r^2 / cos(ray, normal) d_omega, which makes uniform directions uniform points by rejection.
    """

    def __init__(self) -> None:
        directions = fibonacci_sphere(8192)
        density = self._density(directions)
        self._largest_density = 1.15 * density.max()  # the grid may miss the maximum
        self.area = float(4 * np.pi * density.mean())

    def _radius(self, directions: Floats) -> Floats:
        """Distance of the surface, (N,), along unit directions (N, 3)."""
        raise NotImplementedError

    def _normals(self, directions: Floats) -> Floats:
        """Outward unit normals (N, 3) of the surface along unit directions (N, 3)."""
        raise NotImplementedError

    def _density(self, directions: Floats) -> Floats:
        cosine = (directions * self._normals(directions)).sum(axis=1)
        return self._radius(directions) ** 2 / cosine

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        directions = rejected(
            lambda n: normalized(rng.normal(size=(n, 3))),
            lambda proposed: self._density(proposed) / self._largest_density,
            count,
            rng,
        )
        return self.at(directions)

    def at(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the points of the surface along unit directions (N, 3), and the outward unit normals there."""
        return self._radius(directions)[:, None] * directions, self._normals(directions)

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`."""
        distance = np.linalg.norm(points, axis=1)
        return distance - self._radius(points / np.maximum(distance, 1e-12)[:, None])

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        sphere = revolved(*half_circle(-np.pi / 2, np.pi / 2, SIDES // 2 + 1))
        return Mesh(self._radius(sphere.vertices)[:, None] * sphere.vertices, sphere.faces)


class Superellipsoid(StarShaped):
    """sum |x_i / a_i|^p <= 1: an ellipsoid for p = 2, nearer to a box the larger p is."""

    def __init__(self, semi_axes: ArrayLike, exponent: float = 2.0) -> None:
        """Set the (3,) positive semi-axes and the exponent, at least 2."""
        self._semi_axes = np.asarray(semi_axes, dtype=np.float64)
        self._exponent = exponent
        super().__init__()

    def _radius(self, directions: Floats) -> Floats:
        return ((np.abs(directions) / self._semi_axes) ** self._exponent).sum(axis=1) ** (-1 / self._exponent)

    def _normals(self, directions: Floats) -> Floats:
        # The gradient only depends on the direction, up to its length.
        scaled = directions / self._semi_axes
        return normalized(np.sign(scaled) * np.abs(scaled) ** (self._exponent - 1) / self._semi_axes)


class BumpySphere(StarShaped):
    """The unit sphere with plane waves on it: r(u) = 1 + sum a_k sin(w_k . u + phase_k)."""

    def __init__(self, amplitudes: ArrayLike, waves: ArrayLike, phases: ArrayLike) -> None:
        """Set K waves.

        Args:
            amplitudes: (K,), absolute values adding up to less than 1.
            waves: (K, 3) wave vectors.
            phases: (K,).
        """
        self._amplitudes = np.asarray(amplitudes, dtype=np.float64)
        self._waves = np.asarray(waves, dtype=np.float64)
        self._phases = np.asarray(phases, dtype=np.float64)
        super().__init__()

    def _radius(self, directions: Floats) -> Floats:
        return 1 + np.sin(directions @ self._waves.T + self._phases) @ self._amplitudes

    def _normals(self, directions: Floats) -> Floats:
        # Gradient of |x| - r(x / |x|) on the surface: u minus the tangential part of r's gradient over r.
        slopes = (np.cos(directions @ self._waves.T + self._phases) * self._amplitudes) @ self._waves
        tangential = slopes - (slopes * directions).sum(axis=1, keepdims=True) * directions
        return normalized(directions - tangential / self._radius(directions)[:, None])
