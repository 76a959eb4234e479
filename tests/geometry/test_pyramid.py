"""The levels of a cloud: what they keep, and that they turn with the cloud."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jetnormal.geometry.pyramid import NEIGHBORS, PARENTS, SPACING, build_pyramid


def plane(count: int, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.random((count, 2)), noise * rng.normal(size=count)])


def jittered(count: int) -> np.ndarray:
    """About `count` points of a unit square, no two of them close together."""
    side = round(np.sqrt(count))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), [0.0]), axis=-1).reshape(-1, 3)
    return (grid + np.random.default_rng(1).uniform(-0.35, 0.35, grid.shape) * [1, 1, 0]) / side


def lines(apart: float) -> np.ndarray:
    """Scan lines of a plane, `apart` times as far apart as their samples."""
    x, y = np.meshgrid(np.arange(600.0), apart * np.arange(12.0))
    rng = np.random.default_rng(0)
    return np.column_stack([x.ravel() + rng.uniform(-0.2, 0.2, x.size), y.ravel(), 0.01 * rng.normal(size=x.size)])


def test_levels_thin_to_about_a_quarter():
    sizes = [len(level.positions) for level in build_pyramid(jittered(3969), 4).levels]
    ratios = np.array(sizes[:-1]) / sizes[1:]
    assert sizes[0] == 3969
    assert ((ratios > 3) & (ratios < 6)).all()


def test_kept_points_are_spread_out_and_every_point_has_a_parent_nearby():
    fine, coarse = build_pyramid(jittered(2000), 2).levels
    kept = np.zeros(len(fine.positions), dtype=bool)
    kept[fine.chosen] = True
    near = fine.neighbors[:, :SPACING]
    assert (kept | kept[near].any(axis=1)).all()
    candidates = np.concatenate([np.arange(len(fine.positions))[:, None], fine.neighbors], axis=1)
    assert fine.parents.shape == (len(fine.positions), PARENTS)
    assert all(set(fine.chosen[row]) <= set(own) for row, own in zip(fine.parents, candidates, strict=True))
    assert len(coarse.positions) == len(fine.chosen)
    assert len(coarse.chosen) == 0


def test_averaged_positions_have_less_noise():
    levels = build_pyramid(plane(4000, noise=0.02), 3).levels
    spread = [level.positions[:, 2].std() for level in levels]
    assert spread[2] < spread[1] < 0.9 * spread[0]


def test_normals_variances_and_scale_of_a_plane():
    level = build_pyramid(jittered(500), 1).levels[0]
    np.testing.assert_allclose(np.abs(level.normals[:, 2]), 1, atol=1e-6)
    np.testing.assert_allclose(level.variance.sum(axis=1), 1, atol=1e-6)
    assert level.variance[:, 0].max() < 1e-12
    distances = np.linalg.norm(level.positions[level.neighbors] - level.positions[:, None], axis=2)
    np.testing.assert_allclose(level.scale, np.sqrt((distances**2).mean(axis=1)), rtol=1e-6)
    assert np.linalg.norm(level.centroid, axis=1).max() <= 1


@pytest.mark.parametrize("points", [plane(1500, noise=0.01), lines(10)], ids=["even", "lines"])
def test_a_turned_moved_scaled_and_permuted_cloud_has_the_same_pyramid(points: np.ndarray):
    turn = Rotation.from_euler("xyz", [0.3, -1.2, 2.0]).as_matrix()
    order = np.random.default_rng(2).permutation(len(points))
    moved = (points @ turn.T * 7 + [100, -20, 5])[order]
    pyramid, another = build_pyramid(points, 4), build_pyramid(moved, 4)
    assert set(order[another.kept]) == set(pyramid.kept)
    place = np.searchsorted(pyramid.kept, order[another.kept])
    for level, other in zip(pyramid.levels, another.levels, strict=True):
        np.testing.assert_allclose(other.positions, level.positions[place] @ turn.T * 7 + [100, -20, 5], atol=1e-9)
        np.testing.assert_allclose(other.scale, 7 * level.scale[place], rtol=1e-5)
        aligned = (other.normals * (level.normals[place] @ turn.T)).sum(axis=1)
        np.testing.assert_allclose(np.abs(aligned), 1, atol=1e-5)
        number = np.full(len(level.positions), -1)  # where in the other's next level a point went
        number[level.chosen] = np.arange(len(level.chosen))
        place = number[place[other.chosen]]
        assert (place >= 0).all()


def test_lines_are_thinned_until_neighbors_span_the_surface():
    points = lines(10)
    pyramid = build_pyramid(points, 1)
    finest = pyramid.levels[0]
    assert len(points) / 8 < len(finest.positions) < len(points) / 3
    inside = np.ptp(points, axis=0)[:2] * 0.2
    middle = (np.abs(finest.positions[:, :2] - points[:, :2].mean(axis=0)) < inside).all(axis=1)
    assert (finest.variance[middle, 1] > 0.1 * finest.variance[middle, 2]).all()
    assert np.abs(finest.normals[middle, 2]).min() > 0.999
    assert len(np.intersect1d(pyramid.kept, pyramid.left_out)) == 0
    assert len(pyramid.kept) + len(pyramid.left_out) == len(points)


@pytest.mark.parametrize("shift", [1e-9, 1e-7, 1e-5])
def test_near_duplicates_are_one_place(shift: float):
    points = jittered(1600)
    rng = np.random.default_rng(0)
    doubled = np.concatenate([points, points[::2] + shift * rng.normal(size=(800, 3))])
    pyramid = build_pyramid(doubled, 2)
    assert len(pyramid.kept) == len(points)
    nearest = pyramid.kept[pyramid.carried.neighbors[:, 0]]
    assert np.linalg.norm(doubled[pyramid.left_out] - doubled[nearest], axis=1).max() < 10 * shift
    alone = build_pyramid(points, 2)
    places = np.sort(pyramid.levels[0].scale), np.sort(alone.levels[0].scale)
    np.testing.assert_allclose(*places, rtol=1e-2)


def test_neighbors_after_thinning_are_those_of_a_new_search():
    pyramid = build_pyramid(lines(10), 1)
    points = pyramid.levels[0].positions
    _, expected = cKDTree(points).query(points, NEIGHBORS + 1)
    distances = np.linalg.norm(points[pyramid.levels[0].neighbors] - points[:, None], axis=2)
    true = np.linalg.norm(points[expected[:, 1:]] - points[:, None], axis=2)
    np.testing.assert_allclose(distances, true, atol=1e-9)


@pytest.mark.parametrize("count", [2, 3, 5, 17, 40])
def test_small_clouds_have_all_levels(count: int):
    for level in build_pyramid(np.random.default_rng(0).random((count, 3)), 5).levels:
        assert len(level.positions) >= 1
        assert level.neighbors.shape == (len(level.positions), NEIGHBORS)
        assert level.neighbors.max() < len(level.positions)
        for values in (level.scale, level.normals, level.variance, level.centroid):
            assert np.isfinite(values).all()


def test_collinear_points_have_two_vanishing_variances():
    line = np.column_stack([np.linspace(0, 1, 60), np.zeros((60, 2))])
    assert build_pyramid(line, 1).levels[0].variance[:, 1].max() < 1e-12


def test_a_lattice_terminates_and_is_deterministic():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3)
    first, again = build_pyramid(grid, 4).levels, build_pyramid(grid, 4).levels
    assert all((a.chosen == b.chosen).all() for a, b in zip(first, again, strict=True))


def test_points_averaged_twice_still_have_a_scale():
    rng = np.random.default_rng(0)
    for _ in range(50):
        levels = build_pyramid(rng.random((40, 3)), 4).levels
        for fine, coarse in pairwise(levels):
            assert (coarse.scale >= 0.099 * fine.scale[fine.chosen]).all()


def test_normals_and_variances_are_those_of_the_covariance():
    points = np.random.default_rng(5).normal(size=(400, 3)) * [1, 0.5, 0.1]
    level = build_pyramid(points, 1).levels[0]
    for i in range(0, 400, 13):
        patch = points[np.append(level.neighbors[i], i)]
        values, vectors = np.linalg.eigh(np.cov(patch.T, bias=True))
        np.testing.assert_allclose(level.variance[i], values / values.sum(), atol=1e-6)
        assert abs(vectors[:, 0] @ level.normals[i]) == pytest.approx(1, abs=1e-5)


def test_rounding_gives_collinear_points_no_width():
    points = np.random.default_rng(0).random(200)[:, None] * [0.1, 0.7, 0.3] + [5, 6, 7]
    for level in build_pyramid(points, 3).levels:
        assert (level.variance[:, 1] <= 1e-14 * level.variance[:, 2]).all()
