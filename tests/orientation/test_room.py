"""A furnished room is told from objects, which may be as hollow."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import even_sphere
from solids import box, drilled_block, joined, ring, scrambled, sphere

from jetnormal.cloud import Source
from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.orientation.policy import settle
from jetnormal.orientation.room import look_inside

LOW, HIGH = (
    np.array([[0.7, 0.5, 0], [2.4, 0.5, 0], [1.5, 1.8, 0]]),
    np.array([[1.5, 1.1, 1], [3.2, 1.1, 1], [2.3, 2.4, 1]]),
)
STATIONS = ((0.3, 0.3, 1.6), (3.7, 0.3, 1.6), (3.7, 2.7, 1.6), (0.3, 2.7, 1.6), (1.95, 1.4, 1.6))


def seen(points, station):
    """Which points no block hides from a station: where the line of sight crosses a block, it ends there."""
    sight = np.where(points == station, 1e-12, points - station)
    enter, leave = ((np.stack([LOW, HIGH]) - station)[:, None] / sight[:, None]).transpose(0, 2, 1, 3)
    first, last = np.minimum(enter, leave).max(axis=2), np.maximum(enter, leave).min(axis=2)
    return ~((first < last) & (first < 1 - 1e-9) & (last > 1e-9)).any(axis=0)


def room(rng, density=200):
    """A room of 4 x 3 x 2.5 m with three blocks on its floor, as five stations in it see it."""
    parts = [box(rng, density, (0, 0, 0), (4, 3, 2.5))]
    parts[0] = parts[0][0], -parts[0][1]
    parts += [box(rng, density, low, high) for low, high in zip(LOW, HIGH, strict=True)]
    points, normals = joined(parts)
    shown = np.zeros(len(points), dtype=bool)
    for station in STATIONS:
        shown |= seen(points, station) & ((station - points) * normals > 1e-9).any(axis=1)
    shown &= ~((points[:, 2] == 0) & (normals[:, 2] < 0))
    return points[shown], normals[shown]


def test_a_furnished_room_looks_inward_and_says_so():
    points, normals = room(np.random.default_rng(0))
    points += np.random.default_rng(1).normal(scale=0.003, size=points.shape)
    orientation, decision = settle(points + 500, scrambled(normals), "auto", None, Source())
    assert decision.used == "inside" and "orient=global" in decision.reason and not decision.warnings()
    assert oriented_accuracy(orientation.normals, normals)[0] > 0.98
    outward = settle(points, scrambled(normals), "global", None, Source())[0]
    assert oriented_accuracy(outward.normals, -normals)[0] > 0.98


def test_stations_see_all_of_a_room_and_outside_none_of_the_blocks():
    points, normals = room(np.random.default_rng(2))
    found = look_inside(points, -normals)
    on_block = (points < [3.9, 2.9, 2.4]).all(axis=1) & (points > [0.1, 0.1, 0.1]).all(axis=1)
    assert found.hidden == pytest.approx(on_block.mean(), abs=0.06)
    assert found.walls_seen > 0.95 and found.found


def test_a_suspicion_is_a_warning(monkeypatch):
    points, normals = room(np.random.default_rng(3))
    monkeypatch.setattr("jetnormal.orientation.room.HIDDEN", 0.3)
    orientation, decision = settle(points, scrambled(normals), "auto", None, Source())
    assert decision.used == "global" and len(decision.warnings()) == 1 and "room" in decision.warnings()[0]
    assert oriented_accuracy(orientation.normals, -normals)[0] > 0.98


def shells(rng):
    directions = even_sphere(9000)
    radii = np.where(np.arange(9000) % 3 == 0, 0.6, 1.0)
    return directions * radii[:, None], directions * np.where(radii == 0.6, -1, 1)[:, None]


def bowl(rng):
    """A hollow hemisphere with a wall of a tenth of its radius, open at the top."""
    outer, inner = sphere(rng, 9000), sphere(rng, 7000, 0.9)
    rim = ring(rng, 1500, 0.95, 0.05)
    parts = [(p[p[:, 2] < 0], sign * n[p[:, 2] < 0]) for (p, n), sign in ((outer, 1), (inner, -1))]
    return joined([*parts, (rim[0][rim[0][:, 2] > 0], rim[1][rim[0][:, 2] > 0])])


@pytest.mark.parametrize(
    "make",
    [shells, bowl, lambda rng: drilled_block(rng, 3000), lambda rng: sphere(rng, 5000), lambda rng: ring(rng, 5000)],
)
def test_objects_are_no_rooms(make):
    points, normals = make(np.random.default_rng(4))
    orientation, decision = settle(points, scrambled(normals), "auto", None, Source())
    assert decision.used == "global" and not decision.warnings()
    assert oriented_accuracy(orientation.normals, normals)[0] > 0.99
