"""Where a cloud seems to have been taken from."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal.orientation.visibility import taken_from_origin

WALL = 3.0  # depth of what is farthest in the picture


@pytest.mark.parametrize("axis", [1, -1])
def test_a_depth_picture_was_taken_from_the_origin(depth_picture, axis):
    assert taken_from_origin(depth_picture * [1, axis, axis])


@pytest.mark.parametrize(
    "moved",
    [
        lambda points: np.add(points * [1, 1, -1], (0, 0, 2 * WALL - 1)),  # seen from behind the wall
        lambda points: np.add(points * [0.5, 0.5, -1], (0, 0, 1.5 * WALL)),  # in view, but the wall hides the balls
        lambda points: points - points.mean(axis=0),
        lambda points: np.add(points, (0, 0, 3)),  # too far away for its depth
        lambda points: np.add(points, (3, 0, 0)),
        lambda points: points[:, [2, 0, 1]],  # its axis is not z
        lambda points: np.add(points, (4e5, 5e6, 0)),
    ],
)
def test_the_same_picture_was_not_taken_from_elsewhere(depth_picture, moved):
    assert not taken_from_origin(moved(depth_picture))


def test_surfaces_that_hide_nothing_tell_nothing():
    rng = np.random.default_rng(1)
    plane = np.column_stack([rng.uniform(-0.5, 0.5, (4000, 2)), np.full(4000, 1.0)])
    assert not taken_from_origin(plane)
    upright = plane * [1, 1, 0] + [0, 0, 1] * rng.uniform(1, 2, (4000, 1))
    upright[:, 1] = upright[:, 0]  # a plane through the origin: nothing of it can be seen from there
    assert not taken_from_origin(upright)


def test_a_terrain_was_not_taken_from_below():
    """Its heights over the sea are too much alike; what crowns hide would not tell it from a depth picture."""
    rng = np.random.default_rng(2)
    trees = rng.uniform(-4, 4, (12, 2))
    ground = np.column_stack([rng.uniform(-5, 5, (8000, 2)), np.zeros(8000)])
    ground = ground[np.linalg.norm(ground[:, None, :2] - trees, axis=2).min(axis=1) > 0.8]
    crowns = rng.normal(size=(3000, 3))
    crowns /= np.linalg.norm(crowns, axis=1, keepdims=True)
    crowns = crowns[crowns[:, 2] > -0.3]
    crowns[:, :2] += trees[rng.integers(12, size=len(crowns))]
    crowns[:, 2] += 2
    points = np.concatenate([ground, crowns])
    points += rng.normal(scale=0.02, size=points.shape)
    assert not taken_from_origin(np.add(points, (0, 0, 10)))
