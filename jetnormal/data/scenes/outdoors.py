"""What stands outdoors. Each is a piece of surface that stands on the origin, in meters."""

from __future__ import annotations

import numpy as np

from jetnormal.data.scenes.surfaces import (
    Piece,
    Rng,
    box,
    frustum,
    joined,
    leaves,
    rectangle,
    star,
    wall,
)
from jetnormal.data.solids.starshaped import BumpySphere, Superellipsoid
from jetnormal.geometry.vectors import unit


def car(rng: Rng) -> Piece:
    """Make a car along x."""
    length, wide, high = rng.uniform(3.5, 5.2), rng.uniform(1.6, 2.0), rng.uniform(1.35, 2.2)
    waist = rng.uniform(0.75, 1.0)
    body = star(Superellipsoid([length / 2, wide / 2, (waist - 0.2) / 2], rng.uniform(4, 8)), [0, 0, (waist + 0.2) / 2])
    cabin = star(
        Superellipsoid([length * rng.uniform(0.22, 0.45), wide * 0.45, high - waist], rng.uniform(2.5, 6)),
        [-length * rng.uniform(0, 0.1), 0, waist - 0.05],
    )
    radius = rng.uniform(0.28, 0.36)
    wheels = [
        frustum([x * length * 0.32, y * wide * 0.38, radius], [x * length * 0.32, y * wide * 0.5, radius], radius)
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return joined([body, cabin, *wheels])


def pole(rng: Rng) -> Piece:
    """Make a street light, traffic sign, mast or bollard."""
    kind, height = rng.integers(3), rng.uniform(2.2, 9.0)
    if kind == 0:
        arm = rng.uniform(0.5, 2.0)
        mast = frustum([0, 0, 0], [0, 0, height], rng.uniform(0.05, 0.12), 0.04)
        return joined(
            [mast, frustum([0, 0, height], [arm, 0, height + 0.2], 0.03), box([0.6, 0.2, 0.1], [arm, 0, height + 0.1])]
        )
    if kind == 1:
        sign = box([0.6, 0.01, rng.uniform(0.4, 0.9)], [0, -0.04, 2.0])
        plate = sign if rng.random() < 0.5 else frustum([0, -0.05, 2.3], [0, -0.04, 2.3], 0.3)
        return joined([frustum([0, 0, 0], [0, 0, 2.7], 0.035), plate])
    high = rng.uniform(0.5, 1.1)
    return joined([frustum([0, 0, 0], [0, 0, high], 0.08), star(Superellipsoid([0.08] * 3), [0, 0, high], rows=17)])


def tree(rng: Rng) -> Piece:
    """Make a tree with branches; its crown is closed, made of leaves, which have no normals, or bare."""
    height, radius = rng.uniform(3.0, 14.0), rng.uniform(0.08, 0.35)
    lean = rng.normal(scale=0.06, size=2)
    top = np.array([*(lean * height), height * rng.uniform(0.5, 0.8)])
    pieces = [frustum([0, 0, 0], top, radius, radius * 0.4)]
    for _ in range(rng.integers(3, 12)):
        start = top * rng.uniform(0.4, 1.0)
        end = start + height * rng.uniform(0.1, 0.3) * unit(rng.normal(size=3) + np.array([0, 0, 0.6]))
        pieces.append(frustum(start, end, radius * rng.uniform(0.15, 0.4), 0.01))
    wide, kind = height * rng.uniform(0.15, 0.35), rng.random()
    middle = [*top[:2], height - wide]
    if kind < 0.35:
        waves = rng.normal(size=(6, 3)) * rng.uniform(2, 6)
        crown = BumpySphere(np.full(6, rng.uniform(0.01, 0.05)), waves, rng.uniform(0, 6, 6))
        pieces.append(star(crown, middle, wide, rows=41))
    elif kind < 0.8:
        spread = [wide, wide, wide * rng.uniform(0.8, 1.8)]
        pieces.append(leaves(int(rng.integers(300, 3000)), rng.uniform(0.08, 0.3), spread, rng).placed(middle))
    return joined(pieces)


def fence(rng: Rng) -> Piece:
    """Make a low wall, hedge, or a fence of bars along x from 0."""
    length, height = rng.uniform(2, 10), rng.uniform(0.6, 2.0)
    kind = rng.random()
    if kind < 0.3:
        return box([length, rng.uniform(0.1, 0.4), height], [length / 2, 0, 0])
    if kind < 0.5:
        return star(Superellipsoid([length / 2, 0.4, height], 6.0), [length / 2, 0, 0])
    bars = [frustum([x, 0, 0], [x, 0, height], 0.015) for x in np.arange(0, length, rng.uniform(0.1, 0.4))]
    return joined([*bars, *(box([length, 0.03, 0.05], [length / 2, 0, z]) for z in (0.1, height - 0.1))])


def person(rng: Rng) -> Piece:
    """Make someone who stands, roughly."""
    high = rng.uniform(1.5, 1.9) / 1.75
    parts = [
        star(Superellipsoid([0.1, 0.11, 0.13]), [0, 0, 1.62], rows=25),
        star(Superellipsoid([0.2, 0.13, 0.34], 2.6), [0, 0, 1.15], rows=25),
    ]
    parts += [frustum([x, rng.uniform(-0.2, 0.2), 0], [x * 0.8, 0, 0.9], 0.06, 0.09) for x in (-0.12, 0.12)]
    parts += [frustum([x * 1.3, rng.uniform(-0.3, 0.3), 0.85], [x, 0, 1.4], 0.04, 0.05) for x in (-0.22, 0.22)]
    whole = joined(parts)
    return Piece(whole.vertices * high, whole.normals, whole.faces)


def house(rng: Rng) -> Piece:
    """Make a detached house with windows, a pitched or flat roof, and a chimney."""
    x, y, z = rng.uniform(7, 16), rng.uniform(6, 12), rng.uniform(3, 9)
    pieces = []
    for length, corner, yaw in (
        (x, (-x / 2, -y / 2), np.pi),
        (y, (x / 2, -y / 2), -np.pi / 2),
        (x, (x / 2, y / 2), 0.0),
        (y, (-x / 2, y / 2), np.pi / 2),
    ):
        pieces.append(facade(rng, length, z).placed([-length, 0, 0]).placed([*corner, 0], yaw))
    rise, over = rng.choice([0.0, rng.uniform(1.5, 5.0)]), rng.uniform(0.1, 0.7)
    if rise:
        slope = np.array([0, y / 2 + over, rise * (1 + 2 * over / y)])
        for side in (-1, 1):
            eave = np.array([-x / 2 - over, side * (y / 2 + over), z - 2 * rise * over / y])
            pieces.append(rectangle(eave, [x + 2 * over, 0, 0], slope * [1, -side, 1]))
        for end in (-x / 2, x / 2):
            pieces.append(gable(end, y, z, float(rise)))
        pieces.append(box([0.6, 0.6, rise + 0.8], [rng.uniform(-x / 3, x / 3), rng.uniform(-y / 4, y / 4), z]))
    else:
        pieces.append(box([x + 0.2, y + 0.2, 0.3], [0, 0, z]))
    return joined(pieces)


def gable(x: float, y: float, z: float, rise: float) -> Piece:
    """Make the triangle between a wall across x and the roof."""
    vertices = np.array([[x, -y / 2, z], [x, y / 2, z], [x, 0, z + rise]])
    return Piece(vertices, np.broadcast_to([1.0 if x > 0 else -1.0, 0, 0], (3, 3)), np.array([[0, 1, 2]]))


def facade(rng: Rng, length: float, height: float) -> Piece:
    """Make a wall with rows of windows set back in it, from x = 0; its outer side looks along y, at y = 0.3."""
    step, floor = rng.uniform(1.5, 3.5), rng.uniform(2.6, 3.6)
    wide, high, sill = step * rng.uniform(0.3, 0.6), rng.uniform(1.0, 1.7), rng.uniform(0.5, 1.0)
    openings = []
    for x in np.arange(step / 2, length - step / 2, step):
        for z in np.arange(0, height - sill - high - 0.1, floor):
            low = 0.05 if z == 0 and rng.random() < 0.15 else z + sill
            openings.append((x - wide / 2, x + wide / 2, low, z + sill + high))
    depth = rng.uniform(0.02, 0.25)
    pieces = [wall(length, height, 0.3, openings)]
    for a, b, c, d in openings:
        pieces.append(rectangle([b, 0.3 - depth, c], [a - b, 0, 0], [0, 0, d - c]))
        if rng.random() < 0.3:
            pieces.append(box([b - a + 0.2, 0.1, 0.05], [(a + b) / 2, 0.35, c - 0.06]))
    if rng.random() < 0.4:  # balconies
        for a, b, c, _ in openings[1 :: int(rng.integers(2, 5))]:
            pieces.append(box([b - a + 0.6, 1.0, 0.15], [(a + b) / 2, 0.8, c - 0.2]))
            pieces.append(box([b - a + 0.6, 0.03, 0.9], [(a + b) / 2, 1.28, c - 0.05]))
    if rng.random() < 0.4:
        pieces.append(frustum([length - 0.2, 0.36, 0], [length - 0.2, 0.36, height], 0.05))
    return joined(pieces)
