from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from jetnormal.data import corruption
from jetnormal.data.corruption import (
    CORRUPTION_SHARES,
    NOISE_LEVELS,
    VARIED_NOISE,
    add_noise,
    punch_holes,
    scan,
    thin,
)
from jetnormal.data.solids.primitives import RoundedBox


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([0, 0, 5], [3, 4, 17], (40_000, 3))  # diagonal 13


def test_levels_are_those_of_pcpnet():
    assert NOISE_LEVELS == {"low": 0.00125, "medium": 0.006, "high": 0.012}
    assert sum(CORRUPTION_SHARES.values()) == pytest.approx(1)


@pytest.mark.parametrize("kind", ["gaussian", "uniform"])
def test_noise_has_the_given_deviation_relative_to_the_diagonal(points, kind):
    before = points.copy()
    moved = add_noise(points, 0.012, np.random.default_rng(1), kind) - points
    np.testing.assert_array_equal(points, before)
    sigma = 0.012 * 13
    np.testing.assert_allclose(moved.std(axis=0), sigma, rtol=0.02)
    np.testing.assert_allclose(moved.mean(axis=0), 0, atol=0.02 * sigma)
    beyond = (np.abs(moved) > np.sqrt(3) * sigma).mean()  # 8.3 % of a Gaussian, nothing of a uniform distribution
    assert beyond == pytest.approx(0.0833 if kind == "gaussian" else 0.0, abs=0.005)


def pattern(points, keep, bins):
    """Shares of the kept points along the axis on which they are least even."""
    counts = []
    for axis in range(3):
        low, high = points[:, axis].min(), points[:, axis].max()
        counts.append(np.histogram(points[keep, axis], bins=bins, range=(low, high))[0])
    return counts[int(np.argmax(np.std(counts, axis=1)))] / len(keep)


def test_gradient_density_falls_along_an_axis(points):
    keep = thin(points, "gradient", 4_000, np.random.default_rng(3))
    assert len(np.unique(keep)) == 4_000
    share = pattern(points, keep, 4)
    assert (np.diff(share) < 0).all()
    # Nearly (1 - 0.99 t) for a tenth of the points.
    np.testing.assert_allclose(share, np.array([0.876, 0.629, 0.381, 0.134]) / 2.02, atol=0.03)


def test_stripes_alternate(points):
    keep = thin(points, "striped", 4_000, np.random.default_rng(3))
    share = pattern(points, keep, 10)
    assert (share[::2] > 8 * share[1::2]).all()


def test_thinning_to_all_points_keeps_all(points):
    for kind in ("gradient", "striped"):
        np.testing.assert_array_equal(thin(points[:50], kind, 50, np.random.default_rng(0)), np.arange(50))


def test_holes_are_empty_balls():
    points = np.random.default_rng(0).uniform(size=(20_000, 3)) * [1, 1, 0]
    for seed in range(10):
        kept = punch_holes(points, np.random.default_rng(seed))
        assert len(points) // 2 <= len(kept) < len(points)
        gone = np.setdiff1d(np.arange(len(points)), kept)
        # A removed disc of at least 3 % of the diagonal: some removed point has no kept one within 2 %.
        gap = min_distance(points[gone], points[kept])
        assert gap.max() > 0.02 * np.sqrt(2)


def min_distance(queries, points):
    from scipy.spatial import cKDTree

    return cKDTree(points).query(queries)[0]


def test_small_cloud_is_not_cut_in_more_than_half():
    points = np.random.default_rng(0).normal(size=(20, 3)) * 1e-3
    points[0] = 1.0  # all others lie in one ball
    for seed in range(20):
        assert len(punch_holes(points, np.random.default_rng(seed))) >= 10


def test_scan_keeps_the_clean_normals_and_draws_each_kind_by_its_share(monkeypatch):
    monkeypatch.setattr(corruption, "RIDGES_SHARE", 0)
    sphere = RoundedBox([0, 0, 0], 1.0)
    kinds: Counter[str] = Counter()
    for seed in range(600):
        points, normals, kind = scan(sphere, 400, np.random.default_rng(seed))
        kinds[kind] += 1
        assert len(points) == len(normals)
        assert 100 <= len(points) <= 400
        error = np.sqrt(((points - normals) ** 2).mean())  # the clean point of a unit sphere is its normal
        least, most = VARIED_NOISE if kind == "varied" else (NOISE_LEVELS.get(kind, 0.0),) * 2
        assert 0.6 * least * np.sqrt(12) <= error <= 1.5 * most * np.sqrt(12) + 1e-12
    for kind, share in CORRUPTION_SHARES.items():
        assert kinds[kind] / 600 == pytest.approx(share, abs=0.06)
