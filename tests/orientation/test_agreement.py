"""Edges tell whether neighbors agree; what surely agrees forms regions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix

from jetnormal.orientation.agreement import REGION_POINTS, Surface, couplings, regions, relax, revote


def scrambled(normals, seed=0):
    return normals * np.random.default_rng(seed).choice([-1.0, 1.0], (len(normals), 1))


def cylinder(rng, count=4000):
    angle = rng.uniform(0, 2 * np.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return normals + rng.uniform(0, 4, (count, 1)) * [0, 0, 1], normals


def plate(rng, thickness, count=4000):
    side = rng.choice([-1.0, 1.0], count)
    points = np.column_stack([rng.uniform(0, 1, (count, 2)), side * thickness / 2])
    return points, np.column_stack([np.zeros((count, 2)), side])


def test_edges_are_exact_on_a_circle_and_across_a_right_angle():
    points, normals = cylinder(np.random.default_rng(0))
    assert (Surface(points, normals).edges > 0.9).mean() > 0.99
    corner = np.array([[0.0, 0, 1], [1, 0, 0]])  # the floor and the wall of a step, which look up and forward
    both = Surface(np.array([[-1.0, 0, 0], [0, 0, -1.0]]), corner)
    np.testing.assert_allclose(both.edges, 1, atol=1e-12)


def test_the_sides_of_a_thin_plate_disagree_with_one_direction_for_both():
    points, normals = plate(np.random.default_rng(1), 0.02)
    surface = Surface(points, np.abs(normals))
    across = points[:, None, 2] * points[surface.neighbors, 2] < 0
    lengths = np.linalg.norm(points[surface.neighbors] - points[:, None], axis=2)
    steep = across & (lengths < 0.022)  # more than 65 degrees
    assert steep.any() and (surface.edges[steep] < 0).mean() > 0.95 and (surface.edges[~across] > 0.99).all()


def test_noise_turns_the_mirror_test_into_a_comparison_of_directions():
    rng = np.random.default_rng(2)
    points, normals = cylinder(rng)
    noisy = Surface(points + rng.normal(scale=0.1, size=points.shape), normals)
    assert (noisy.edges > 0).mean() > 0.99


def test_regions_are_consistent_and_of_bounded_size():
    points, normals = plate(np.random.default_rng(3), 0.05)
    surface = Surface(points, scrambled(normals))
    flips, region = regions(surface)
    surface.turn(flips)
    sign = np.sign((surface.normals * normals).sum(axis=1))
    size = np.bincount(region)
    np.testing.assert_array_equal(np.abs(np.bincount(region, sign)), size)
    assert size.max() <= REGION_POINTS and len(size) < 80


def test_couplings_join_what_touches_and_know_which_sides_agree():
    points, normals = plate(np.random.default_rng(4), 0.05)
    surface = Surface(points, scrambled(normals))
    flips, region = regions(surface)
    coupling = couplings(surface, region, flips)
    surface.turn(flips)
    sign = np.sign(np.bincount(region, (surface.normals * normals).sum(axis=1)))
    agreed = coupling.tocoo()
    assert agreed.nnz and (agreed.data * sign[agreed.row] * sign[agreed.col] > 0).all()
    assert abs(coupling - coupling.T).max() < 1e-12


def test_a_stray_point_joins_nothing():
    points, normals = cylinder(np.random.default_rng(5))
    surface = Surface(np.append(points, [[1e3, 0, 0]], axis=0), np.append(normals, [[1.0, 0, 0]], axis=0))
    assert (surface.edges[-1] == 0).all() and (surface.edges[:-1] != 0).all()


@pytest.mark.parametrize("votes", [[1.0, 0, 0, 0], [0, 0, 0, -3.0]])
def test_one_vote_settles_all_that_is_coupled(votes):
    coupling = coo_matrix(([1.0, -2.0, 1.0], ([0, 1, 2], [1, 2, 3])), (4, 4)).tocsr()
    x = relax(coupling + coupling.T, np.array(votes))
    np.testing.assert_allclose(x, np.sign([1, 1, -1, -1]), atol=1e-5)


def test_contradictions_come_near_zero():
    coupling = coo_matrix(([1.0, 1.0, -1.0], ([0, 1, 2], [1, 2, 0])), (3, 3)).tocsr()
    x = relax(coupling + coupling.T, np.array([0.01, 0, 0]))
    assert (np.abs(x) < 0.1).all()


def test_neighbors_outvote_single_wrong_points():
    points, normals = cylinder(np.random.default_rng(6))
    surface = Surface(points, normals.copy())
    flips = np.random.default_rng(7).uniform(size=len(points)) < 0.02
    surface.turn(flips)
    sure = revote(surface)
    np.testing.assert_array_equal(surface.normals, normals)
    assert sure.min() > 0.9
