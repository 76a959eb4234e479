"""Cells of a k-d tree over a sample."""

from __future__ import annotations

import numpy as np

from jetnormal.geometry.cells import cut_into_cells, in_sample


def uneven_cloud() -> np.ndarray:
    """Densities of 1 to 100,000, and thousands of points on a line of equal coordinates."""
    rng = np.random.default_rng(0)
    sparse, dense = rng.random((2_000, 3)), rng.random((200_000, 3)) * 0.1
    return np.concatenate([sparse, dense, rng.random((5_000, 3)) * [0, 0, 1]])


def test_cells_hold_as_many_points_wherever_they_are():
    points = uneven_cloud()
    cells = cut_into_cells(points[in_sample(points, 3)], 3, 10_000)
    counts = np.bincount(cells.of(points), minlength=len(cells))
    assert counts.min() > 0 and counts.max() < 1.2 * 10_000 and len(cells) < 50


def test_neither_order_nor_unit_change_the_cells():
    points = uneven_cloud()
    order = np.random.default_rng(1).permutation(len(points))
    known = in_sample(points, 3)
    assert abs(known.mean() * 8 - 1) < 0.05
    np.testing.assert_array_equal(in_sample(points[order] * 2.0**-7, 3), known[order])
    cells = cut_into_cells(points[known], 3, 10_000).of(points)
    moved = points[order] * 2.0**-7
    np.testing.assert_array_equal(cut_into_cells(moved[known[order]], 3, 10_000).of(moved), cells[order])


def test_copies_of_one_point_are_one_cell():
    assert len(cut_into_cells(np.ones((1000, 3)), 0, 10)) == 1
