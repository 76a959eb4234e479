"""Analytic primitives: each can sample its surface uniformly with exact normals, and tells inside from outside.

All are centered at the origin and about one unit large. One class makes a family of shapes: `RoundedBox` makes boxes,
plates, capsules and spheres, `Lathe` makes cylinders, cones and vases.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from jetnormal.data.solids.grids import grid_faces, half_circle, revolved
from jetnormal.data.solids.sampling import Floats, arc_angles, distance_to_corner, normalized, rejected, revolve
from jetnormal.mesh import Mesh


class Primitive(Protocol):
    """A solid bounded by a surface that can be sampled."""

    @property
    def area(self) -> float:
        """Area of the surface."""
        ...

    def sample(self, count: int, rng: np.random.Generator, /) -> tuple[Floats, Floats]:
        """Return points uniform over the surface, (count, 3), in any order, and outward unit normals."""
        ...

    def implicit(self, points: Floats, /) -> Floats:
        """Return a function of points (N, 3) that is negative inside, positive outside and zero on the surface."""
        ...

    def mesh(self) -> Mesh:
        """Return triangles whose vertices lie on the surface and whose faces are within about 0.001 of it."""
        ...


class RoundedBox:
    """All points within `radius` of a box: a box, plate, rod with round edges, capsule or sphere."""

    # The surface has seven groups of faces: three pairs of flat faces, the quarter cylinders around the edges along
    # x, y and z, and the eight sphere octants at the corners. True: this component of the normal varies in the group.
    _MOVING = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0], [1, 1, 1]], dtype=bool)

    def __init__(self, half: ArrayLike, radius: float = 0.0) -> None:
        """Set the sizes.

        Args:
            half: (3,) half sizes of the inner box; zeros are allowed with a positive radius.
            radius: radius of the rounded edges; 0 gives sharp edges.
        """
        self._half = np.asarray(half, dtype=np.float64)
        self._radius = radius
        x, y, z = self._half
        faces = 8 * np.array([y * z, x * z, x * y])
        self._areas = np.concatenate([faces, 4 * np.pi * radius * self._half, [4 * np.pi * radius**2]])
        self.area = float(self._areas.sum())

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        moving = np.repeat(self._MOVING, rng.multinomial(count, self._areas / self.area), axis=0)
        normals = normalized(rng.normal(size=(count, 3)) * moving)
        core = self._half * np.where(moving, np.sign(normals), rng.uniform(-1, 1, (count, 3)))
        return core + self._radius * normals, normals

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`; this is the signed distance."""
        return distance_to_corner(np.abs(points) - self._half) - self._radius

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        # A sphere's grid of angles, cut along the octants, whose parts move apart to the corners of the inner box. The
        # gaps become the quarter cylinders and four of the faces; the lowest and the highest row close the others.
        steps = np.linspace(0, np.pi / 2, 24 if self._radius else 1)
        azimuth = np.concatenate([steps + quarter * np.pi / 2 for quarter in range(4)])
        tilt = np.concatenate([[-np.pi / 2], steps - np.pi / 2, steps, [np.pi / 2]])
        normals = np.stack(np.broadcast_arrays(
            np.cos(tilt)[:, None] * np.cos(azimuth), np.cos(tilt)[:, None] * np.sin(azimuth), np.sin(tilt)[:, None]), -1
        )  # fmt: skip
        quarter = np.repeat(np.arange(4), len(steps))
        half_turn = np.repeat([-1.0, 1.0], len(steps) + 1)
        corner = np.stack(np.broadcast_arrays(
            np.where((quarter == 0) | (quarter == 3), 1.0, -1.0), np.where(quarter < 2, 1.0, -1.0), half_turn[:, None]
        ), -1)  # fmt: skip
        corner[[0, -1], :, :2] = 0  # the middles of the lowest and the highest face
        vertices = self._half * corner + self._radius * normals
        return Mesh(vertices.reshape(-1, 3), grid_faces(len(tilt), len(azimuth)))


class RoundedCylinder:
    """All points within `radius` of a cylinder around z: a disc or drum with filleted rims."""

    def __init__(self, core: float, half_height: float, radius: float) -> None:
        """Set the sizes.

        Args:
            core: radius of the inner cylinder.
            half_height: half the height of the inner cylinder.
            radius: radius of the fillets.
        """
        self._core, self._half_height, self._radius = core, half_height, radius
        caps = 2 * np.pi * core**2
        wall = 4 * np.pi * (core + radius) * half_height
        fillets = 2 * np.pi * radius * (np.pi * core + 2 * radius)
        self._areas = np.array([caps, wall, fillets])
        self.area = float(self._areas.sum())

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        caps, wall, fillets = rng.multinomial(count, self._areas / self.area)
        # In the half plane (rho, z) the surface is a core point plus radius times the normal at `tilt`.
        rho = np.full(count, self._core)
        rho[:caps] *= np.sqrt(rng.random(caps))
        tilt = np.zeros(count)
        tilt[:caps] = np.pi / 2 * rng.choice([-1, 1], caps)
        tilt[caps + wall :] = arc_angles(self._core, self._radius, np.pi / 2, fillets, rng)
        z = self._half_height * np.sign(tilt)
        z[caps : caps + wall] = self._half_height * rng.uniform(-1, 1, wall)
        return revolve(rho, z, np.cos(tilt), np.sin(tilt), self._radius, rng)

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`; this is the signed distance."""
        rho, height = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
        corner = np.stack([rho - self._core, height - self._half_height], axis=1)
        return distance_to_corner(corner) - self._radius

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        cos, sin = half_circle(-np.pi / 2, np.pi / 2, 64)
        rho, z = self._core + self._radius * cos, self._half_height * np.sign(sin) + self._radius * sin
        return revolved(np.concatenate([[0], rho, [0]]), np.concatenate([z[:1], z, z[-1:]]))


class Torus:
    """A ring around z."""

    def __init__(self, major: float, minor: float) -> None:
        """Set the sizes.

        Args:
            major: radius of the center circle, larger than `minor`.
            minor: radius of the tube.
        """
        self._major, self._minor = major, minor
        self.area = 4 * np.pi**2 * major * minor

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        tilt = arc_angles(self._major, self._minor, np.pi, count, rng)
        center = np.full(count, self._major)
        return revolve(center, np.zeros(count), np.cos(tilt), np.sin(tilt), self._minor, rng)

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`; this is the signed distance."""
        rho = np.hypot(points[:, 0], points[:, 1])
        return np.hypot(rho - self._major, points[:, 2]) - self._minor

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        cos, sin = half_circle(0, 2 * np.pi, 97)
        return revolved(self._major + self._minor * cos[:-1], self._minor * sin[:-1], ring=True)


class Lathe:
    """The profile base + slope z + amplitude sin(frequency z + phase) turned around z, with flat caps.

    Without amplitude it is a cylinder or a cone.
    """

    def __init__(
        self,
        half_height: float,
        base: float,
        slope: float = 0.0,
        amplitude: float = 0.0,
        frequency: float = 0.0,
        phase: float = 0.0,
    ) -> None:
        """Set the profile, which must not be negative between -half_height and half_height."""
        self._half_height = half_height
        self._base, self._slope = base, slope
        self._amplitude, self._frequency, self._phase = amplitude, frequency, phase
        z = np.linspace(-half_height, half_height, 2049)
        density = self._density(z)
        self._largest_density = 1.01 * density.max()
        wall = 2 * np.pi * np.sum((density[1:] + density[:-1]) / 2) * (z[1] - z[0])
        self._areas = np.array([wall, np.pi * self._rho(z[0]) ** 2, np.pi * self._rho(z[-1]) ** 2])
        self.area = float(self._areas.sum())

    def _rho(self, z: Floats) -> Floats:
        return self._base + self._slope * z + self._amplitude * np.sin(self._frequency * z + self._phase)

    def _rise(self, z: Floats) -> Floats:
        return self._slope + self._amplitude * self._frequency * np.cos(self._frequency * z + self._phase)

    def _density(self, z: Floats) -> Floats:
        """Area of the wall per height and angle."""
        return self._rho(z) * np.hypot(1, self._rise(z))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        wall, bottom, top = rng.multinomial(count, self._areas / self.area)
        height = rejected(
            lambda n: rng.uniform(-self._half_height, self._half_height, n),
            lambda z: self._density(z) / self._largest_density,
            wall,
            rng,
        )
        z = np.concatenate([height, np.repeat([-self._half_height, self._half_height], [bottom, top])])
        rho = self._rho(z)
        rho[wall:] *= np.sqrt(rng.random(bottom + top))
        rise = self._rise(height)
        caps = np.repeat([-1.0, 1.0], [bottom, top])
        outward = np.concatenate([1 / np.hypot(1, rise), np.zeros(bottom + top)])
        upward = np.concatenate([-rise / np.hypot(1, rise), caps])
        return revolve(rho, z, outward, upward, 0.0, rng)

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`."""
        z = points[:, 2]
        return np.maximum(np.hypot(points[:, 0], points[:, 1]) - self._rho(z), np.abs(z) - self._half_height)

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        z = np.linspace(-self._half_height, self._half_height, 161 if self._amplitude else 2)
        return revolved(np.concatenate([[0], self._rho(z), [0]]), np.concatenate([z[:1], z, z[-1:]]))


class ConvexPolyhedron:
    """The convex hull of points: a prism, wedge, pyramid or an irregular block."""

    def __init__(self, vertices: ArrayLike) -> None:
        """Take the hull of `vertices`, (V, 3), which are around the origin and not all in one plane."""
        hull = ConvexHull(np.asarray(vertices, dtype=np.float64))
        corners = hull.points[hull.simplices]
        self._corners = corners
        self._planes = hull.equations  # (F, 4): outward unit normal and offset of each triangle
        self._distinct_planes = np.unique(hull.equations.round(9), axis=0)
        sides = corners[:, 1:] - corners[:, :1]
        self._areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
        self.area = float(self._areas.sum())

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        face = np.repeat(np.arange(len(self._areas)), rng.multinomial(count, self._areas / self.area))
        weights = rng.exponential(size=(count, 3, 1))  # normalized, they are uniform over the triangle
        points = (weights * self._corners[face]).sum(axis=1) / weights.sum(axis=1)
        return points, self._planes[face, :3]

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`."""
        return (points @ self._distinct_planes[:, :3].T + self._distinct_planes[:, 3]).max(axis=1)

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        facing = np.cross(self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0])
        outward = (facing * self._planes[:, :3]).sum(1) > 0
        faces = np.arange(self._corners.shape[0] * 3).reshape(-1, 3)
        return Mesh(self._corners.reshape(-1, 3), np.where(outward[:, None], faces, faces[:, ::-1]))
