"""Which way is up: a depth picture, landscapes, and objects that stand on their base."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal.rendering.upright import guess_up


def test_a_depth_camera_looks_along_z_with_y_down(depth_picture):
    assert guess_up(depth_picture).tolist() == [0, -1, 0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_flat_side_of_a_landscape_is_up(axis):
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * 50
    points[:, axis] /= 10
    assert guess_up(points + 1000).tolist() == np.eye(3)[axis].tolist()


def test_a_pole_stands_upright():
    assert guess_up(np.random.default_rng(0).uniform(size=(500, 3)) * [1, 1, 6] + [9, 9, 0]).tolist() == [0, 0, 1]


@pytest.mark.parametrize("axis", [1, 2])
def test_an_object_stands_on_its_base(axis):
    rng = np.random.default_rng(0)
    body = rng.normal(size=(3000, 3))
    body *= [1, 1, 1] / np.linalg.norm(body, axis=1, keepdims=True)
    base = rng.uniform(-0.7, 0.7, (600, 3))
    base[:, axis] = -1.02
    assert guess_up(np.concatenate([body, base])).tolist() == np.eye(3)[axis].tolist()


def test_where_nothing_tells_z_is_up():
    ball = np.random.default_rng(0).normal(size=(3000, 3))
    assert guess_up(ball / np.linalg.norm(ball, axis=1, keepdims=True)).tolist() == [0, 0, 1]
