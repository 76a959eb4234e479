"""Random solids with exact normals, put together from analytic primitives.

They hold what a network must learn and what few meshes have without error: sharp edges between exact faces,
thin walls, holes, fillets, and curved surfaces whose normals are known in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from jetnormal.data.solids.csg import Part, Solid
from jetnormal.data.solids.primitives import (
    ConvexPolyhedron,
    Lathe,
    Primitive,
    RoundedBox,
    RoundedCylinder,
    Torus,
)
from jetnormal.data.solids.sampling import Floats
from jetnormal.data.solids.starshaped import BumpySphere, Superellipsoid


def random_solid(rng: np.random.Generator) -> Solid:
    """Draw a solid of one to seven parts, with a size of about one to three, at a random place."""
    kinds: list[Callable[[np.random.Generator], list[Part]]] = [
        _assembly,
        _machined,
        _shell,
        _plates,
        _smooth,
    ]
    while True:
        draw = kinds[rng.choice(len(kinds), p=[0.2, 0.35, 0.15, 0.1, 0.2])]
        solid = Solid(_moved(draw(rng), rng))
        if solid.exposed_share > 0.15:  # else most of it is cut away or buried, which is slow to sample
            return solid


def _moved(parts: list[Part], rng: np.random.Generator) -> list[Part]:
    """The parts under one random rigid motion."""
    rotation, shift = _rotation(rng), rng.normal(size=3)
    return [
        Part(
            part.primitive,
            part.operation,
            rotation @ part.translation + shift,
            rotation @ part.rotation,
            part.scale,
        )
        for part in parts
    ]


def _assembly(rng: np.random.Generator) -> list[Part]:
    """Any primitives grown together."""
    return [
        Part(
            _any_primitive(rng),
            translation=rng.uniform(-0.6, 0.6, 3),
            rotation=_rotation(rng) if rng.random() < 0.5 else _quarter_turns(rng),
            scale=rng.uniform(0.5, 1.0),
        )
        for _ in range(rng.integers(2, 6))
    ]


def _machined(rng: np.random.Generator) -> list[Part]:
    """A block or drum with bosses and with holes, slots and hollows cut, mostly at right angles."""
    parts = [Part(_block(rng))]
    for _ in range(rng.integers(0, 3)):
        boss = Part(_block(rng), "union", rng.uniform(-0.6, 0.6, 3), _quarter_turns(rng), rng.uniform(0.3, 0.7))
        parts.append(boss)
    for _ in range(rng.integers(1, 5)):
        tilted = rng.random() < 0.3
        turn = _rotation(rng) if tilted else _quarter_turns(rng)
        parts.append(Part(_cutter(rng), "difference", rng.uniform(-0.7, 0.7, 3), turn))
    return parts


def _shell(rng: np.random.Generator) -> list[Part]:
    """A vessel with a thin wall: a primitive less a smaller copy that breaks through on one side."""
    outer = _block(rng) if rng.random() < 0.6 else _smooth_primitive(rng)
    scale = rng.uniform(0.85, 0.97)
    opening = _quarter_turns(rng)
    window = RoundedBox(rng.uniform(0.4, 1.2, 3))
    return [
        Part(outer),
        Part(outer, "difference", rng.uniform(-0.3, 0.3, 3) * (1 - scale), scale=scale),
        Part(window, "difference", opening @ np.array([0.1, -0.1, rng.uniform(0.6, 1.2)]), opening),
    ]


def _plates(rng: np.random.Generator) -> list[Part]:
    """Sheets and rods that cross each other."""
    parts = []
    for _ in range(rng.integers(2, 6)):
        turn = _rotation(rng) if rng.random() < 0.3 else _quarter_turns(rng)
        sheet = _sheet(rng) if rng.random() < 0.7 else _rod(rng)
        parts.append(Part(sheet, "union", rng.uniform(-0.5, 0.5, 3), turn))
    return parts


def _smooth(rng: np.random.Generator) -> list[Part]:
    """One or two curved bodies, sometimes with a bite taken out."""
    parts = [Part(_smooth_primitive(rng))]
    if rng.random() < 0.4:
        operation: Literal["union", "difference"] = "union" if rng.random() < 0.5 else "difference"
        offset = _rotation(rng)[0] * rng.uniform(0.5, 1.0)
        parts.append(Part(_smooth_primitive(rng), operation, offset, _rotation(rng), rng.uniform(0.4, 0.9)))
    return parts


def _any_primitive(rng: np.random.Generator) -> Primitive:
    makers = [_block, _smooth_primitive, _sheet, _rod, _rock]
    return makers[rng.choice(len(makers), p=[0.45, 0.25, 0.1, 0.1, 0.1])](rng)


def _block(rng: np.random.Generator) -> Primitive:
    """A box, rounded box, prism, wedge, cylinder, cone or rounded cylinder."""
    height, size = rng.uniform(0.2, 0.9), rng.uniform(0.3, 0.9)
    fillet = rng.uniform(0.02, 0.2)
    kind = rng.integers(6)
    if kind == 0:
        return RoundedBox(rng.uniform(0.25, 0.9, 3))
    if kind == 1:
        return RoundedBox(rng.uniform(0.15, 0.8, 3), fillet)
    if kind == 2:
        return _frustum(int(rng.integers(3, 9)), size, height, 1.0 if rng.random() < 0.5 else rng.uniform(0, 1))
    if kind == 3:
        return Lathe(height, size)
    if kind == 4:
        top = size * rng.uniform(0, 1)
        return Lathe(height, (size + top) / 2, (top - size) / (2 * height))
    return RoundedCylinder(size, height, fillet)


def _frustum(sides: int, size: float, half_height: float, taper: float) -> Primitive:
    """A prism over a regular polygon whose top is scaled by `taper`."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([size * np.cos(angle), size * np.sin(angle), np.full(sides, -half_height)], axis=1)
    return ConvexPolyhedron(np.concatenate([ring, ring * [max(taper, 0.05), max(taper, 0.05), -1]]))


def _rock(rng: np.random.Generator) -> Primitive:
    """An irregular block with plane faces."""
    directions = rng.normal(size=(rng.integers(6, 16), 3))
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])  # keeps the origin inside
    corners = np.concatenate([directions / np.linalg.norm(directions, axis=1, keepdims=True), 0.6 * octahedron])
    return ConvexPolyhedron(corners * rng.uniform(0.5, 1.0, 3))


def _cutter(rng: np.random.Generator) -> Primitive:
    """A drill, slot, chamfer or ball."""
    kind = rng.integers(4)
    if kind == 0:
        return Lathe(2.0, rng.uniform(0.05, 0.35))
    if kind == 1:
        return RoundedBox([rng.uniform(0.03, 0.3), rng.uniform(0.1, 0.6), 1.0], rng.uniform(0.0, 0.03))
    if kind == 2:
        return Lathe(0.8, 0.3, rng.uniform(0.05, 0.35))
    return RoundedBox(np.zeros(3), rng.uniform(0.15, 0.5))


def _sheet(rng: np.random.Generator) -> Primitive:
    thickness = rng.uniform(0.005, 0.05)
    rounded = rng.random() < 0.5
    half = [rng.uniform(0.4, 1.0), rng.uniform(0.3, 1.0), 0.0 if rounded else thickness]
    return RoundedBox(half, thickness if rounded else 0.0)


def _rod(rng: np.random.Generator) -> Primitive:
    """A capsule or a ring."""
    thickness = rng.uniform(0.03, 0.2)
    if rng.random() < 0.5:
        return RoundedBox([rng.uniform(0.4, 1.0), 0.0, 0.0], thickness)
    return Torus(rng.uniform(0.35, 0.8), thickness)


def _smooth_primitive(rng: np.random.Generator) -> Primitive:
    """An ellipsoid, superellipsoid, bumpy sphere, vase or ring."""
    kind = rng.integers(5)
    if kind == 0:
        return Superellipsoid(rng.uniform(0.4, 1.0, 3))
    if kind == 1:
        return Superellipsoid(rng.uniform(0.4, 1.0, 3), rng.uniform(2.0, 8.0))
    if kind == 2:
        waves = rng.normal(size=(rng.integers(2, 8), 3)) * rng.uniform(1.5, 8.0)
        slopes = rng.uniform(0.1, 0.6) * rng.dirichlet(np.ones(len(waves)))
        amplitudes = slopes / np.maximum(np.linalg.norm(waves, axis=1), 2.0)
        return BumpySphere(amplitudes, waves, rng.uniform(0, 2 * np.pi, len(waves)))
    if kind == 3:
        base, frequency = rng.uniform(0.25, 0.6), rng.uniform(2.0, 12.0)
        amplitude = min(0.6 * base, rng.uniform(0.1, 0.8) / frequency)
        return Lathe(rng.uniform(0.5, 1.0), base, 0.0, amplitude, frequency, rng.uniform(0, 2 * np.pi))
    return Torus(rng.uniform(0.5, 0.8), rng.uniform(0.1, 0.4))


def _rotation(rng: np.random.Generator) -> Floats:
    return Rotation.random(random_state=rng).as_matrix()


def _quarter_turns(rng: np.random.Generator) -> Floats:
    """A random rotation of the cube, (3, 3)."""
    turns = Rotation.create_group("O").as_matrix()
    return turns[rng.integers(len(turns))]
