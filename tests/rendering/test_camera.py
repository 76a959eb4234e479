from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere

from jetnormal.errors import UsageError
from jetnormal.rendering.camera import VIEWS, camera_axes, interesting_direction, make_camera, view_direction

BOX = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [3, 1, 1]


@pytest.mark.parametrize("view", [*VIEWS, "30:40"])
def test_everything_is_in_the_picture_and_fills_it(view):
    camera = make_camera(BOX, view_direction(view, np.zeros((1, 3)), np.zeros((1, 3))), 200)
    pixels, depth = camera.project(camera.to_frame(BOX))
    assert (depth > 0).all()
    assert pixels.min() > 0 and (pixels.max(axis=0) < [camera.width, camera.height]).all()
    assert (np.ptp(pixels, axis=0) / [camera.width, camera.height]).max() > 0.85
    assert max(camera.width, camera.height) == 200


def test_rays_go_through_the_pixels_that_points_fall_on():
    camera = make_camera(BOX, view_direction("iso", np.zeros((1, 3)), np.zeros((1, 3))), 50)
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
    axes = camera_axes(view_direction(view, np.zeros((1, 3)), np.zeros((1, 3))))
    assert np.allclose(axes[:2], [right, up], atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def test_auto_looks_at_the_side_that_was_scanned():
    one_sided = np.tile([0.0, 0.0, -1.0], (10, 1))
    assert view_direction("auto", BOX[:10], one_sided)[2] < -0.9
    ball = sphere(5000)
    assert np.array_equal(view_direction("auto", ball, ball), VIEWS["iso"])


def test_auto_looks_at_outer_sides():
    """A box without the faces that "iso" sees first: there it would show its inner sides."""
    side, normals = np.random.default_rng(0).uniform(-1, 1, (6, 2000, 3)), np.zeros((6, 2000, 3))
    for face, (axis, sign) in enumerate((axis, sign) for axis in range(3) for sign in (-1, 1)):
        side[face, :, axis], normals[face, :, axis] = sign, sign
    kept = [0, 3, 4, 5]  # -x, y and both of z; not x and -y
    points, normals = side[kept].reshape(-1, 3), normals[kept].reshape(-1, 3)
    towards = view_direction("auto", points, normals)
    assert towards[0] < 0 < towards[1]


def test_an_outlier_does_not_make_the_rest_small():
    points = np.r_[BOX, [[1000.0, 0, 0]]]
    camera = make_camera(points, view_direction("front", np.zeros((1, 3)), np.zeros((1, 3))), 200)
    pixels, _ = camera.project(camera.to_frame(BOX))
    assert np.ptp(pixels[:, 0]) > 150


@pytest.mark.parametrize("view", ["inside", "30", "a:b", "1:2:3", ""])
def test_an_unknown_view_is_a_usage_error(view):
    with pytest.raises(UsageError, match="iso"):
        view_direction(view, np.zeros((1, 3)), np.zeros((1, 3)))


def test_the_interesting_view_shows_the_side_with_more_to_see():
    """A slab with a corrugated side: its directions vary there alone."""
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform(-1, 1, 4000), np.full(4000, 0.2), rng.uniform(-1, 1, 4000)]
    waves = np.c_[rng.uniform(-1, 1, 4000), np.full(4000, -0.2), rng.uniform(-1, 1, 4000)]
    tilt = np.array([[0.7, -0.7, 0], [-0.7, -0.7, 0], [0, -0.7, 0.7], [0, -0.7, -0.7]])[rng.integers(4, size=4000)]
    normals = np.concatenate([np.tile([0.0, 1, 0], (4000, 1)), tilt])
    assert interesting_direction(np.concatenate([flat, waves]), normals)[1] < -0.3
