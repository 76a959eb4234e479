from __future__ import annotations

import numpy as np
import pytest

from jetnormal.geometry.parts import far_apart

BALL = np.random.default_rng(0).normal(size=(200, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e140])
def test_strays_and_far_objects_are_set_apart(distance):
    strays = distance * np.array([[1, 0, 0], [1.5, 0, 0], [0, -1, 0.0]])
    points = np.concatenate([strays, BALL, BALL * 2 + [0, 0, distance]])
    parts = far_apart(points)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(points)))
    assert [len(part) for part in parts[:2]] == [200, 200]
    assert {part[0] for part in parts[:2]} == {3, 203}
    assert sum(len(part) for part in parts[2:]) == 3


@pytest.mark.parametrize(
    "points",
    [
        BALL,
        np.concatenate([BALL, BALL + np.array([8, 0, 0])]),
        np.concatenate([BALL, [[1.2, 0, 0]]]),  # noise
        BALL * [1, 1e-3, 1e3],
        np.cumsum(np.geomspace(1e-4, 1, 300))[:, None] * [1, 1, 0.5],  # of very uneven density
        np.array([[0, 0, 0], [1, 0, 0], [0, 100, 0.0]]),
    ],
)
def test_what_belongs_together_stays_together(points):
    (part,) = far_apart(points)
    assert np.array_equal(part, np.arange(len(points)))
