"""Relief: the normals are those of the moved surface."""

import numpy as np
import pytest
from shapes import normals_by_differences, plane

from jetnormal.data.dataset import WithRelief
from jetnormal.data.relief import STEEPEST, add_relief
from jetnormal.data.sources import SyntheticSolids


@pytest.mark.parametrize("seed", range(4))
def test_normals_are_those_of_the_moved_surface(seed: int):
    points, normals = plane(150)
    moved, tilted = add_relief(points, normals, np.random.default_rng(seed))
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1)
    np.testing.assert_array_equal(moved[:, :2], points[:, :2])  # along the normals alone
    # a moved plane is under the same field
    expected = normals_by_differences(lambda at: add_relief(at, normals, np.random.default_rng(seed))[0], points)
    np.testing.assert_allclose(tilted, expected, atol=1e-3)
    assert np.degrees(np.arccos(tilted[:, 2])).max() > 2


def test_the_slope_is_bounded_and_equal_seeds_give_equal_reliefs():
    points, normals = plane(100)
    for seed in range(8):
        _, tilted = add_relief(points, normals, np.random.default_rng(seed))
        slope = np.linalg.norm(tilted[:, :2], axis=1) / tilted[:, 2]
        assert np.sqrt(np.mean(slope**2)) < 1.5 * STEEPEST
    again = [add_relief(points, normals, np.random.default_rng(3))[1] for _ in range(2)]
    np.testing.assert_array_equal(*again)


def test_with_noise_there_are_long_waves_only():
    """The slope changes little from a point to its neighbors where these lie beside it by noise alone."""
    points, normals = plane(100)
    rng = np.random.default_rng(0)
    for seed in range(5):
        rough = points + [0, 0, 0.02] * rng.normal(size=points.shape)
        lifted = rough + np.array([0, 0, 0.02])
        first, second = (add_relief(cloud, normals, np.random.default_rng(seed))[1] for cloud in (rough, lifted))
        angle = np.degrees(np.arccos(np.clip((first * second).sum(axis=1), -1, 1)))
        tilt = np.degrees(np.arccos(first[:, 2]))
        assert np.sqrt(np.mean(angle**2)) < 0.6 * np.sqrt(np.mean(tilt**2))


def test_a_source_with_relief_leaves_noisy_clouds_alone():
    plain = SyntheticSolids(clouds_per_epoch=12, points=300)
    source = WithRelief(plain, 1.0)
    assert source.clouds_per_epoch == 12
    for index in range(12):
        before, after = plain.cloud(0, index, 1), source.cloud(0, index, 1)
        changed = not np.array_equal(before.points, after.points)
        assert changed == (not before.name.endswith(("_medium", "_high")))
        np.testing.assert_array_equal(after.points, source.cloud(0, index, 1).points)
