from __future__ import annotations

import numpy as np
import pytest

from jetnormal.geometry.scale import unit_scale

CLOUD = np.random.default_rng(0).uniform(-1, 1, (500, 3))


@pytest.mark.parametrize("size", [1e-307, 1e-100, 1e-45, 0.3, 1, 7e5, 1e39, 1e150])
def test_a_cloud_of_any_size_becomes_one_and_loses_no_bit(size):
    points = CLOUD * size
    scaled, exponent = unit_scale(points)
    assert 0.5 <= np.median(np.abs(scaled - np.median(scaled, axis=0)), axis=0).max() < 2
    assert np.array_equal(np.ldexp(scaled, -exponent), points)


def test_an_outlier_decides_on_nothing():
    points = np.concatenate([CLOUD, [[1e140, 0, 0]]])
    scaled, exponent = unit_scale(points)
    assert exponent == unit_scale(CLOUD)[1]
    assert np.array_equal(scaled[:-1], np.ldexp(CLOUD, exponent))
    assert 1e20 < scaled[-1, 0] < 1e32


def test_the_origin_stays_and_half_a_cloud_in_one_place_has_a_size():
    points = np.concatenate([np.tile([5.0, 0, 0], (20, 1)), [[7.0, 0, 0]]])
    scaled, exponent = unit_scale(points)
    assert np.array_equal(scaled, np.ldexp(points, exponent))
    assert np.array_equal(unit_scale(points[:3])[0], points[:3])
