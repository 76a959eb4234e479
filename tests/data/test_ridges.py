"""Ridges: the normals are those of the moved surface."""

import numpy as np
import pytest
from shapes import normals_by_differences, plane

from jetnormal.data import ridges
from jetnormal.data.corruption import scan
from jetnormal.data.ridges import STEEPEST, add_ridges


@pytest.mark.parametrize("seed", range(6))
def test_normals_are_those_of_the_moved_surface(seed: int):
    points, normals = plane(100)
    moved, tilted = add_ridges(points, normals, np.random.default_rng(seed))
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1)
    np.testing.assert_array_equal(moved[:, :2], points[:, :2])  # along the normals alone
    # a moved plane is under the same field
    expected = normals_by_differences(lambda at: add_ridges(at, normals, np.random.default_rng(seed))[0], points)
    apart = np.degrees(np.arccos(np.clip((tilted * expected).sum(axis=1), -1, 1)))
    assert np.quantile(apart, 0.99) < 0.1  # an edge of the part with ridges may have moved past a point


def test_ridges_are_steep_and_lie_on_a_part():
    points, normals = plane(100)
    shares, steepest = [], []
    for seed in range(30):
        moved, tilted = add_ridges(points, normals, np.random.default_rng(seed))
        shares.append(np.mean(moved[:, 2] != 0))
        steepest.append(np.degrees(np.arccos(tilted[:, 2])).max())
    assert max(steepest) <= STEEPEST + 1e-6
    assert np.mean(np.array(steepest) > 20) > 0.5  # a wave that faces the plane leaves it flat
    assert min(shares) < 0.5 < max(shares)


def test_what_faces_the_axis_has_none(monkeypatch):
    monkeypatch.setattr(ridges, "REACH", (3.0, 3.0))
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for seed in range(10):
        moved, _ = add_ridges(points, points, np.random.default_rng(seed))
        changed = points[(moved != points).any(axis=1)]
        axis = np.linalg.eigh(changed.T @ changed)[1][:, 0]  # the ridged points are a belt around it
        assert 0.55 < np.abs(changed @ axis).max() < 0.65


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_points_stay_finite(count: int):
    for seed in range(20):
        points, normals = np.random.default_rng(seed).random((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1))
        assert np.isfinite(add_ridges(points, normals, np.random.default_rng(seed))).all()


def test_some_clouds_of_a_training_have_ridges():
    class Plane:
        def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
            points = np.column_stack([rng.random((count, 2)), np.zeros(count)])
            return points, np.tile([0.0, 0.0, 1.0], (count, 1))

    tilted = [np.any(scan(Plane(), 500, np.random.default_rng(seed))[1][:, 2] < 0.99) for seed in range(100)]
    assert 3 <= sum(tilted) <= 20
