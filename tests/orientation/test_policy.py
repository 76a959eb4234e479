"""Which method settles the signs of a cloud, and from where."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere
from solids import box, scrambled

from jetnormal import Cloud, estimate, formats
from jetnormal.cloud import Source
from jetnormal.errors import InputError, UsageError
from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.geometry.vectors import unit
from jetnormal.jobs.estimate import estimate_file
from jetnormal.jobs.options import EstimateOptions
from jetnormal.orientation import auto
from jetnormal.orientation.calibration import probability
from jetnormal.orientation.grazing import GRAZING
from jetnormal.orientation.policy import find_sensors, orient, settle
from jetnormal.orientation.terrain import is_terrain

ORIGIN, ELSEWHERE = (0, 0, 0, 1, 0, 0, 0), (1, 2, 3, 1, 0, 0, 0)


def stations(points):
    """One sensor outside of each point, and none for every fifth."""
    places = points * 3
    places[::5] = np.nan
    return dict(zip(("sx", "sy", "sz"), places.T, strict=True))


@pytest.mark.parametrize(
    ("options", "source", "viewpoint"),
    [
        ({}, {}, None),
        ({}, {"viewpoint": ORIGIN}, None),
        ({}, {"viewpoint": ORIGIN, "format": "pcd", "width": 30, "height": 20}, [0, 0, 0]),
        ({}, {"viewpoint": (np.nan, 1, 0, 1, 0, 0, 0)}, None),
        ({}, {"viewpoint": ELSEWHERE}, [1, 2, 3]),
        ({"viewpoint": (4.0, 5.0, 6.0)}, {"viewpoint": ELSEWHERE}, [4, 5, 6]),
        ({"orient": "viewpoint"}, {"viewpoint": ORIGIN}, [0, 0, 0]),
        ({"orient": "mst"}, {"viewpoint": ELSEWHERE}, None),
    ],
)
def test_what_is_given_goes_before_what_the_file_says(options, source, viewpoint):
    found = find_sensors(EstimateOptions(**options), Cloud(sphere(600), source=Source(**source)))
    assert (found is None) == (viewpoint is None) and (found is None or found.places.tolist() == viewpoint)


def test_a_file_may_know_a_sensor_of_each_point():
    points = sphere(600)
    cloud = Cloud(points, source=Source(format="e57", sensors=3 * points))
    assert ((orient(cloud, -points) * points).sum(axis=1) > 0.99).all()


def test_attributes_tell_each_point_its_viewpoint(tmp_path):
    points = sphere(600)
    points[1] = np.nan
    points[7] = points[6]
    formats.write(Cloud(points, attributes=stations(points)), tmp_path / "in.ply")
    names = ("sx", "sy", "sz")
    options = EstimateOptions(model="pca", viewpoint_attribute=names, sign_confidence=True)
    summary = estimate_file(tmp_path / "in.ply", tmp_path / "out.ply", options)
    result = formats.read(tmp_path / "out.ply")
    known = np.isfinite(result.attributes["sx"])
    cosine = (result.normals * points).sum(axis=1)
    assert summary["orient"]["used"] == "viewpoint" and (cosine[known] > 0.9).all()
    unknown = ~known & np.isfinite(points[:, 0])
    assert (result.normals[unknown, 2] >= 0).all()
    expected = probability(cosine[known], "sight")
    np.testing.assert_allclose(result.attributes["sign_confidence"][known], expected, atol=1e-3)
    assert any(f"{unknown.sum()} points have no finite viewpoint" in text for text in summary["warnings"])


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"viewpoint_attribute": ("sx", "sy", "height")}, InputError),
        ({"viewpoint_attribute": ("sx", "sy")}, UsageError),
        ({"viewpoint_attribute": ("sx", "sy", "sz"), "viewpoint": (0.0, 0.0, 1.0)}, UsageError),
        ({"viewpoint_attribute": ("sx", "sy", "sz"), "orient": "up"}, UsageError),
        ({"sign_confidence": True, "orient": "none"}, UsageError),
    ],
)
def test_options_that_name_no_viewpoint_are_refused(options, error):
    points = sphere(100)
    with pytest.raises(error):
        estimate(Cloud(points, attributes=stations(points)), model="pca", **options)


def terrain(rng, count=20_000):
    """Hills with houses and trees, seen from above; True for the points of the ground."""
    points = rng.uniform(0, 10, (count, 3))
    x, y, _ = points.T
    ground = np.sin(x) * np.cos(y) / 2
    points[:, 2] = ground
    normals = np.column_stack([-np.cos(x) * np.cos(y) / 2, np.sin(x) * np.sin(y) / 2, np.ones(count)])
    is_ground = np.ones(count, dtype=bool)
    for low in ((2, 3), (6, 6), (7, 1.5)):
        roof = ((points[:, :2] > low) & (points[:, :2] < np.add(low, (1.2, 0.8)))).all(axis=1)
        points[roof, 2], normals[roof], is_ground[roof] = 1.5, (0, 0, 1), False
    crowns = rng.normal(size=(3000, 3))
    crowns /= np.linalg.norm(crowns, axis=1, keepdims=True)
    crowns = crowns[crowns[:, 2] > -0.3]
    trunks = np.array([[1, 8, 1.3], [4.5, 5, 1.3], [8.5, 8.5, 1.3], [5, 1, 1.3]])
    tops = trunks[rng.integers(4, size=len(crowns))] + 0.5 * crowns
    points, normals = np.concatenate([points, tops]), np.concatenate([normals, crowns])
    is_ground = np.append(is_ground, np.zeros(len(tops), dtype=bool))
    return points + rng.normal(scale=0.02, size=points.shape), normals, is_ground


@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_terrain_looks_up_without_a_word(offset):
    points, normals, is_ground = terrain(np.random.default_rng(3))
    signs = np.random.default_rng(4).choice([-1.0, 1.0], (len(points), 1))
    unit = normals * signs / np.linalg.norm(normals, axis=1, keepdims=True)
    orientation, decision = settle(points + offset, unit, "auto", None, Source())
    assert decision.used == "terrain" and not decision.warnings()
    assert (orientation.normals[is_ground, 2] > 0).mean() > 0.999
    assert oriented_accuracy(orientation.normals, normals)[0] > 0.97
    turned = settle(points[:, [2, 0, 1]], unit[:, [2, 0, 1]], "auto", None, Source())[1]
    assert turned.used != "terrain"


def test_objects_rooms_and_plates_are_no_terrain():
    rng = np.random.default_rng(5)
    assert not is_terrain(sphere(4000), sphere(4000))
    for height in (0.2, 0.6):  # a plate, a room: two levels
        points = rng.uniform(0, 4, (8000, 3))
        points[:, 2] = height * rng.integers(2, size=8000)
        assert not is_terrain(points, np.tile([0.0, 0, 1], (8000, 1)))
    for height in (0.8, 1.0, 1.3):  # a box: walls are not level
        assert not is_terrain(*box(rng, 100, (0, 0, 0), (4, 4, height)))


def test_a_flat_object_with_a_bottom_is_no_terrain_and_ground_under_trees_is():
    rng = np.random.default_rng(8)
    flattened = np.array([1, 0.5, 0.1])
    points, normals = sphere(1500) * flattened, unit(sphere(1500) / flattened)
    up = np.where(normals[:, 2:] < 0, -normals, normals)
    assert is_terrain(points, up) and not is_terrain(points, normals)
    leaves = rng.uniform((-1, -0.5, -0.1), (1, 0.5, 0.1), (3000, 3))
    leafy = unit(rng.normal(size=leaves.shape) * [0.3, 0.3, 1])
    forest, down = np.concatenate([points, leaves]), np.concatenate([normals, leafy])
    assert is_terrain(forest, down)


@pytest.mark.parametrize("eye", [3.0, -3.0])
def test_density_tells_a_bumpy_face_seen_from_below_from_terrain(eye):
    """A sensor sees more of what is near it, and of what faces it."""
    rng = np.random.default_rng(11)
    x, y = rng.uniform(-4.5, 4.5, (2, 12_000))
    points = np.column_stack([x, y, 0.5 * np.sin(x) * np.cos(y)])
    slopes = np.column_stack([-0.5 * np.cos(x) * np.cos(y), 0.5 * np.sin(x) * np.sin(y), np.ones(len(x))])
    sights = points - [0, 0, eye]
    density = np.abs((sights * slopes).sum(axis=1)) / np.linalg.norm(sights, axis=1) ** 3
    drawn = rng.random(len(x)) < 4 * density
    decision = settle(points[drawn], unit(slopes[drawn]), "auto", None, Source())[1]
    assert (decision.used == "terrain") == (eye > 0) and bool(decision.warnings()) == (eye < 0)


@pytest.mark.parametrize("turn", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_one_view_of_an_object_looks_to_where_it_was_seen_from(turn):
    """A ball in front of a rod, seen along z; whoever sees it from behind sees the same points."""
    rng = np.random.default_rng(6)
    ball = sphere(9000)
    angle = rng.uniform(0, np.pi, 3000)
    rod = np.column_stack([0.3 * np.cos(angle), rng.uniform(-2, 2, 3000), 0.3 * np.sin(angle) - 1])
    ball, free = ball[ball[:, 2] > 0.1], np.hypot(rod[:, 0], rod[:, 1]) > 1
    around = np.column_stack([np.cos(angle), np.zeros(3000), np.sin(angle)])
    points, normals = np.concatenate([ball, rod[free]]), np.concatenate([ball, around[free]])
    for mirrored in (1, -1):
        seen, truth = (points * mirrored)[:, turn], (normals * mirrored)[:, turn]
        orientation, decision = settle(seen, truth * rng.choice([-1, 1], (len(truth), 1)), "auto", None, Source())
        assert decision.used == "view" and not decision.warnings()
        assert oriented_accuracy(orientation.normals, truth)[0] > 0.99


def test_what_nothing_tells_is_a_guess_with_a_warning():
    rng = np.random.default_rng(7)
    wall = rng.uniform(-1, 1, (4000, 3)) * [1, 0, 1]
    _, decision = settle(wall, np.tile([0.0, 1, 0], (4000, 1)), "auto", None, Source())
    assert decision.guessed and "which side was seen" in decision.warnings()[0]
    _, decision = settle(sphere(600), sphere(600), "auto", None, Source())
    assert decision.used == "global" and not decision.warnings()
    assert decision.facts() == {
        "asked": "auto",
        "used": "global",
        "reason": decision.reason,
        "open_share": 0,
        "confidence": decision.confidence,
    }


@pytest.mark.parametrize("tilt", [0.0, 0.01, 1.0])
def test_open_surfaces_of_which_the_stated_origin_sees_one_side_look_at_it(tilt):
    rng = np.random.default_rng(8)
    points = np.column_stack([np.ones(800), rng.random((800, 2)) - 0.5])
    normals = np.tile([1.0, 0.0, 0.0], (800, 1))
    normals[: round(800 * tilt)] *= -1
    orientation, decision = settle(points, normals, "auto", None, Source(viewpoint=ORIGIN))
    assert decision.used == "origin" and (orientation.normals[:, 0] == -1).all()
    assert settle(points, normals, "auto", None, Source())[1].guessed


def test_without_a_word_of_the_file_surfaces_must_look_as_taken_from_the_origin(depth_picture):
    cloud = estimate(Cloud(depth_picture), model="pca")
    assert ((cloud.normals * -depth_picture).sum(axis=1) > 0).mean() > 0.99


def test_an_object_without_a_bottom_that_was_seen_from_all_round_is_no_single_view():
    """Three quarters of a wall under a dome: its borders lean a little, but half of it hides behind the rest."""
    rng, full = np.random.default_rng(0), 1.5 * np.pi
    angle = rng.uniform(0, full, 8000)
    wall = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    dome = unit(rng.normal(size=(12_000, 3)))
    dome = dome[(dome[:, 2] > 0) & (np.arctan2(dome[:, 1], dome[:, 0]) % (2 * np.pi) < full)]
    points = np.concatenate([wall + rng.uniform(0, 1.5, (8000, 1)) * [0, 0, 1], dome + np.array([0, 0, 1.5])])
    outward = np.concatenate([wall, dome])
    orientation, decision = settle(points, scrambled(outward), "auto", None, Source())
    assert oriented_accuracy(orientation.normals, outward)[0] > 0.99
    assert decision.used == "global" and "several sides" in decision.reason and decision.guessed


def test_a_trajectory_tells_where_each_point_was_seen_from(tmp_path):
    rng = np.random.default_rng(9)
    points = sphere(600)
    seconds = rng.uniform(0, 10, len(points))
    seconds[:5] = 11
    path = tmp_path / "flight.csv"
    path.write_text("time,x,y,z\n0,-50,0,3\n10,50,0,3\n")
    cloud = Cloud(points, attributes={"gps_time": seconds})
    with pytest.warns(UserWarning, match="5 points have no finite viewpoint"):
        result = estimate(cloud, model="pca", trajectory=str(path), time_attribute="GpsTime")
    place = np.column_stack([10 * seconds - 50, np.zeros(len(points)), np.full(len(points), 3.0)])
    cosine = (result.normals * (place - points)).sum(axis=1) / np.linalg.norm(place - points, axis=1)
    assert (cosine[5:] > -GRAZING).all()  # where the sight line grazes the surface, neighbors count as well
    with pytest.raises(InputError, match="no attribute 'stamp'"):
        estimate(cloud, model="pca", trajectory=str(path), time_attribute="stamp")
    path.write_text("0 1 2 3\n1 2 x 4\n")
    with pytest.raises(InputError, match="line 2"):
        estimate(cloud, model="pca", trajectory=str(path))


def test_the_public_call_decides_as_estimate_does():
    points = sphere(2000)
    scrambled = points * np.random.default_rng(10).choice([-1.0, 1.0], (2000, 1))
    np.testing.assert_array_equal(orient(points, scrambled), points)
    np.testing.assert_array_equal(orient(Cloud(points, scrambled), viewpoint=(0, 0, 0)), -points)
    np.testing.assert_array_equal(orient(points, scrambled, viewpoint=points * 0), -points)
    with pytest.raises(InputError, match="need normals"):
        orient(points)


def test_many_points_are_decided_by_a_part(monkeypatch):
    """With copies, lengths, and rows without a point or a direction; the signs that come in do not matter."""
    monkeypatch.setattr(auto, "ENOUGH", 1000)
    points = np.concatenate([sphere(6000), sphere(6000)[:50]])
    normals = np.random.default_rng(1).uniform(0.5, 2, (len(points), 1)) * points
    points[7], normals[8] = np.nan, 0
    scrambled = normals * np.random.default_rng(2).choice([-1.0, 1.0], (len(points), 1))
    known = np.isfinite(points).all(axis=1)
    orientation, decision = settle(points[known], scrambled[known], "auto", None, Source(), copies=True)
    right = np.einsum("nd,nd->n", orientation.normals, points[known]) > 0
    assert decision.used == "global" and decision.confidence > 0.9
    assert right.sum() == known.sum() - 1 and orientation.confidence[7] == 0  # the one without a direction
    np.testing.assert_array_equal(np.abs(orientation.normals), np.abs(normals[known]))
    again = orient(points, -scrambled)
    np.testing.assert_array_equal(again[known], orientation.normals)
    np.testing.assert_array_equal(again[~known], -scrambled[~known])
    distinct = np.flatnonzero(known)[:-50]
    alone, _ = settle(points[distinct], scrambled[distinct], "auto", None, Source())
    np.testing.assert_array_equal(alone.normals, orientation.normals[:-50])
