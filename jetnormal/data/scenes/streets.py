"""Streets between facades, with cars, poles, trees and people."""

from __future__ import annotations

import numpy as np

from jetnormal.data.scenes.layout import Floor, Scene
from jetnormal.data.scenes.outdoors import car, facade, fence, house, person, pole, tree
from jetnormal.data.scenes.surfaces import Floats, Piece, Rng, box, height_field, rectangle


def street(rng: Rng) -> Scene:
    """Draw a street along x of 20 to 80 m, with houses on one or both sides, or a square."""
    length, road, walk = rng.uniform(20, 80), rng.uniform(2.8, 8), rng.uniform(1.0, 4.5)
    floor = Floor()
    ground = [_road(length, road, rng)]
    for side in (-1.0, 1.0):
        ground.append(box([length, walk, 0.12], [length / 2, side * (road + walk / 2), 0]))
        ground += _row(length, side, road + walk, rng)
        _along(floor, length, side, road, walk, rng)
    heights = (1.4, 1.9)
    stands = floor.stands(np.array([0.2 * length, -road - walk]), np.array([0.8 * length, road + walk]), heights, rng)
    lane, high = rng.uniform(-0.4, 0.4) * road, rng.uniform(1.6, 2.8)
    trip = np.array([[0.1 * length, lane, high], [0.9 * length, lane, high]])
    return Scene("street", floor.joined(ground), stands, trip)


def _road(length: float, road: float, rng: Rng) -> Piece:
    """The road, higher in the middle, slightly uneven."""
    crown, waves, height = rng.uniform(0.0, 0.03) / road, rng.uniform(0.05, 0.8, 3), rng.uniform(0, 0.015)
    phases = rng.uniform(0, 6, 3)

    def surface(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        angles = [wave * (x + 0.7 * y) + phase for wave, phase in zip(waves, phases, strict=True)]
        z = -crown * y**2 + height * sum(np.sin(angle) for angle in angles)
        rise = height * sum(wave * np.cos(angle) for wave, angle in zip(waves, angles, strict=True))
        return z, rise, -2 * crown * y + 0.7 * rise

    return height_field(np.linspace(0, length, 161), np.linspace(-road, road, 17), surface)


def _row(length: float, side: float, back: float, rng: Rng) -> list[Piece]:
    """Facades wall to wall, detached houses with fences, or open ground, behind the pavement."""
    kind = rng.random()
    beyond = side * (back + 15)
    pieces = [rectangle([0, side * back, 0], [length, 0, 0], [0, beyond - side * back, 0])]
    x = 0.0
    while x < length and kind < 0.85:
        wide = rng.uniform(6, 18)
        if kind < 0.55:
            front = facade(rng, wide, rng.uniform(4, 18)).placed([0, -0.3, 0])
            setback = rng.choice([0.0, rng.uniform(0, 1.5)])
            # The outer side, along y, is turned to the road.
            spot = [x + wide, back + setback, 0] if side > 0 else [x, -back - setback, 0]
            pieces.append(front.placed(spot, np.pi if side > 0 else 0.0))
            x += wide + rng.choice([0.0, rng.uniform(1, 5)], p=[0.7, 0.3])
        else:
            pieces.append(house(rng).placed([x + 9, side * (back + 10), 0], rng.choice([0, np.pi / 2])))
            pieces.append(fence(rng).placed([x, side * (back + 0.4), 0]))
            x += rng.uniform(17, 28)
    return pieces


def _along(floor: Floor, length: float, side: float, road: float, walk: float, rng: Rng) -> None:
    """Things on the pavement, and cars along it."""
    for x in np.arange(rng.uniform(1, 4), length, rng.uniform(5.5, 9)):
        if rng.random() < 0.5:
            floor.put(car(rng), x, side * (road - 1.1), yaw=rng.choice([0, np.pi]) + rng.normal(scale=0.03), room=0.6)
    for maker, gap in ((pole, rng.uniform(6, 25)), (tree, rng.uniform(5, 30)), (person, rng.uniform(4, 30))):
        for x in np.arange(rng.uniform(0, gap), length, gap):
            across = side * (road + rng.uniform(0.2, 0.9) * walk)
            floor.put(maker(rng), x, across, 0.12, rng.uniform(0, 2 * np.pi), room=0.15)
