from __future__ import annotations

import numpy as np
import pytest

from jetnormal.errors import UsageError
from jetnormal.rendering.camera import VIEWS, camera_axes, make_camera, view_direction

BOX = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [3, 1, 1]


@pytest.mark.parametrize("view", [*VIEWS, "30:40"])
def test_everything_is_in_the_picture_and_fills_it(view):
    camera = make_camera(BOX, view_direction(view, np.zeros((1, 3))), 200)
    pixels, depth = camera.project(camera.to_frame(BOX))
    assert (depth > 0).all()
    assert pixels.min() > 0 and (pixels.max(axis=0) < [camera.width, camera.height]).all()
    assert (np.ptp(pixels, axis=0) / [camera.width, camera.height]).max() > 0.85
    assert max(camera.width, camera.height) == 200


def test_rays_go_through_the_pixels_that_points_fall_on():
    camera = make_camera(BOX, view_direction("iso", np.zeros((1, 3))), 50)
    frame = camera.to_frame(BOX[:20])
    pixels, depth = camera.project(frame)
    column, row = np.floor(pixels).astype(int).T
    hits = np.array([0, 0, camera.distance]) + camera.rays()[row, column] * depth[:, None]
    assert np.abs(hits - frame).max() < depth.max() / camera.scale


@pytest.mark.parametrize(
    ("view", "right", "up"),
    [("front", (1, 0, 0), (0, 0, 1)), ("right", (0, 1, 0), (0, 0, 1)), ("top", (1, 0, 0), (0, 1, 0)),
     ("90:0", (0, 1, 0), (0, 0, 1)), ("bottom", (1, 0, 0), (0, -1, 0))],
)  # fmt: skip
def test_views_have_the_sides_where_they_belong(view, right, up):
    axes = camera_axes(view_direction(view, np.zeros((1, 3))))
    assert np.allclose(axes[:2], [right, up], atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_auto_looks_at_the_side_that_was_scanned():
    one_sided = np.tile([0.0, 0.0, -1.0], (10, 1))
    assert view_direction("auto", one_sided)[2] < -0.9
    assert np.array_equal(view_direction("auto", np.r_[one_sided, -one_sided]), VIEWS["iso"])


def test_an_outlier_does_not_make_the_rest_small():
    points = np.r_[BOX, [[1000.0, 0, 0]]]
    camera = make_camera(points, view_direction("front", np.zeros((1, 3))), 200)
    pixels, _ = camera.project(camera.to_frame(BOX))
    assert np.ptp(pixels[:, 0]) > 150


@pytest.mark.parametrize("view", ["inside", "30", "a:b", "1:2:3", ""])
def test_an_unknown_view_is_a_usage_error(view):
    with pytest.raises(UsageError, match="iso"):
        view_direction(view, np.zeros((1, 3)))
