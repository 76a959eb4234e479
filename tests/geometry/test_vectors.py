"""Directions."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal.geometry.vectors import fibonacci_sphere, unit


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 5, 3)])
def test_unit_vectors_keep_their_direction(shape):
    vectors = np.random.default_rng(0).normal(size=shape) * 7
    found = unit(vectors)
    assert np.allclose(np.linalg.norm(found, axis=-1), 1)
    assert np.allclose(np.cross(found, vectors), 0) and ((found * vectors).sum(axis=-1) > 0).all()


def test_what_has_no_direction_becomes_something_else():
    vectors = np.array([[0.0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [0, 0, 2]])
    assert unit(vectors).tolist() == [[0, 0, 0]] * 3 + [[0, 0, 1]]
    assert unit(vectors, [1.0, 0, 0]).tolist() == [[1, 0, 0]] * 3 + [[0, 0, 1]]


def test_the_sphere_is_covered_evenly():
    points = fibonacci_sphere(2000)
    assert np.allclose(np.linalg.norm(points, axis=1), 1) and np.abs(points.mean(axis=0)).max() < 1e-3
    nearest = np.sort(np.linalg.norm(points[::40, None] - points, axis=2), axis=1)[:, 1]
    assert nearest.max() < 2 * nearest.min()
