"""A triangle mesh in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, repr=False)
class Mesh:
    """Triangles with shared vertices.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64 indices into `vertices`, counter-clockwise seen from outside.
        colors: (V, 3) float64 red, green and blue from 0 to 1, as on a screen (sRGB), or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colors: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        colors = "" if self.colors is None else ", colors"
        return f"<Mesh: {len(self.vertices):,} vertices, {len(self.faces):,} faces{colors}>"

    def area_vectors(self) -> NDArray[np.float64]:
        """Compute a vector (F, 3) for each face: along its normal, as long as its area."""
        corners = self.vertices[self.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2

    def vertex_normals(self) -> NDArray[np.float64]:
        """Compute unit normals (V, 3): the mean over the faces around, weighted by area; zero where it vanishes."""
        area = self.area_vectors()
        normals = np.stack([_sum_at(self.faces, area[:, axis], len(self.vertices)) for axis in range(3)], axis=1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(length > 0, length, 1)


def _sum_at(faces: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[Any]:
    """Sum the values (F,) of the faces around each of `count` vertices."""
    return np.bincount(faces.ravel(), np.repeat(values, 3), count)
