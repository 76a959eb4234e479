"""Which method settles the signs of a cloud, and from where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import sphere

from jetnormal import Cloud, estimate, formats
from jetnormal.cloud import Source
from jetnormal.errors import InputError, UsageError
from jetnormal.jobs.estimate import estimate_file
from jetnormal.jobs.options import EstimateOptions
from jetnormal.orientation.methods import Orientation
from jetnormal.orientation.policy import seen_from_origin, sign_method


def stations(points):
    """One sensor outside of each point, and none for every fifth."""
    places = points * 3
    places[::5] = np.nan
    return dict(zip(("sx", "sy", "sz"), places.T, strict=True))


@pytest.mark.parametrize(
    ("options", "file_viewpoint", "method", "viewpoint"),
    [
        ({}, None, "global", None),
        ({}, (0, 0, 0, 1, 0, 0, 0), "global", None),
        ({}, (1, 2, 3, 1, 0, 0, 0), "viewpoint", [1, 2, 3]),
        ({"viewpoint": (4.0, 5.0, 6.0)}, (1, 2, 3, 1, 0, 0, 0), "viewpoint", [4, 5, 6]),
        ({"orient": "viewpoint"}, (0, 0, 0, 1, 0, 0, 0), "viewpoint", [0, 0, 0]),
        ({"orient": "mst"}, (1, 2, 3, 1, 0, 0, 0), "mst", None),
    ],
)
def test_what_is_given_goes_before_what_the_file_says(options, file_viewpoint, method, viewpoint):
    cloud = Cloud(sphere(600), source=Source(viewpoint=file_viewpoint))
    found, place = sign_method(EstimateOptions(**options), cloud)
    assert found == method
    assert (place is None) == (viewpoint is None) and (place is None or place.tolist() == viewpoint)


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
    assert summary["orient"] == "viewpoint" and (cosine[known] > 0.9).all()
    unknown = ~known & np.isfinite(points[:, 0])
    assert (result.normals[unknown, 2] >= 0).all()
    np.testing.assert_allclose(result.attributes["sign_confidence"][known], cosine[known], atol=1e-3)
    assert any(f"{unknown.sum()} points have no finite viewpoint" in text for text in summary["warnings"])


def test_an_open_surface_is_warned_of(tmp_path):
    points = sphere(2000)
    formats.write(Cloud(points[points[:, 2] > 0]), tmp_path / "dome.xyz")
    formats.write(Cloud(points), tmp_path / "ball.xyz")
    for name, is_open in (("dome", True), ("ball", False)):
        options = EstimateOptions(model="pca")
        summary = estimate_file(tmp_path / f"{name}.xyz", tmp_path / f"{name}.ply", options)
        assert any("open surfaces" in text for text in summary["warnings"]) == is_open
        assert (formats.read(tmp_path / f"{name}.ply").normals * formats.read(tmp_path / f"{name}.xyz").points).sum(
            axis=1
        ).min() > 0.5


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


def sheet(tilt: float = 0.0) -> tuple[np.ndarray, Orientation]:
    """Points one unit in front of the origin, on an open surface whose normals look away from it."""
    xy = np.random.default_rng(0).random((200, 2)) - 0.5
    points = np.column_stack([xy, np.ones(200)])
    normals = np.tile([0.0, 0.0, 1.0], (200, 1))
    normals[: round(200 * tilt)] *= -1
    return points, Orientation(normals, np.ones(200, dtype=np.float32), np.ones(200, dtype=bool))


def pcd(points: np.ndarray, *position: float) -> Cloud:
    return Cloud(points, source=Source(viewpoint=(*position, 1.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("tilt", [0.0, 0.01, 1.0])
def test_open_surfaces_of_which_the_origin_sees_one_side_look_at_it(tilt):
    points, orientation = sheet(tilt)
    seen = seen_from_origin(orientation, points, EstimateOptions(), pcd(points, 0, 0, 0))
    assert seen is not None
    assert (seen.normals[:, 2] == -1).all()


def test_without_a_word_of_the_file_surfaces_must_look_as_taken_from_the_origin(depth_picture):
    cloud = estimate(Cloud(depth_picture), model="pca")
    assert ((cloud.normals * -depth_picture).sum(axis=1) > 0).mean() > 0.99
    from_behind = np.add(depth_picture * [1, 1, -1], (0, 0, 5))
    cloud = estimate(Cloud(from_behind), model="pca")
    assert (cloud.normals[:, 2] > 0).mean() > 0.9  # up, for want of anything better


def test_the_origin_is_not_believed_without_reason():
    points, orientation = sheet()
    closed = replace(orientation, open=np.zeros(200, dtype=bool))
    origin = pcd(points, 0, 0, 0)
    assert seen_from_origin(sheet(0.5)[1], points, EstimateOptions(), origin) is None
    assert seen_from_origin(closed, points, EstimateOptions(), origin) is None
    assert seen_from_origin(orientation, points, EstimateOptions(orient="global"), origin) is None
    assert seen_from_origin(orientation, points, EstimateOptions(), pcd(points, 1, 0, 0)) is None
    assert seen_from_origin(orientation, points, EstimateOptions(), Cloud(points)) is None


def test_the_scanners_of_a_file_go_before_its_viewpoint_but_not_before_the_users():
    sensors = np.array([5.0, 0.0, 0.0]) + sphere(600)
    cloud = Cloud(sphere(600), source=Source(viewpoint=(1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0), sensors=sensors))
    method, places = sign_method(EstimateOptions(), cloud)
    assert method == "viewpoint" and np.array_equal(places, sensors)
    _, place = sign_method(EstimateOptions(viewpoint=(4.0, 5.0, 6.0)), cloud)
    assert place.tolist() == [4, 5, 6]
    assert sign_method(EstimateOptions(orient="mst"), cloud) == ("mst", None)


def test_a_cloud_needs_one_sensor_for_each_point():
    with pytest.raises(ValueError, match="sensors"):
        Cloud(sphere(5), source=Source(sensors=np.zeros((4, 3))))
