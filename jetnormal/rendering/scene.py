"""What is drawn: the points of a cloud or the vertices of a mesh, with normals and colors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError
from jetnormal.formats.colors import normal_colors, point_colors
from jetnormal.geometry.vectors import unit
from jetnormal.mesh import Mesh

Floats = NDArray[np.float64]

CLAY = (0.80, 0.77, 0.72)
UNSURE, SURE = np.array([0.80, 0.15, 0.10]), np.array([0.25, 0.60, 0.85])  # colors of confidence 0 and 1
SHARP_DEGREES = 40.0  # by which the normals of a face and of its vertex differ at a sharp edge
ROUGH_DEGREES = 15.0, 60.0  # between neighboring faces of a rough surface; edges that are meant have more
ROUGH_SHARE = 0.25  # of such edges, from which on a mesh has no edges that are meant
SLIVER = 0.3  # area of a face over the mean around it, below which it makes no edge


@dataclass(frozen=True)
class Scene:
    """Points of a cloud, or vertices of a mesh.

    Attributes:
        points: (N, 3), centered.
        normals: (N, 3) unit vectors, zero where unknown.
        colors: (N, 3) from 0 to 1 (sRGB).
        faces: (F, 3) int64, or None for a cloud.
        coloring: what the colors are: "normals", "file", "confidence" or "plain".
        own: (N, 3) colors of the file, or None.
        confidence: (N,) from 0 to 1, or None.
        turn: (3, 3) the rotation that brought points and normals from the file's axes to these.
    """

    points: Floats
    normals: Floats
    colors: Floats
    faces: NDArray[np.int64] | None = None
    coloring: str = "plain"
    own: Floats | None = None
    confidence: Floats | None = None
    turn: Floats = field(default_factory=lambda: np.eye(3))

    def turned_up(self, up: Floats) -> Scene:
        """Return the scene, turned by the smallest rotation that brings direction `up` (3,) to z; colors stay."""
        from scipy.spatial.transform import Rotation

        up = up / np.abs(up).max()  # of any length
        axis = np.cross(up, [0.0, 0.0, 1.0])
        length = float(np.linalg.norm(axis))
        axis = axis / length if length else np.array([1.0, 0.0, 0.0])
        turn = Rotation.from_rotvec(np.arctan2(length, up[2]) * axis).as_matrix()
        return replace(self, points=self.points @ turn.T, normals=self.normals @ turn.T, turn=turn @ self.turn)

    def in_file_axes(self) -> Scene:
        """Return the scene as it was before it was turned."""
        return replace(self, points=self.points @ self.turn, normals=self.normals @ self.turn, turn=np.eye(3))

    @property
    def radius(self) -> float:
        """Half the longest side of the points' box."""
        return max(float(np.ptp(self.points, axis=0).max()) / 2, 1e-12)


def cloud_scene(cloud: Cloud, coloring: str = "auto") -> Scene:
    """Make the scene of a cloud; rows without finite coordinates are left out.

    Args:
        cloud: the cloud.
        coloring: "normals", "file" (the cloud's own), "confidence" (red is unsure, the attribute of that name),
            "plain", or "auto": by normals if it has some, else its own.

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
    confidence = cloud.attributes.get("confidence")
    scene = Scene(
        _centered(cloud.points[rows]),
        normals,
        normals,
        own=None if own is None else own[rows],
        confidence=None if confidence is None else np.clip(np.nan_to_num(confidence[rows].astype(np.float64)), 0, 1),
    )
    return _colored(scene, coloring)


def mesh_scene(mesh: Mesh, coloring: str = "auto") -> Scene:
    """Make the scene of a mesh, colored as in `cloud_scene`, but "auto" takes its own colors, else none.

    Corners keep the normal of their face where that of the vertex is far from it, so that edges stay sharp; but a rough
    surface, such as that of a scan, is shaded smoothly all over.
    """
    own = mesh.colors
    if coloring == "auto":
        coloring = "file" if own is not None else "plain"
    faces, vertices, normals = mesh.faces, mesh.vertices, mesh.vertex_normals()
    sharp = _sharp_corners(mesh, normals)
    extra = faces[sharp]  # vertices of their own for the corners at sharp edges
    faces = faces.copy()
    faces[sharp] = len(vertices) + np.arange(len(extra))
    own_normals = np.repeat(unit(mesh.area_vectors()), 3, axis=0).reshape(*sharp.shape, 3)[sharp]
    points = np.concatenate([vertices, vertices[extra]])
    normals = np.concatenate([normals, own_normals])
    own = None if own is None else np.concatenate([own, own[extra]])
    return _colored(Scene(_centered(points), normals, normals, faces, own=own), coloring)


def _sharp_corners(mesh: Mesh, normals: Floats) -> NDArray[np.bool_]:
    """(F, 3) bool: corners at which the normal of the face is far from that of the vertex, given normals (V, 3)."""
    faces, area = mesh.faces, mesh.area_vectors()
    size, face_normals = np.linalg.norm(area, axis=1), unit(area)
    if _is_rough(faces, face_normals):
        return np.zeros(faces.shape, dtype=bool)
    total, count = (np.bincount(faces.ravel(), weights, len(normals)) for weights in (np.repeat(size, 3), None))
    around = total[faces] / count[faces]  # mean area of the faces at each corner
    sharp = np.einsum("fcd,fd->fc", normals[faces], face_normals) < np.cos(np.deg2rad(SHARP_DEGREES))
    return np.asarray(sharp & (size[:, None] > SLIVER * around))  # slivers have unsure normals


def _is_rough(faces: NDArray[np.int64], face_normals: Floats) -> bool:
    """Whether many neighboring faces meet at angles as noise makes them."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    paired = (edges[order[:-1]] == edges[order[1:]]).all(axis=1)
    first, second = owner[order[:-1]][paired], owner[order[1:]][paired]
    if not len(first):
        return False
    angle = np.rad2deg(np.arccos(np.clip(np.einsum("ed,ed->e", face_normals[first], face_normals[second]), -1, 1)))
    low, high = ROUGH_DEGREES
    return bool(((angle > low) & (angle < high)).mean() > ROUGH_SHARE)


def _colored(scene: Scene, coloring: str) -> Scene:
    if coloring == "file" and scene.own is None:
        raise InputError("has no colors of its own")
    if coloring == "confidence" and scene.confidence is None:
        raise InputError("has no attribute confidence; jetnormal estimate adds it with `confidence`")
    if coloring == "normals":
        colors = normal_colors(scene.normals)
    elif coloring == "confidence" and scene.confidence is not None:
        colors = UNSURE + scene.confidence[:, None] * (SURE - UNSURE)
    else:
        colors = scene.own if coloring == "file" and scene.own is not None else np.tile(CLAY, (len(scene.points), 1))
    return replace(scene, colors=colors, coloring=coloring)


def _centered(points: Floats) -> Floats:
    """Points around the middle of their box; of sizes that float32 and squares do not hold, scaled to size one."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = float((high / 2 - low / 2).max())
    if size > 0 and not 1e-9 < size < 1e15:
        exponent = -int(np.frexp(size)[1])
        points, low, high = (np.ldexp(values, exponent) for values in (points, low, high))
    return points - (low / 2 + high / 2)
