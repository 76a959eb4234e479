"""Scans from inside, as of rooms and streets, are told from objects, which may be as hollow."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import even_sphere
from solids import box, drilled_block, joined, ring, scrambled, sphere

from jetnormal.cloud import Source
from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.orientation.decision import RATHER, Decision
from jetnormal.orientation.inside import Evidence, find_evidence
from jetnormal.orientation.methods import choose_signs
from jetnormal.orientation.places import Hull, drawn_evenly, look_from
from jetnormal.orientation.policy import orient, settle

SIZE = np.array([4.0, 3.0, 2.5])
LOW, HIGH = (
    np.array([[0.7, 0.5, 0], [2.4, 0.5, 0], [1.5, 1.8, 0]]),
    np.array([[1.5, 1.1, 1], [3.2, 1.1, 1], [2.3, 2.4, 1]]),
)
STATIONS = ((0.3, 0.3, 1.6), (3.7, 0.3, 1.6), (1.95, 1.4, 1.6))


def seen(rng, station, count):
    """What a scanner sees of a room of 4 x 3 x 2.5 m with three blocks on its floor: points and normals."""
    sight = rng.normal(size=(count, 3))
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    to_wall = (np.where(sight > 0, SIZE, 0) - station) / sight
    axis = to_wall.argmin(axis=1)
    distance, side = to_wall.min(axis=1), -np.sign(sight)
    for low, high in zip(LOW, HIGH, strict=True):
        enter, leave = np.sort(np.stack([low - station, high - station])[:, None] / sight, axis=0)
        first = enter.max(axis=1)
        met = (first < leave.min(axis=1)) & (first > 0) & (first < distance)
        axis, distance = np.where(met, enter.argmax(axis=1), axis), np.where(met, first, distance)
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = side[np.arange(count), axis]
    return station + distance[:, None] * sight, normals


def room(rng, stations=STATIONS, count=4000):
    return joined([seen(rng, np.array(station), count) for station in stations])


@pytest.fixture(scope="module")
def scanned_room():
    points, normals = room(np.random.default_rng(0))
    return points + np.random.default_rng(1).normal(scale=0.003, size=points.shape), normals


@pytest.mark.parametrize("turn", [[0, 1, 2], [1, 2, 0]])
def test_a_room_looks_inward_and_says_so(scanned_room, turn):
    points, normals = (array[:, turn] for array in scanned_room)
    orientation, decision = settle(points + 500, scrambled(normals), "auto", None, Source())
    assert decision.used == "inside" and "orient=global" in decision.reason
    assert oriented_accuracy(orientation.normals, normals)[0] > 0.98
    outward = settle(points, scrambled(normals), "global", None, Source())[0]
    assert oriented_accuracy(outward.normals, -normals)[0] > 0.98


def test_what_is_found_turns_and_grows_with_the_cloud(scanned_room):
    points, normals = scanned_room
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    here = find_evidence(points, normals, False)
    there = find_evidence(1000 * points @ turn.T + 5, normals @ turn.T, False)
    np.testing.assert_allclose([*vars(there).values()], [*vars(here).values()], atol=0.02)


def test_the_doubt_is_in_the_warning_and_in_the_confidence(scanned_room, monkeypatch):
    points, normals = scanned_room
    monkeypatch.setattr(Evidence, "probability", 0.8)
    inward, decision = settle(points, scrambled(normals), "auto", None, Source())
    assert decision.used == "inside" and "80%" in decision.warnings()[0] and len(decision.warnings()) == 1
    assert inward.confidence.max() <= 0.81
    monkeypatch.setattr(Evidence, "probability", RATHER - 0.01)
    outward, decision = settle(points, scrambled(normals), "auto", None, Source())
    assert decision.used == "global" and "viewpoint" in decision.warnings()[0] and len(decision.warnings()) == 1
    assert outward.confidence.max() <= 1.01 - decision.inside
    assert oriented_accuracy(outward.normals, -normals)[0] > 0.98
    for sure in (0.001, 0.999):
        monkeypatch.setattr(Evidence, "probability", sure)
        assert not settle(points, scrambled(normals), "auto", None, Source())[1].warnings()


@pytest.mark.parametrize(("confidence", "warnings"), [(0.7, 1), (0.9, 0)])
def test_a_room_whose_signs_are_hardly_sure_gets_a_warning(confidence, warnings):
    found = Decision("auto", "inside", "a room", confidence=confidence, inside=0.95).warnings()
    assert len(found) == warnings and all("70%" in text and "viewpoint" in text for text in found)


def test_points_without_a_direction_have_no_confidence(scanned_room):
    points, normals = scanned_room
    given = scrambled(normals)
    given[5] = 0
    orientation, _ = settle(points, given, "auto", None, Source())
    assert orientation.confidence[5] == 0 and orientation.confidence[6] > 0


def test_places_inside_turn_an_open_street():
    """Ground and two facades; no ceiling."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 1, (9000, 3)) * [20, 6, 8]
    normals = np.zeros((9000, 3))
    for part, (axis, value, sign) in enumerate(((2, 0, 1), (1, 0, 1), (1, 6, -1))):
        points[part::3, axis], normals[part::3, axis] = value, sign
    found = choose_signs(points, scrambled(normals), "inside")
    assert oriented_accuracy(found.normals, normals)[0] > 0.99 and not found.open.any()


def test_walls_that_no_place_inside_sees_are_seen_from_behind():
    """A small room beside a large one, in which all places are."""
    rng = np.random.default_rng(8)
    points, normals = joined([box(rng, 200, (0, 0, 0), (6, 6, 3)), box(rng, 200, (6.2, 0, 0), (6.9, 0.7, 3))])
    found = choose_signs(points, scrambled(normals), "inside")
    assert oriented_accuracy(found.normals, -normals)[0] > 0.99


def test_density_tells_the_side_of_a_single_frame():
    """The corner of a room, whose borders lean to the back; a pinhole camera sees more of what is near."""
    rng = np.random.default_rng(9)
    forward, side, up = np.linalg.qr([[-1.0, 0.8, 0], [-0.8, -1, 0], [0.1, 0, 1]])[0].T
    sight = (
        np.abs(forward) * [1, 1, -1] + rng.uniform(-0.6, 0.6, (8000, 1)) * side + rng.uniform(-0.6, 0.6, (8000, 1)) * up
    )
    eye = np.array([0.3, 0.4, 1.5])
    to_wall = (np.where(sight > 0, SIZE, 0) - eye) / sight
    axis = to_wall.argmin(axis=1)
    points, normals = eye + to_wall.min(axis=1)[:, None] * sight, np.zeros((8000, 3))
    normals[np.arange(8000), axis] = -np.sign(sight[np.arange(8000), axis])
    assert find_evidence(points, normals, True).behind < -0.3
    assert find_evidence(points, -normals, True).behind > 0.3


def test_sensors_outside_explain_the_density_of_an_object_and_one_inside_that_of_a_room():
    rng = np.random.default_rng(10)
    of_box = find_evidence(*box(rng, 600, (0, 0, 0), (3, 2, 2)), False)
    of_room = find_evidence(*room(rng, STATIONS[:1], 12_000), False)
    assert of_box.misfit < -2 and of_room.misfit > -1 and of_room.slope > 0.8


def test_a_place_sees_what_nothing_hides():
    wall, screen = (np.column_stack([np.full(4000, x), np.random.default_rng(4).uniform(-1, 1, (4000, 2)) * w])
                    for x, w in ((2.0, 2), (1.0, 0.5)))  # fmt: skip
    points, normals = np.concatenate([wall, screen]), np.tile([-1.0, 0, 0], (8000, 1))
    cosine = look_from(np.zeros(3), points, normals, 0.05)
    behind = (np.abs(wall[:, 1:]) < 0.8).all(axis=1)
    beside = (np.abs(wall[:, 1:]) > 1.3).any(axis=1)
    assert (cosine[:4000][behind] == 0).mean() > 0.95 and (cosine[4000:] > 0).mean() > 0.95
    assert (cosine[:4000][beside] > 0).mean() > 0.5  # of what is seen aslant, the farther points of a pixel are lost


def test_places_are_inside_and_away_from_the_points():
    hull = Hull(sphere(np.random.default_rng(5), 2000)[0])
    places = hull.places()
    assert (np.linalg.norm(places, axis=1) < 0.9).all() and 30 <= len(places) <= 48
    np.testing.assert_allclose(hull.depth(np.array([[0, 0, 0.0], [0, 0, 2.0]])), [1, -1], atol=0.02)
    assert hull.size == pytest.approx(np.sqrt(4 * np.pi), rel=0.02)


def test_points_are_drawn_evenly_and_strays_never():
    rng = np.random.default_rng(6)
    dense = np.arange(20_000) % 10 > 0  # nine of ten lie in a tenth of the area
    spacing = np.where(dense, 1.0, 9.0) * rng.uniform(0.9, 1.1, 20_000)
    spacing[:20] = 1e6
    rows = drawn_evenly(spacing, 1000)
    assert len(rows) == 1000 and rows.min() >= 20
    assert dense[rows].mean() == pytest.approx(0.1, abs=0.03)


def test_what_stands_in_a_room_is_hidden_and_the_wall_of_a_cavity_does_not_count(scanned_room):
    rng = np.random.default_rng(7)
    outer, cavity = sphere(rng, 6000), sphere(rng, 3000, 0.6)
    found = find_evidence(*joined([outer, (cavity[0], -cavity[1])]), False)
    assert found.hidden == 0 and found.misfit < -1.5
    assert find_evidence(*scanned_room, False).hidden > 0.1
    assert find_evidence(*outer, False).hidden == 0


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


def far_boxes(rng):
    places = rng.uniform(-1e4, 1e4, (100, 3))
    return joined([box(rng, 20, tuple(place), tuple(place + 2)) for place in places])


@pytest.mark.parametrize(
    "make",
    [
        shells,
        bowl,
        far_boxes,
        lambda rng: drilled_block(rng, 3000),
        lambda rng: sphere(rng, 5000),
        lambda rng: ring(rng, 5000),
        lambda rng: box(rng, 500, (0, 0, 0), (3, 2, 1)),
    ],
)
def test_objects_look_outward(make):
    points, normals = make(np.random.default_rng(4))
    orientation, decision = settle(points, scrambled(normals), "auto", None, Source())
    assert decision.used == "global" and not decision.warnings()
    assert oriented_accuracy(orientation.normals, normals)[0] > 0.99


def test_few_points_and_flat_ones_tell_nothing():
    points = np.random.default_rng(7).uniform(size=(3000, 3)) * [1, 1, 0]
    normals = np.tile([0.0, 0, 1], (3000, 1))
    assert find_evidence(points, normals, True) is None
    assert find_evidence(points[:50], normals[:50], True) is None
    assert (orient(points, normals)[:, 2] == 1).all()
    for count in (1, 3, 3000):
        assert (np.abs(orient(points[:count], normals[:count], "inside")[:, 2]) == 1).all()
