"""Constructive solid geometry: primitives added to and cut from each other, with exact normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jetnormal.data.solids.primitives import Primitive
from jetnormal.data.solids.sampling import Floats
from jetnormal.mesh import Mesh


@dataclass(frozen=True)
class Part:
    """A primitive at its place in a solid.

    Attributes:
        primitive: the shape.
        operation: whether it is added to or cut from the parts before it.
        translation: (3,).
        rotation: (3, 3).
        scale: positive, the same along all axes.
    """

    primitive: Primitive
    operation: Literal["union", "difference"] = "union"
    translation: Floats = field(default_factory=lambda: np.zeros(3))
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0

    @property
    def area(self) -> float:
        return self.scale**2 * self.primitive.area

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """See `Primitive.sample`."""
        points, normals = self.primitive.sample(count, rng)
        return self.scale * points @ self.rotation.T + self.translation, normals @ self.rotation.T

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Find which of the points (N, 3) lie inside, (N,)."""
        return self.implicit(points) < 0

    def implicit(self, points: Floats) -> Floats:
        """See `Primitive.implicit`."""
        return self.scale * self.primitive.implicit((points - self.translation) @ self.rotation / self.scale)

    def mesh(self) -> Mesh:
        """See `Primitive.mesh`."""
        mesh = self.primitive.mesh()
        return Mesh(self.scale * mesh.vertices @ self.rotation.T + self.translation, mesh.faces)


class Solid:
    """Parts that are added and cut in their order; the first one is always added."""

    def __init__(self, parts: Sequence[Part]) -> None:
        """Put parts together; two must not share a piece of surface, which random places make sure of."""
        self.parts = tuple(parts)
        areas = np.array([part.area for part in parts])
        self._shares = areas / areas.sum()
        trial = 4096
        # Roughly the share of the parts' surfaces that is left as the surface of the solid.
        self.exposed_share = len(self._surviving(trial, np.random.default_rng(0))[0]) / trial

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Find which of the points (N, 3) lie inside, (N,)."""
        return self._combined(np.stack([part.contains(points) for part in self.parts]))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return `count` points uniform over the surface, (count, 3), and their outward unit normals.

        Raises:
            ValueError: nothing of the solid is left.
        """
        if self.exposed_share == 0:
            raise ValueError("the solid has no surface: its parts are all cut away")
        points, normals = np.empty((0, 3)), np.empty((0, 3))
        while len(points) < count:
            more = self._surviving(int((count - len(points)) / self.exposed_share * 1.02) + 256, rng)
            points = np.concatenate([points, more[0]])
            normals = np.concatenate([normals, more[1]])
        return points[:count], normals[:count]

    def sides(self, points: Floats, own: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Tell whether the solid is on the inner and on the outer side of the surface of part `own` at points (N, 3).

        A point of a part's surface is on the solid's if that differs. Where the solid is on the outer side alone, the
        part was cut from it.
        """
        inside = np.zeros((len(self.parts), len(points)), dtype=bool)
        for other, part in enumerate(self.parts):
            if other != own:
                inside[other] = part.contains(points)
        ahead = self._combined(inside)
        inside[own] = True
        return self._combined(inside), ahead

    def _combined(self, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Membership in the solid, (N,), from membership in each part, (parts, N)."""
        result = inside[0]
        for part, mask in zip(self.parts[1:], inside[1:], strict=True):
            result = result | mask if part.operation == "union" else result & ~mask
        return result

    def _surviving(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Draw `count` points from the parts in random order and keep those on the surface of the solid."""
        kept = []
        for own, share in enumerate(rng.multinomial(count, self._shares)):
            points, normals = self.parts[own].sample(share, rng)
            behind, ahead = self.sides(points, own)
            exposed = behind != ahead
            sign = np.where(behind[exposed], 1.0, -1.0)
            kept.append((points[exposed], normals[exposed] * sign[:, None]))
        points, normals = (np.concatenate(arrays) for arrays in zip(*kept, strict=True))
        order = rng.permutation(len(points))
        return points[order], normals[order]
