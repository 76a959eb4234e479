"""Surfaces that rays are cast at: what a virtual scanner looks at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.mesh_sampler import MeshSampler
from jetnormal.data.solids.csg import Solid
from jetnormal.support.open3d_loader import require_open3d

Floats = NDArray[np.float64]
CHUNK = 1 << 18  # rays cast at a time, which bounds the memory


class Hits(NamedTuple):
    """Where rays first meet a surface.

    Attributes:
        distance: (N,) from the origin of each ray in units of its direction's length; infinite where it meets nothing.
        normals: (N, 3) unit normals of the surface there, facing the origin; zero where there is none.
    """

    distance: Floats
    normals: Floats


class Target(Protocol):
    """A surface in the frame of a scanner: its bounding box lies around the origin and has a diagonal of one.

    Attributes:
        center: (3,) of the bounding box, in the surface's own coordinates.
        size: the bounding box's diagonal there. A point of the frame is at center + size * point.
    """

    center: Floats
    size: float

    def cast(self, origins: Floats, directions: Floats, /) -> Hits:
        """Follow rays (N, 3) with unit directions (N, 3) to the surface."""
        ...

    def visible(self, points: Floats, eyes: Floats, /) -> NDArray[np.bool_]:
        """Find which of the points (N, 3) of the surface nothing hides from the eyes (N, 3), (N,)."""
        ...

    def sample(self, count: int, rng: np.random.Generator, /) -> tuple[Floats, Floats]:
        """Return `count` points uniform over the surface, (count, 3), and their unit normals, (count, 3)."""
        ...


class MeshTarget:
    """A triangle mesh as a target: its points and normals are those of a `MeshSampler`."""

    def __init__(self, sampler: MeshSampler) -> None:
        """Build the search structure once.

        Raises:
            ResourceError: Open3D, which casts the rays, cannot be loaded.
        """
        mesh = sampler.mesh
        low, high = mesh.vertices[mesh.faces].min((0, 1)), mesh.vertices[mesh.faces].max((0, 1))
        self.center, self.size = (low + high) / 2, float(np.linalg.norm(high - low))
        self._sampler = sampler
        self._rays = RayCaster()
        self._rays.add((mesh.vertices - self.center) / self.size, mesh.faces)

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """See `Target.cast`."""
        found = self._rays.first(origins, directions)
        distance, normals = np.full(len(origins), np.inf), np.zeros((len(origins), 3))
        hit = np.flatnonzero(found.face >= 0)
        points, smooth = self._sampler.at(found.face[hit], found.u[hit], found.v[hit])
        # The float32 distance is good for finding the face only; the point on the face is exact.
        offset = (points - self.center) / self.size - origins[hit]
        distance[hit] = (offset * directions[hit]).sum(1)
        # A smooth normal may look away where the surface is seen at a grazing angle: the face tells the side.
        away = (self._sampler.face_normals[found.face[hit]] * directions[hit]).sum(1) > 0
        normals[hit] = np.where(away[:, None], -smooth, smooth)
        return Hits(distance, normals)

    def visible(self, points: Floats, eyes: Floats) -> NDArray[np.bool_]:
        """See `Target.visible`."""
        return self._rays.visible(points, eyes)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Target.sample`."""
        points, normals = self._sampler.sample(count, rng)
        return (points - self.center) / self.size, normals


class SolidTarget:
    """A procedural solid as a target. Rays meet meshes of its parts first, and then the exact surface near there."""

    _LONGEST = 64  # surfaces of parts that a ray passes, at most, before it meets that of the solid
    _STEP = 1e-5  # of the differences that give the gradient of an implicit function

    def __init__(self, solid: Solid) -> None:
        """Build the search structure.

        Raises:
            ResourceError: Open3D, which casts the rays, cannot be loaded.
        """
        points, _ = solid.sample(4096, np.random.default_rng(0))
        low, high = points.min(0), points.max(0)
        self.center, self.size = (low + high) / 2, float(np.linalg.norm(high - low))
        self._solid = solid
        self._rays = RayCaster()
        for part in solid.parts:
            mesh = part.mesh()
            self._rays.add((mesh.vertices - self.center) / self.size, mesh.faces)

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """See `Target.cast`."""
        distance, parts = self._first(origins, directions)
        normals = np.zeros((len(origins), 3))
        for number in np.unique(parts[parts >= 0]):
            own = np.flatnonzero(parts == number)
            distance[own], outward = self._on_part(number, origins[own], directions[own], distance[own])
            away = (outward * directions[own]).sum(1) > 0
            normals[own] = np.where(away[:, None], -outward, outward)
        return Hits(distance, normals)

    def visible(self, points: Floats, eyes: Floats) -> NDArray[np.bool_]:
        """See `Target.visible`."""
        length = np.linalg.norm(eyes - points, axis=1)
        directions = (eyes - points) / length[:, None]
        distance, _ = self._first(points + RayCaster.CLEARANCE * directions, directions)
        return distance > length - 2 * RayCaster.CLEARANCE

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Target.sample`."""
        points, normals = self._solid.sample(count, rng)
        return (points - self.center) / self.size, normals

    def _first(self, origins: Floats, directions: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Distance (N,) to the mesh of a part where it is the solid's surface, and the part's number, -1 for none."""
        distance, parts = np.full(len(origins), np.inf), np.full(len(origins), -1)
        rays, start = np.arange(len(origins)), np.zeros(len(origins))
        for _ in range(self._LONGEST):
            found = self._rays.first(origins[rays] + start[rays, None] * directions[rays], directions[rays])
            met = found.mesh >= 0
            rays, part = rays[met], found.mesh[met]
            if len(rays) == 0:
                break
            start[rays] += found.distance[met]
            places = self.center + self.size * (origins[rays] + start[rays, None] * directions[rays])
            exposed = np.zeros(len(rays), dtype=bool)
            for number in np.unique(part):
                own = part == number
                behind, ahead = self._solid.sides(places[own], number)
                exposed[own] = behind != ahead
            here = rays[exposed]
            distance[here], parts[here] = start[here], part[exposed]
            rays = rays[~exposed]
            start[rays] += RayCaster.CLEARANCE / 4
        return distance, parts

    def _on_part(self, part: int, origins: Floats, directions: Floats, near: Floats) -> tuple[Floats, Floats]:
        """The distance (N,) of the exact surface of a part from near distances (N,), and its unit normals (N, 3)."""
        distance = near
        for _ in range(3):  # Newton's method along the ray, held back where the surface is seen at a grazing angle
            value, gradient = self._implicit(part, origins + distance[:, None] * directions)
            rise = (gradient * directions).sum(1)
            least = 0.1 * np.linalg.norm(gradient, axis=1)
            distance = distance - value / np.where(rise < 0, np.minimum(rise, -least), np.maximum(rise, least))
        _, gradient = self._implicit(part, origins + distance[:, None] * directions)
        return distance, gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    def _implicit(self, part: int, points: Floats) -> tuple[Floats, Floats]:
        """Value (N,) and gradient (N, 3) of the implicit function of a part, in the frame of the target."""

        def value(places: Floats) -> Floats:
            return self._solid.parts[part].implicit(self.center + self.size * places) / self.size

        steps = self._STEP * np.eye(3)
        gradient = np.stack([value(points + step) - value(points - step) for step in steps], axis=1)
        return value(points), gradient / (2 * self._STEP)


class Found(NamedTuple):
    """What rays (N,) meet first: the number of the mesh, of its face (-1 for nothing), and the place on the face."""

    mesh: NDArray[np.int64]
    face: NDArray[np.int64]
    u: Floats
    v: Floats
    distance: Floats


class RayCaster:
    """Casts rays at meshes of a size of about one; float32 inside."""

    CLEARANCE = 1e-4  # of the size: a segment starts and ends this far from the surfaces at its ends

    def __init__(self) -> None:
        """Start without a mesh.

        Raises:
            ResourceError: Open3D cannot be loaded.
        """
        self._open3d: Any = require_open3d("casts the rays of virtual scanners")
        self._scene = self._open3d.t.geometry.RaycastingScene()

    def add(self, vertices: Floats, faces: NDArray[np.int64]) -> None:
        """Add a mesh; meshes are numbered from 0."""
        tensor = self._open3d.core.Tensor
        self._scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))

    def first(self, origins: Floats, directions: Floats) -> Found:
        """Find what rays (N, 3) with unit directions (N, 3) meet first."""
        parts = [self._cast(rays) for rays in self._chunks(origins, directions)]
        return Found(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def visible(self, points: Floats, eyes: Floats) -> NDArray[np.bool_]:
        """Tell whether the segments between points (N, 3) and eyes (N, 3) meet nothing, (N,)."""
        offset = eyes - points
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        share = self.CLEARANCE / np.maximum(length, 2 * self.CLEARANCE)
        start, reach = points + share * offset, (1 - 2 * share) * offset
        occluded = [
            self._scene.test_occlusions(rays, 0.0, 1.0, nthreads=1).numpy() for rays in self._chunks(start, reach)
        ]
        return ~np.concatenate(occluded)

    def _chunks(self, origins: Floats, directions: Floats) -> Iterator[Any]:
        for start in range(0, max(1, len(origins)), CHUNK):
            rays = np.concatenate([origins[start : start + CHUNK], directions[start : start + CHUNK]], axis=1)
            yield self._open3d.core.Tensor(rays.astype(np.float32))

    def _cast(self, rays: Any) -> Found:
        found = self._scene.cast_rays(rays, nthreads=1)
        mesh, face = (found[key].numpy().astype(np.int64) for key in ("geometry_ids", "primitive_ids"))
        distance = found["t_hit"].numpy().astype(np.float64)
        missed = ~np.isfinite(distance)
        uv = found["primitive_uvs"].numpy().astype(np.float64)
        return Found(np.where(missed, -1, mesh), np.where(missed, -1, face), uv[:, 0], uv[:, 1], distance)
