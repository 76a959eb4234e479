"""What stands in rooms. Each is a piece of surface that stands on the origin, in meters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jetnormal.data.scenes.outdoors import person
from jetnormal.data.scenes.surfaces import (
    Floats,
    Piece,
    Rng,
    box,
    frustum,
    joined,
    lathe,
    leaves,
    standing_sheet,
    star,
    turned,
)
from jetnormal.data.solids.starshaped import BumpySphere, Superellipsoid


def table(rng: Rng) -> Piece:
    """Make a table with what lies on it."""
    x, y, z = rng.uniform(0.5, 1.0) * rng.uniform(1, 2), rng.uniform(0.5, 1.0), rng.uniform(0.4, 1.0)
    thick = rng.uniform(0.015, 0.06)
    if rng.random() < 0.7:
        top = box([x, y, thick], [0, 0, z - thick])
        feet = [(sx * (x / 2 - 0.06), sy * (y / 2 - 0.06)) for sx in (-1, 1) for sy in (-1, 1)]
    else:
        top = frustum([0, 0, z - thick], [0, 0, z], y / 2)
        feet = [(0.0, 0.0)]
        x = y = y / np.sqrt(2)
    things = [small(rng).placed([*(rng.uniform(-0.45, 0.45, 2) * [x, y]), z]) for _ in range(rng.integers(0, 9))]
    return joined([top, *(_leg(rng, foot, z - thick) for foot in feet), *things])


def _leg(rng: Rng, foot: tuple[float, float], height: float) -> Piece:
    thick = rng.uniform(0.015, 0.05)
    if rng.random() < 0.5:
        return box([2 * thick, 2 * thick, height], [*foot, 0])
    return frustum([*foot, 0], [*foot, height], thick * rng.uniform(0.5, 1), thick)


def small(rng: Rng) -> Piece:
    """Make a bottle, bowl, book, screen, ball or odd thing."""
    kind = rng.integers(6)
    if kind == 0:
        return vase(rng, rng.uniform(0.1, 0.35))
    if kind == 1:
        return bowl(rng, rng.uniform(0.05, 0.15))
    if kind == 2:
        sizes = rng.uniform([0.1, 0.15, 0.01], [0.2, 0.3, 0.05], (rng.integers(1, 5), 3))
        heights = np.concatenate([[0], np.cumsum(sizes[:-1, 2])])
        books = (box(size).placed([0, 0, z], rng.normal(scale=0.2)) for size, z in zip(sizes, heights, strict=True))
        return joined(books).placed([0, 0, 0], rng.uniform(0, 6))
    if kind == 3:
        x, z = rng.uniform(0.3, 0.8), rng.uniform(0.2, 0.45)
        return joined([box([x, 0.03, z], [0, 0, 0.1]), box([0.05, 0.04, 0.12]), box([0.25, 0.18, 0.015])]).placed(
            [0, 0, 0], rng.uniform(0, 6)
        )
    return blob(rng, rng.uniform(0.04, 0.15))


def blob(rng: Rng, size: float) -> Piece:
    """Make a superellipsoid or a bumpy sphere that lies on the ground."""
    if rng.random() < 0.5:
        axes = rng.uniform(0.5, 1.0, 3)
        return star(Superellipsoid(axes, rng.uniform(2, 8)), [0, 0, size * axes[2]], size)
    waves = rng.normal(size=(4, 3)) * rng.uniform(1.5, 5.0)
    return star(BumpySphere(np.full(4, rng.uniform(0.02, 0.06)), waves, rng.uniform(0, 6, 4)), [0, 0, size], size)


def ottoman(rng: Rng) -> Piece:
    """Make a soft or odd thing on the floor."""
    return blob(rng, rng.uniform(0.15, 0.5))


def vase(rng: Rng, height: float) -> Piece:
    """Make a turned vessel with a smooth profile."""
    base, depth = height * rng.uniform(0.15, 0.4), rng.uniform(0.0, 0.4)
    frequency, phase = rng.uniform(0.5, 2.0) * 2 * np.pi / height, rng.uniform(0, 6)

    def profile(z: Floats) -> tuple[Floats, Floats]:
        return base * (1 + depth * np.sin(frequency * z + phase)), base * depth * frequency * np.cos(
            frequency * z + phase
        )

    top = float(profile(np.array(height))[0])
    lid = frustum([0, 0, height * 0.95], [0, 0, height], top)
    return joined([lathe(height, profile), lid])


def bowl(rng: Rng, radius: float) -> Piece:
    """Make an open vessel with a wall."""
    thick = radius * rng.uniform(0.03, 0.1)
    height = radius * rng.uniform(0.5, 2.0)
    foot = radius * rng.uniform(0.5, 1.0)
    return turned([0, foot, radius, radius - thick, foot - thick, 0], [0, 0, height, height, thick, thick])


def chair(rng: Rng) -> Piece:
    """Make a chair or a stool."""
    seat, wide = rng.uniform(0.4, 0.5), rng.uniform(0.36, 0.5)
    pieces = [box([wide, wide, 0.03], [0, 0, seat])]
    pieces += [_leg(rng, (sx * (wide / 2 - 0.03), sy * (wide / 2 - 0.03)), seat) for sx in (-1, 1) for sy in (-1, 1)]
    if rng.random() < 0.8:
        high = rng.uniform(0.3, 0.6)
        count = 1 if rng.random() < 0.5 else int(rng.integers(3, 7))
        slat = wide / count * (0.5 if count > 1 else 1.0)
        xs = (np.arange(count) + 0.5) * wide / count - wide / 2
        pieces += [box([slat, 0.025, high], [x, wide / 2 - 0.02, seat + 0.03]) for x in xs]
    return joined(pieces)


def sofa(rng: Rng) -> Piece:
    """Make soft cushions on a frame, its back at y = 0."""
    seats, deep, wide = int(rng.integers(1, 4)), rng.uniform(0.7, 0.95), rng.uniform(0.55, 0.7)
    length = seats * wide
    pieces = [box([length, deep, 0.25], [0, -deep / 2, 0.06])]
    for number in range(seats):
        x = (number + 0.5) * wide - length / 2
        pieces.append(star(Superellipsoid([wide / 2, deep / 2, 0.1], 5.0), [x, -deep / 2, 0.38]))
        pieces.append(star(Superellipsoid([wide / 2, 0.12, 0.28], 4.0), [x, -0.14, 0.65]))
    for side in (-1, 1):
        pieces.append(star(Superellipsoid([0.1, deep / 2, 0.2], 5.0), [side * (length / 2 + 0.08), -deep / 2, 0.42]))
    return joined(pieces)


def shelf(rng: Rng) -> Piece:
    """Make boards with books, its back at y = 0."""
    wide, deep, boards = rng.uniform(0.6, 1.6), rng.uniform(0.2, 0.4), int(rng.integers(2, 6))
    gap, thick = rng.uniform(0.28, 0.4), 0.02
    height = boards * gap + thick
    pieces = [box([thick, deep, height], [side * wide / 2, -deep / 2, 0]) for side in (-1, 1)]
    if rng.random() < 0.6:
        pieces.append(box([wide, 0.01, height], [0, -0.005, 0]))
    for board in range(boards + 1):
        z = board * gap
        pieces.append(box([wide, deep, thick], [0, -deep / 2, z]))
        x = -wide / 2 + 0.03
        while board < boards and x < wide / 2 - 0.1:
            if rng.random() < 0.75:
                size = rng.uniform([0.015, 0.12, 0.15], [0.06, deep - 0.02, gap - 0.05])
                pieces.append(box(size, [x + size[0] / 2, -deep + size[1] / 2 + rng.uniform(0, 0.03), z + thick]))
                x += size[0]
            else:
                x += rng.uniform(0.05, 0.3)
    return joined(pieces)


def cabinet(rng: Rng) -> Piece:
    """Make a cupboard with doors and knobs, its back at y = 0."""
    wide, deep, height = rng.uniform(0.4, 1.8), rng.uniform(0.35, 0.65), rng.uniform(0.6, 2.2)
    pieces = [box([wide, deep, height], [0, -deep / 2, 0])]
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    for i in range(columns):
        for j in range(rows):
            x, z = (i + 0.5) * wide / columns - wide / 2, j * height / rows
            pieces.append(box([wide / columns - 0.02, 0.02, height / rows - 0.02], [x, -deep - 0.01, z + 0.01]))
            pieces.append(star(Superellipsoid([0.015] * 3), [x, -deep - 0.035, z + height / rows / 2], rows=13))
    return joined(pieces)


def radiator(rng: Rng) -> Piece:
    """Make a radiator of ribs, or a corrugated one, its back at y = 0."""
    wide, height = rng.uniform(0.5, 1.8), rng.uniform(0.4, 0.9)
    if rng.random() < 0.5:
        xs = np.arange(0.04, wide, rng.uniform(0.045, 0.08)) - wide / 2
        ribs = [frustum([x, -0.08, 0.12], [x, -0.08, height], rng.uniform(0.012, 0.02)) for x in xs]
        bars = [frustum([-wide / 2, -0.08, z], [wide / 2, -0.08, z], 0.02) for z in (0.12, height)]
        return joined([*ribs, *bars])
    return corrugated(wide, height - 0.1, rng.uniform(0.03, 0.08), rng.uniform(0.004, 0.02)).placed(
        [-wide / 2, -0.08, 0.1]
    )


def curtain(rng: Rng) -> Piece:
    """Make a curtain in folds, near y = 0."""
    wide, height = rng.uniform(0.5, 1.5), rng.uniform(1.2, 2.3)
    return corrugated(wide, height, rng.uniform(0.08, 0.2), rng.uniform(0.01, 0.05)).placed([-wide / 2, -0.1, 0.05])


def corrugated(length: float, height: float, wavelength: float, amplitude: float) -> Piece:
    """Make a standing sheet in waves along x."""
    frequency = 2 * np.pi / wavelength

    def offset(x: Floats) -> tuple[Floats, Floats]:
        return amplitude * np.sin(frequency * x), amplitude * frequency * np.cos(frequency * x)

    return standing_sheet(length, height, offset)


def bed(rng: Rng) -> Piece:
    """Make a bed, its head at y = 0."""
    wide = rng.uniform(0.8, 1.8)
    pieces = [box([wide, 2.0, 0.25], [0, -1.0, 0.1]), box([wide, 0.05, rng.uniform(0.6, 1.1)], [0, -0.025, 0])]
    pieces.append(star(Superellipsoid([wide / 2, 0.98, 0.12], 6.0), [0, -1.0, 0.42]))
    pieces += [
        star(Superellipsoid([0.3, 0.2, 0.09], 2.8), [x, -0.25, 0.58]) for x in np.linspace(-wide / 4, wide / 4, 2)
    ]
    return joined(pieces)


def tub(rng: Rng) -> Piece:
    """Make a sink or bath: a block with a hollow, its back at y = 0."""
    radius, height = rng.uniform(0.2, 0.5), rng.uniform(0.3, 0.9)
    inner = star(Superellipsoid([radius, radius, rng.uniform(0.1, 0.28)], rng.uniform(2, 5)), [0, 0, height])
    low = inner.vertices[inner.faces].max(1)[:, 2] <= height + 1e-9
    hollow = Piece(inner.vertices, inner.normals, inner.faces[low])
    outside = turned([radius * 0.7, radius * 1.12, radius * 1.12, radius], [0, height * 0.7, height, height])
    return joined([hollow, outside]).placed([0, -1.2 * radius, 0])


def lamp(rng: Rng) -> Piece:
    """Make a standing lamp with an open shade."""
    height, wide = rng.uniform(1.2, 1.8), rng.uniform(0.12, 0.25)
    shade = turned([wide, wide * rng.uniform(0.4, 1)], [height - 0.25, height])
    return joined([turned([0, 0.14, 0.14, 0], [0, 0, 0.02, 0.03]), frustum([0, 0, 0], [0, 0, height], 0.012), shade])


def pot_plant(rng: Rng) -> Piece:
    """Make a pot with leaves, which have no normals."""
    size = rng.uniform(0.1, 0.3)
    crown = leaves(int(rng.integers(30, 300)), rng.uniform(0.03, 0.1), [size * 1.5, size * 1.5, size * 2], rng)
    return joined([bowl(rng, size), crown.placed([0, 0, 3 * size])])


def steps(rng: Rng) -> Piece:
    """Make a flight of stairs, its side at y = 0."""
    count, wide = int(rng.integers(3, 14)), rng.uniform(0.8, 1.5)
    deep, high = rng.uniform(0.24, 0.32), rng.uniform(0.15, 0.19)
    stairs = [box([deep, wide, high * (number + 1)], [number * deep, -wide / 2, 0]) for number in range(count)]
    run, rise = count * deep, count * high
    rail = frustum([0, -wide, 0.9], [run, -wide, 0.9 + rise], 0.02)
    posts = [
        frustum([x * run, -wide, x * rise], [x * run, -wide, 0.9 + x * rise], 0.012) for x in np.linspace(0.02, 1, 8)
    ]
    return joined([*stairs, rail, *posts]).placed([-run / 2, 0, 0])


def tank(rng: Rng) -> Piece:
    """Make a standing tank with round ends, on legs."""
    radius, height = rng.uniform(0.2, 0.8), rng.uniform(0.5, 2.0)
    dome = Superellipsoid([radius, radius, radius * rng.uniform(0.3, 0.9)])
    low = 0.3 + radius
    legs = [frustum([radius * 0.8 * np.cos(a), radius * 0.8 * np.sin(a), 0], [radius * 0.8 * np.cos(a),
            radius * 0.8 * np.sin(a), low], 0.03) for a in np.arange(3) * 2.1]  # fmt: skip
    shell = lathe(height, lambda z: (np.full_like(z, radius), np.zeros_like(z))).placed([0, 0, low])
    return joined([*legs, shell, star(dome, [0, 0, low]), star(dome, [0, 0, low + height])])


FURNITURE: tuple[Callable[[Rng], Piece], ...] = (table, table, chair, chair, lamp, pot_plant, tank, ottoman, person)
AGAINST_WALLS: tuple[Callable[[Rng], Piece], ...] = (sofa, shelf, cabinet, radiator, curtain, bed, tub, steps)
