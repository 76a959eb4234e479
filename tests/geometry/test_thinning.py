"""Thinned clouds."""

from __future__ import annotations

import numpy as np
from shapes import sphere

from jetnormal.geometry.cells import cut_into_cells
from jetnormal.geometry.thinning import least, ranks


def test_tiles_rank_their_points_as_the_whole_does():
    points = sphere(3000)
    whole = ranks(points, points[:0])
    cell = cut_into_cells(points, 0, 500).of(points)
    for number in range(cell.max() + 1):
        inside = cell == number
        np.testing.assert_allclose(ranks(points[inside], points[~inside]), whole[inside], rtol=1e-9)
    np.testing.assert_allclose(ranks(points / 64, points[:0]), 64 * whole, rtol=1e-9)


def test_dense_parts_lose_more():
    """A square with 16 times the density of another: points are a quarter as far apart, so a quarter of them stay."""
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((16_000, 3)) * [1, 1, 0], rng.random((4_000, 3)) * [2, 2, 0] + [3, 0, 0]
    points = np.concatenate([dense, sparse])
    rows = least(ranks(points, points[:0]), 1500)
    assert len(rows) == 1500 and (np.diff(rows) > 0).all()
    share_dense, share_sparse = (rows < 16_000).sum() / 16_000, (rows >= 16_000).sum() / 4_000
    assert 0.2 < share_dense / share_sparse < 0.3


def test_few_points_all_stay():
    points = sphere(5)
    np.testing.assert_array_equal(least(ranks(points, points[:0]), 5), np.arange(5))
    assert ranks(points[:1], points[:0]).tolist() == [0]
