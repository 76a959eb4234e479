"""What is drawn: points or a mesh, with normals and colors, from one place on in all views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError
from jetnormal.formats.colors import normal_colors, point_colors
from jetnormal.mesh import Mesh

Floats = NDArray[np.float64]

COLORINGS = ("auto", "normals", "file", "plain")
CLAY = (0.80, 0.77, 0.72)
SHARP_DEGREES = 40.0  # by which the normals of a face and of its vertex differ at a sharp edge
SLIVER = 0.3  # area of a face over the mean around it, below which it makes no edge


@dataclass(frozen=True)
class Scene:
    """Points of a cloud, or vertices of a mesh.

    Attributes:
        points: (N, 3), centred.
        normals: (N, 3) unit vectors, zero where unknown.
        colors: (N, 3) from 0 to 1 (sRGB).
        faces: (F, 3) int64, or None for a cloud.
    """

    points: Floats
    normals: Floats
    colors: Floats
    faces: NDArray[np.int64] | None = None

    def turned_up(self, up: Floats) -> Scene:
        """The scene, turned by the smallest rotation that brings direction `up` (3,) to z; colors stay."""
        from scipy.spatial.transform import Rotation

        axis = np.cross(up, [0.0, 0.0, 1.0])
        length = float(np.linalg.norm(axis))
        axis = axis / length if length else np.array([1.0, 0.0, 0.0])
        turn = Rotation.from_rotvec(np.arctan2(length, up[2]) * axis)
        return replace(self, points=turn.apply(self.points), normals=turn.apply(self.normals))

    @property
    def radius(self) -> float:
        """Half the longest side of the points' box."""
        return max(float(np.ptp(self.points, axis=0).max()) / 2, 1e-12)


def cloud_scene(cloud: Cloud, coloring: str = "auto") -> Scene:
    """A cloud to be drawn; rows without finite coordinates are left out.

    Args:
        cloud: the cloud.
        coloring: "normals", "file" (the cloud's own), "plain", or "auto": by normals if it has some, else its own.

    Raises:
        InputError: there is nothing to draw, or no such colors.
    """
    rows = np.flatnonzero(cloud.valid)
    if not len(rows):
        raise InputError("has no finite points: there is nothing to draw")
    normals = np.zeros((len(rows), 3)) if cloud.normals is None else unit(cloud.normals[rows])
    own = point_colors(cloud)
    if coloring == "auto":
        coloring = "normals" if cloud.normals is not None else "file" if own is not None else "plain"
    if coloring == "normals" and cloud.normals is None:
        raise InputError("has no normals to color by; jetnormal estimate adds them")
    return _scene(cloud.points[rows], normals, None if own is None else own[rows], coloring)


def mesh_scene(mesh: Mesh, coloring: str = "auto") -> Scene:
    """A mesh to be drawn, colored as in `cloud_scene`, but "auto" takes its own colors, else none.

    Corners keep the normal of their face where that of the vertex is far from it: edges stay sharp.
    """
    own = mesh.colors
    if coloring == "auto":
        coloring = "file" if own is not None else "plain"
    faces, vertices, normals = mesh.faces, mesh.vertices, mesh.vertex_normals()
    area = mesh.area_vectors()
    size, face_normals = np.linalg.norm(area, axis=1), unit(area)
    total, count = (np.bincount(faces.ravel(), weights, len(vertices)) for weights in (np.repeat(size, 3), None))
    around = total[faces] / count[faces]  # mean area of the faces at each corner
    sharp = np.einsum("fcd,fd->fc", normals[faces], face_normals) < np.cos(np.deg2rad(SHARP_DEGREES))
    sharp &= size[:, None] > SLIVER * around  # slivers have unsure normals
    extra = faces[sharp]  # vertices of their own for the corners at sharp edges
    faces = faces.copy()
    faces[sharp] = len(vertices) + np.arange(len(extra))
    normals = np.concatenate([normals, np.repeat(face_normals, 3, axis=0).reshape(*sharp.shape, 3)[sharp]])
    if own is not None:
        own = np.concatenate([own, own[extra]])
    scene = _scene(np.concatenate([vertices, vertices[extra]]), normals, own, coloring)
    return Scene(scene.points, scene.normals, scene.colors, faces)


def _scene(points: Floats, normals: Floats, own: Floats | None, coloring: str) -> Scene:
    if coloring == "file" and own is None:
        raise InputError("has no colors of its own")
    if coloring == "normals":
        colors = normal_colors(normals)
    else:
        colors = np.tile(CLAY, (len(points), 1)) if coloring == "plain" or own is None else own
    return Scene(points - (points.min(axis=0) + points.max(axis=0)) / 2, normals, colors)


def unit(vectors: Floats) -> Floats:
    """Unit vectors, zero where there is no direction."""
    vectors = np.where(np.isfinite(vectors).all(axis=1, keepdims=True), vectors, 0)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
