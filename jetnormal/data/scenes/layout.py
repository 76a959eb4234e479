"""What a scene is, and how things find their places in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jetnormal.data.mesh_sampler import MeshSampler
from jetnormal.data.scenes.surfaces import Floats, Piece, joined
from jetnormal.mesh import Mesh

Kind = Literal["room", "street", "terrain"]


@dataclass(frozen=True)
class Scene:
    """A scene in meters; z is up.

    Attributes:
        kind: what it is, which decides who scans it.
        surface: all of it.
        stands: (K, 3) places where a scanner on a tripod, or a person with one, may stand: the height is the sensor's.
        trip: (2, 3) ends of a straight way of a vehicle or an aircraft.
    """

    kind: Kind
    surface: Piece
    stands: Floats
    trip: Floats

    def mesh(self) -> Mesh:
        """Return the scene as triangles."""
        return Mesh(self.surface.vertices, self.surface.faces)

    def sampler(self) -> MeshSampler:
        """Return the scene as a mesh with its exact normals."""
        return MeshSampler(self.mesh(), self.surface.normals[self.surface.faces])


class Floor:
    """Ground on which things are put that must not stand in each other."""

    def __init__(self) -> None:
        self.pieces: list[Piece] = []
        self._taken: list[tuple[float, float, float]] = []

    def free(self, x: float, y: float, radius: float) -> bool:
        """Tell whether a disc on the ground is free."""
        return all(np.hypot(x - a, y - b) > radius + r for a, b, r in self._taken)

    def take(self, x: float, y: float, radius: float) -> None:
        """Keep a disc of the ground free from other things."""
        self._taken.append((x, y, radius))

    def put(self, piece: Piece, x: float, y: float, z: float = 0.0, yaw: float = 0.0, room: float = 1.0) -> bool:
        """Put a thing somewhere if there is room; its radius is multiplied by `room`."""
        radius = room * float(np.linalg.norm(piece.vertices[:, :2], axis=1).max())
        if not self.free(x, y, radius):
            return False
        self.take(x, y, radius)
        self.pieces.append(piece.placed([x, y, z], yaw))
        return True

    def joined(self, more: Sequence[Piece] = ()) -> Piece:
        """Join everything that was put, and more."""
        return joined([*self.pieces, *more])

    def stands(self, low: Floats, high: Floats, heights: tuple[float, float], rng: np.random.Generator) -> Floats:
        """Find up to twelve free places (K, 3), at least one, in a rectangle of the ground."""
        places = [rng.uniform(low, high) for _ in range(60)]
        free = [place for place in places if self.free(place[0], place[1], 0.35)][:12] or places[:1]
        return np.array([[*place, rng.uniform(*heights)] for place in free])
