from __future__ import annotations

import numpy as np
import pytest

from jetnormal.geometry import neighbors
from jetnormal.geometry.neighbors import NeighborIndex, inverse_order, typical_spacing


def brute_force(points, queries, k):
    distances = np.sqrt(((queries[:, None] - points[None]) ** 2).sum(axis=-1))
    indices = np.broadcast_to(np.arange(len(points)), distances.shape)
    order = np.lexsort((indices, distances), axis=1)[:, :k]
    return order, np.take_along_axis(distances, order, axis=1)


@pytest.mark.parametrize("k", [1, 7, 64, 300])
def test_equals_brute_force(k):
    rng = np.random.default_rng(0)
    points, queries = rng.normal(size=(300, 3)), rng.normal(size=(50, 3))
    indices, distances = NeighborIndex(points).query(queries, k)
    expected, expected_distances = brute_force(points, queries, k)
    assert indices.dtype == np.int64
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_allclose(distances, expected_distances, rtol=1e-12)


@pytest.mark.parametrize("k", [2, 9, 20, 60])
def test_ties_on_a_grid_go_to_the_smaller_index(k):
    grid = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)
    grid = np.random.default_rng(1).permutation(grid)
    indices, _ = NeighborIndex(grid).query(grid, k)
    np.testing.assert_array_equal(indices, brute_force(grid, grid, k)[0])


def test_duplicates_come_in_index_order():
    points = np.repeat(np.eye(3), 40, axis=0)
    indices, distances = NeighborIndex(points).query(points[50:51], 10)
    np.testing.assert_array_equal(indices[0], np.arange(40, 50))
    np.testing.assert_array_equal(distances, 0)


def test_of_a_thousand_copies_the_first_are_taken():
    indices, distances = NeighborIndex(np.ones((1000, 3))).query(np.ones((3, 3)), 5)
    np.testing.assert_array_equal(indices, np.tile(np.arange(5), (3, 1)))
    np.testing.assert_array_equal(distances, 0)


def test_large_offsets_change_nothing():
    rng = np.random.default_rng(2)
    points = rng.integers(0, 1 << 16, size=(500, 3)) / 1024  # exact under the offset
    shifted = points + np.array([500_000, 5_000_000, 300])
    indices, distances = NeighborIndex(points).query(points, 30)
    shifted_indices, shifted_distances = NeighborIndex(shifted).query(shifted, 30)
    np.testing.assert_array_equal(indices, shifted_indices)
    np.testing.assert_array_equal(distances, shifted_distances)


def test_threads_do_not_change_the_answer(monkeypatch):
    monkeypatch.setattr(neighbors, "FEW", 100)
    points = np.random.default_rng(3).normal(size=(400, 3))
    whole = NeighborIndex(points, threads=1).query(points, 12)
    pieces = NeighborIndex(points, threads=3).query(points, 12)
    np.testing.assert_array_equal(whole[0], pieces[0])
    np.testing.assert_array_equal(whole[1], pieces[1])


@pytest.mark.parametrize("count", [2, 17, 1000])
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_points_on_a_line_or_plane_and_queries_far_away(count, axes):
    rng = np.random.default_rng(4)
    points = np.zeros((count, 3))
    points[:, :axes] = rng.normal(size=(count, axes))
    queries = np.concatenate([points[:20], 10 * rng.normal(size=(20, 3)), points[:3]])
    k = min(count, 9)
    np.testing.assert_array_equal(NeighborIndex(points).query(queries, k)[0], brute_force(points, queries, k)[0])


def test_no_queries_give_no_rows():
    indices, distances = NeighborIndex(np.eye(3)).query(np.empty((0, 3)), 2)
    assert indices.shape == distances.shape == (0, 2)


@pytest.mark.parametrize("k", [0, -1, 4])
def test_k_out_of_range_is_refused(k):
    with pytest.raises(ValueError, match="k is"):
        NeighborIndex(np.eye(3)).query(np.eye(3), k)


@pytest.mark.parametrize(
    ("points", "message"),
    [(np.zeros((0, 3)), "empty"), (np.zeros((4, 2)), "shape"), (np.full((4, 3), np.nan), "finite")],
)
def test_unusable_points_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        NeighborIndex(points)


def test_a_point_far_away_takes_no_digit_from_the_others():
    points = np.random.default_rng(0).random((300, 3))
    with_outlier = np.concatenate([points, [[1e140, 0, 0]]])
    expected, _ = NeighborIndex(points).query(points, 8)
    found, _ = NeighborIndex(with_outlier).query(points, 8)
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("count", [11, 40])
def test_the_spacing_of_a_grid_is_found(count):
    axis = np.linspace(0, 1, count)
    grid = np.stack([*np.meshgrid(axis, axis), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    assert typical_spacing(grid) == pytest.approx(1 / (count - 1), rel=0.15)


def test_an_order_is_undone():
    order = np.random.default_rng(0).permutation(50)
    np.testing.assert_array_equal(inverse_order(order), np.argsort(order))
