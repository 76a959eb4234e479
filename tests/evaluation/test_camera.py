from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere

from jetnormal.evaluation.camera import HEIGHT, OVERSAMPLING, WIDTH, Camera, paint


def test_the_front_of_a_shape_fills_the_picture():
    normals = sphere(3000)
    camera = Camera(1e-3 * normals + 100, normals)
    index = camera.render(1e-3 * normals + 100)
    assert index.shape == (HEIGHT * OVERSAMPLING, WIDTH * OVERSAMPLING)
    rows, columns = np.nonzero(index >= 0)
    assert np.ptp(rows) > 0.85 * index.shape[0]
    assert abs(rows.mean() / index.shape[0] - 0.5) < 0.02
    assert abs(columns.mean() / index.shape[1] - 0.5) < 0.02
    seen = np.unique(index[index >= 0])
    facing = normals[seen] @ camera.axes[2]
    assert (facing > -0.25).all()  # disks hide what lies behind, but for a rim
    assert len(seen) > 0.4 * len(normals)


def test_points_are_shown_where_they_are():
    normals = sphere(3000)
    camera = Camera(normals, normals)
    index = camera.render(normals)
    rows, columns = np.nonzero(index >= 0)
    place = normals[index[rows, columns]] @ camera.axes[:2].T
    across = np.polyfit(columns, place[:, 0], 1)
    down = np.polyfit(rows, place[:, 1], 1)
    assert across[0] == pytest.approx(-down[0], rel=0.01)  # right is to the right, and up is up
    assert np.abs(np.polyval(across, columns) - place[:, 0]).max() < 0.15


def test_y_is_up():
    camera = Camera(sphere(3000), sphere(3000))
    assert camera.axes[1] @ [0, 1, 0] > 0.7
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(1)


def test_the_view_shows_the_side_with_more_to_see():
    """A slab with a corrugated side: its directions vary there alone."""
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform(-1, 1, (4000, 2)), np.full(4000, -0.2)]
    waves = np.c_[rng.uniform(-1, 1, (4000, 2)), np.full(4000, 0.2)]
    tilt = np.array([[0.7, 0, 0.7], [-0.7, 0, 0.7], [0, 0.7, 0.7], [0, -0.7, 0.7]])[rng.integers(4, size=4000)]
    normals = np.concatenate([np.tile([0.0, 0, -1], (4000, 1)), tilt])
    camera = Camera(np.concatenate([flat, waves]), normals)
    assert camera.axes[2, 2] > 0.3


def test_pixels_take_the_color_of_their_point_and_white_without_one():
    index = np.full((2 * OVERSAMPLING, OVERSAMPLING), -1)
    index[:OVERSAMPLING] = 1
    image = paint(index, np.array([[1.0, 0, 0], [0, 0.5, 0]]))
    np.testing.assert_allclose(image, [[[0, 0.5, 0]], [[1, 1, 1]]])
