"""Triangle meshes as a source of points with known normals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from jetnormal.errors import InputError
from jetnormal.formats.meshes import read_mesh
from jetnormal.geometry.vectors import unit
from jetnormal.mesh import Mesh

CREASE_DEGREES = 35.0  # neighboring faces that turn by more meet in a sharp edge


def load_mesh(path: Path | str) -> Mesh:
    """Read a triangle mesh.

    Vertices at exactly the same place become one, so that STL triangles know their neighbors.

    Raises:
        InputError: as `formats.meshes.read_mesh`, and if all faces are degenerate.
    """
    mesh = read_mesh(path)
    if not mesh.area_vectors().any():
        raise InputError(f"{path}: all its faces are degenerate")
    vertices, merged = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh(vertices, merged.reshape(-1)[mesh.faces])


class MeshSampler:
    """Draw points that are uniform over the surface of a mesh, with outward unit normals.

    The normal of a point is interpolated over its face from the normals of the face's corners. A corner's
    normal is the mean, weighted by angle, of the faces around the vertex that turn by at most 35 degrees
    from the corner's own face: curved regions are smooth and creases stay sharp. A closed mesh whose faces
    are wound inwards is turned around; an open one is taken as it is.
    """

    def __init__(self, mesh: Mesh, corner_normals: NDArray[np.float64] | None = None) -> None:
        """Compute areas and corner normals once.

        Args:
            mesh: with a face that has an area.
            corner_normals: (F, 3, 3) unit normals at the faces' corners, where they are known. A face whose corners
                have the normal zero has none: that of its points is zero.
        """
        corners, doubled = mesh.vertices[mesh.faces], 2 * mesh.area_vectors()
        areas = np.linalg.norm(doubled, axis=1) / 2
        self._cumulative_area = np.cumsum(areas)
        self.mesh = mesh
        if corner_normals is None:
            inward = _encloses_negative_volume(corners, doubled)
            self.face_normals = unit(-doubled if inward else doubled)
            self._corner_normals = _corner_normals(mesh.faces, corners, self.face_normals)
        else:
            side = np.sign((doubled * corner_normals.sum(1)).sum(1, keepdims=True))
            self.face_normals = unit(side * doubled)
            self._corner_normals = corner_normals

    @property
    def area(self) -> float:
        """Area of the surface."""
        return float(self._cumulative_area[-1])

    def sample(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return `count` points uniform over the surface, (count, 3), and their unit normals, (count, 3)."""
        # Side "right" skips faces without area; rounding may reach past the last face.
        face = np.searchsorted(self._cumulative_area, rng.random(count) * self.area, side="right")
        face = np.minimum(face, len(self._cumulative_area) - 1)
        u, v = rng.random((2, count))
        outside = u + v > 1
        u[outside], v[outside] = 1 - u[outside], 1 - v[outside]
        return self.at(face, u, v)

    def at(
        self, face: NDArray[np.int64], u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (N, 3) on faces (N,) and their unit normals (N, 3).

        A point is (1 - u - v) a + u b + v c, where a, b and c are the corners of its face.
        """
        weights = np.stack([1 - u - v, u, v], axis=1)[:, None, :]
        points = (weights @ self.mesh.vertices[self.mesh.faces[face]])[:, 0]
        normals = (weights @ self._corner_normals[face])[:, 0]
        return points, unit(normals, otherwise=self.face_normals[face])


def _corner_normals(
    faces: NDArray[np.int64], corners: NDArray[np.float64], face_normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Normals of the faces' corners, (F, 3, 3), averaged by angle inside each smoothing group."""
    edges = unit(np.roll(corners, -1, axis=1) - corners)
    angles = np.arccos(np.clip(-(edges * np.roll(edges, 1, axis=1)).sum(2), -1, 1)).reshape(-1)
    corner = np.arange(faces.size)
    incidence = sparse.csr_matrix((np.ones(faces.size, np.int8), (corner, faces.reshape(-1))))
    pairs = (incidence @ incidence.T).tocoo()  # all pairs of corners that share a vertex
    turn = (face_normals[pairs.row // 3] * face_normals[pairs.col // 3]).sum(1)
    smooth = turn > np.cos(np.deg2rad(CREASE_DEGREES))
    row, col = pairs.row[smooth], pairs.col[smooth]
    weights = sparse.csr_matrix((angles[col], (row, col)), shape=(faces.size, faces.size))
    own = np.repeat(face_normals, 3, axis=0)
    return unit(weights @ own, otherwise=own).reshape(-1, 3, 3)


def _encloses_negative_volume(corners: NDArray[np.float64], doubled: NDArray[np.float64]) -> bool:
    """Whether the faces form a closed surface that is wound inwards.

    The area vectors of a closed surface add up to zero, and only then is the volume below independent of
    the origin.
    """
    closed = np.linalg.norm(doubled.sum(0)) <= 1e-6 * np.linalg.norm(doubled, axis=1).sum()
    centered = corners[:, 0] - corners[:, 0].mean(0)
    return bool(closed and (centered * doubled).sum() < 0)
