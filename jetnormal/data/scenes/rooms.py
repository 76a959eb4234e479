"""Rooms seen from inside: walls with doors and windows, furniture, pipes."""

from __future__ import annotations

import numpy as np

from jetnormal.data.scenes.furniture import AGAINST_WALLS, FURNITURE, ottoman, small, tank
from jetnormal.data.scenes.layout import Floor, Scene
from jetnormal.data.scenes.surfaces import Floats, Piece, Rng, box, frustum, grid, joined, rectangle, tube, wall

MARGIN = 0.3  # between the middle of a thing and the walls


def room(rng: Rng) -> Scene:
    """Draw a room of 2.5 to 14 m: a living or office room, or a plant room with pipes and tanks."""
    size = np.array([*rng.uniform(2.5, 7, 2) * (2 if rng.random() < 0.2 else 1), rng.uniform(2.3, 4.5)])
    technical = rng.random() < 0.35
    floor = Floor()
    shell = [rectangle([0, 0, 0], [size[0], 0, 0], [0, size[1], 0]), *_ceiling(size, rng)]
    for corner, yaw, length in (
        ((0, 0), np.pi / 2, size[1]), ((0, size[1]), 0.0, size[0]),
        ((size[0], size[1]), -np.pi / 2, size[1]), ((size[0], 0), np.pi, size[0]),
    ):  # fmt: skip
        shell += [piece.placed([*corner, 0], yaw) for piece in _side(float(length), float(size[2]), rng)]
        _along_wall(floor, corner, yaw, float(length), size, rng)
    _furnish(floor, size, technical, rng)
    shell += _pipes(size, int(rng.integers(3, 14) if technical else rng.integers(0, 4)), rng)
    stands = floor.stands(np.full(2, MARGIN), size[:2] - MARGIN, (0.8, min(1.8, size[2] - 0.4)), rng)
    ends = [0, -1] if len(stands) > 1 else [0, 0]
    return Scene("room", floor.joined(shell), stands, stands[ends])


def _side(length: float, height: float, rng: Rng) -> list[Piece]:
    """A wall from the origin along x, its inner side at y = 0, with doors and windows and what is behind them."""
    thick = rng.uniform(0.08, 0.35)
    openings: list[tuple[float, float, float, float]] = []
    behind: list[Piece] = []
    x = rng.uniform(0.2, 1.5)
    while x < length - 1.0:
        wide = rng.uniform(0.7, 1.6)
        if x + wide < length - 0.1 and rng.random() < 0.5:
            door = rng.random() < 0.5
            low, high = (0.0, 2.05) if door else (rng.uniform(0.5, 1.0), rng.uniform(1.7, height - 0.2))
            openings.append((x, x + wide, low, high))
            behind += _corridor(x, wide, height, thick, rng) if door else _window(x, wide, low, high, thick, rng)
        x += wide + rng.uniform(0.3, 2.5)
    return [wall(length, height, thick, openings), *behind]


def _corridor(x: float, wide: float, height: float, thick: float, rng: Rng) -> list[Piece]:
    """Floor, ceiling and far wall behind a door, and often its open leaf."""
    deep, reach = rng.uniform(1.2, 4.0), rng.uniform(1.0, 3.0)
    left, long = x - reach, wide + 2 * reach
    pieces = [rectangle([left, thick, z], [long, 0, 0], [0, deep, 0]) for z in (0.0, height)]
    pieces.append(rectangle([left, thick + deep, 0], [long, 0, 0], [0, 0, height]))
    if rng.random() < 0.6:
        leaf = box([wide, 0.04, 2.0], [wide / 2, 0, 0])
        handle = frustum([wide - 0.08, -0.06, 1.0], [wide - 0.2, -0.06, 1.0], 0.01)
        pieces.append(joined([leaf, handle]).placed([x, 0.02, 0], rng.uniform(-1.8, -0.2)))
    return pieces


def _window(x: float, wide: float, low: float, high: float, thick: float, rng: Rng) -> list[Piece]:
    """The frame of a window, mostly with a pane."""
    y, bar = thick * rng.uniform(0.3, 0.9), rng.uniform(0.03, 0.08)
    pieces = [box([wide, 0.05, bar], [x + wide / 2, y, z]) for z in (low, high - bar)]
    pieces += [box([bar, 0.05, high - low], [x + share * wide, y, low]) for share in (0.02, 0.5, 0.98)]
    if rng.random() < 0.7:
        pieces.append(rectangle([x, y, low], [wide, 0, 0], [0, 0, high - low]))
    if rng.random() < 0.6:
        pieces.append(box([wide + 0.1, 0.25, 0.03], [x + wide / 2, -0.02, low - 0.03]))
    return pieces


def _ceiling(size: Floats, rng: Rng) -> list[Piece]:
    """A flat ceiling, with beams, or a vault."""
    x, y, z = size
    if rng.random() < 0.15:
        angle = np.linspace(0, np.pi, 49)[:, None]
        rise = rng.uniform(0.3, 1.0) * y / 2  # a half ellipse over y
        along = np.array([[0.0, x]])
        points = np.stack(np.broadcast_arrays(along, y / 2 - y / 2 * np.cos(angle), z + rise * np.sin(angle)), -1)
        normals = np.stack(np.broadcast_arrays(0 * along, y * np.cos(angle) * rise, -y * y / 2 * np.sin(angle)), -1)
        return [grid(points, normals)]
    pieces = [rectangle([0, 0, z], [x, 0, 0], [0, y, 0])]
    if rng.random() < 0.3:
        thick, deep = rng.uniform(0.08, 0.3), rng.uniform(0.1, 0.4)
        pieces += [box([thick, y, deep], [at, y / 2, z - deep]) for at in np.arange(0.5, x, rng.uniform(0.7, 2.0))]
    if rng.random() < 0.5:
        middle = rng.uniform(0.3, 0.7, 2) * size[:2]
        pieces += [frustum([*middle, z], [*middle, z - 0.5], 0.008), ottoman(rng).placed([*middle, z - 0.9])]
    return pieces


def _along_wall(floor: Floor, corner: tuple[float, float], yaw: float, length: float, size: Floats, rng: Rng) -> None:
    """Stand furniture with its back to a wall."""
    for _ in range(rng.integers(0, 4)):
        piece = AGAINST_WALLS[rng.integers(len(AGAINST_WALLS))](rng)
        half = float(np.abs(piece.vertices[:, 0]).max())
        if 2 * half > length - 0.1 or piece.vertices[:, 2].max() > size[2]:
            continue
        along = rng.uniform(half + 0.05, length - half - 0.05)
        spot = np.array(corner) + along * np.array([np.cos(yaw), np.sin(yaw)])
        floor.put(piece, float(spot[0]), float(spot[1]), yaw=yaw, room=0.8)


def _furnish(floor: Floor, size: Floats, technical: bool, rng: Rng) -> None:
    """Put things on the floor."""
    makers = (tank, tank, ottoman, small) if technical else FURNITURE
    for _ in range(round(size[0] * size[1] * rng.uniform(0.1, 1.0))):
        place = rng.uniform(np.full(2, MARGIN), size[:2] - MARGIN)
        floor.put(makers[rng.integers(len(makers))](rng), place[0], place[1], yaw=rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.3:
        floor.put(frustum([0, 0, 0], [0, 0, size[2]], rng.uniform(0.1, 0.3)), *(rng.uniform(0.3, 0.7, 2) * size[:2]))
    if rng.random() < 0.4:
        floor.pieces.append(box([*rng.uniform(1, 2.5, 2), 0.012], [*(size[:2] * rng.uniform(0.3, 0.7, 2)), 0]))


def _pipes(size: Floats, count: int, rng: Rng) -> list[Piece]:
    """Pipes along walls and under the ceiling, with elbows, and ducts."""
    pieces = []
    for _ in range(count):
        radius = float(np.exp(rng.uniform(np.log(0.012), np.log(0.15))))
        bend = radius * rng.uniform(1.5, 4)
        off = radius + rng.uniform(0.02, 0.3)
        x, y, z = off, rng.uniform(0.1, 0.9) * size[1], size[2] - off - rng.uniform(0, 0.5)
        turn = rng.uniform(0.3, 0.9) * size[0]
        path = [[x, y, 0.0], [x, y, z], [turn, y, z], [turn, rng.choice([0.0, size[1]]), z]]
        room_for_bends = min(z, turn - x, abs(path[3][1] - y)) > 2.2 * bend
        if room_for_bends:
            pieces.append(tube(path, radius, bend))
        else:
            pieces.append(frustum([0, y, z], [size[0], y, z], radius))
    if rng.random() < 0.3:
        wide = rng.uniform(0.2, 0.6)
        pieces.append(box([size[0], wide, wide * 0.7], [size[0] / 2, rng.uniform(0.2, 0.8) * size[1], size[2] - wide]))
    return pieces
