"""Principal curvatures from normals, on surfaces whose curvatures are known."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jetnormal.networks.cloudfit.curvature import add_equations, principal


def curvatures(points: np.ndarray, normals: np.ndarray, k: int = 12) -> np.ndarray:
    neighbors = cKDTree(points).query(points, k)[1].astype(np.int32)
    sums = np.zeros((len(points), 6))
    add_equations(points, normals, np.arange(len(points)), points, normals, neighbors, sums)
    return principal(sums)


def test_a_sphere_is_exact_at_any_density_and_whatever_the_signs_of_the_neighbors():
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(600, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    signs = rng.choice([-1.0, 1.0], size=(600, 1))
    found = curvatures(5 * outward, (signs * outward).astype(np.float32))
    np.testing.assert_allclose(found, np.repeat(-signs / 5, 2, axis=1), rtol=1e-3)


def test_a_cylinder_bends_one_way():
    rng = np.random.default_rng(1)
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(0, 6, 4000)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(4000)])
    found = curvatures(normals * 2 + np.column_stack([np.zeros((4000, 2)), height]), normals.astype(np.float32))
    np.testing.assert_allclose(np.median(found, axis=0), [0, -0.5], atol=0.005)


def test_neighbors_beyond_an_edge_do_not_count():
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    floor, wall = np.column_stack([grid, np.zeros(100)]), np.column_stack([grid[:, 0], np.zeros(100), 0.5 + grid[:, 1]])
    normals = np.repeat([[0, 0, 1], [0, 1, 0]], 100, axis=0).astype(np.float32)
    assert np.abs(curvatures(np.concatenate([floor, wall]), normals)).max() < 1e-6


def test_without_neighbors_there_is_no_bend():
    assert principal(np.zeros((2, 6))) == pytest.approx(0)
