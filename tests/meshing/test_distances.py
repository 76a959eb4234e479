from __future__ import annotations

import numpy as np
import pytest

from jetnormal.meshing.distances import surface_distance

GRID = np.stack(np.meshgrid(np.arange(50.0), np.arange(50.0), [0.0]), -1).reshape(-1, 3)
UP = np.tile([0.0, 0.0, 1.0], (len(GRID), 1))


def test_a_shifted_plane_is_its_shift_squared_away_each_way():
    distance = surface_distance((GRID, UP), (np.add(GRID, [0, 0, 0.3]), UP))
    assert distance.chamfer == pytest.approx(2 * 0.09)
    assert distance.normal_consistency == pytest.approx(1)


def test_a_missing_half_counts_one_way():
    half = GRID[:, 0] < 25
    whole_to_half = np.mean(np.maximum(GRID[:, 0] - 24, 0) ** 2)
    assert surface_distance((GRID, UP), (GRID[half], UP[half])).chamfer == pytest.approx(whole_to_half)


def test_normals_are_compared_without_signs():
    tilted = np.tile([np.sin(0.5), 0, -np.cos(0.5)], (len(GRID), 1))
    assert surface_distance((GRID, UP), (GRID, tilted)).normal_consistency == pytest.approx(np.cos(0.5))


def test_samples_of_one_plane_are_two_over_pi_times_the_area_per_sample_away():
    rng = np.random.default_rng(0)
    first, second = (np.c_[rng.random((20_000, 2)), np.zeros(20_000)] for _ in range(2))
    up = np.tile([0.0, 0.0, 1.0], (20_000, 1))
    assert surface_distance((first, up), (second, up)).chamfer == pytest.approx(2 / np.pi / 20_000, rel=0.05)
