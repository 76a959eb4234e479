"""Normals that a sight line grazes follow the neighbors that are seen clearly."""

from __future__ import annotations

import numpy as np

from jetnormal.orientation.grazing import grazing_flips


def test_clear_neighbors_outvote_a_grazed_normal_and_not_a_clear_one():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(size=(500, 2)), np.zeros(500)])
    normals = np.tile([0.0, 0.0, 1.0], (500, 1))
    cosine = np.full(500, 0.6)
    wrong = np.array([10, 20, 30])
    normals[wrong], cosine[wrong[:2]] = (0, 0, -1), (0.01, 0.1)
    np.testing.assert_array_equal(np.flatnonzero(grazing_flips(points, normals, cosine)), [10, 20])


def test_without_neighbors_the_sight_line_decides():
    points, normals = np.random.default_rng(1).normal(size=(2, 5, 3))
    assert not grazing_flips(points, normals, np.full(5, 0.1)).any()
