from __future__ import annotations

import numpy as np
import pytest

from jetnormal import Cloud
from jetnormal.formats.colors import normal_colors, point_colors

POINTS = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("values", "dtype", "expected"),
    [
        ([0, 255], np.uint8, [0, 1]),
        ([0, 65535], np.uint16, [0, 1]),
        ([0, 51], np.uint16, [0, 0.2]),
        ([0, 51], np.int32, [0, 0.2]),
        ([0.0, 0.5], np.float32, [0, 0.5]),
        ([0.0, 51.0], np.float32, [0, 0.2]),
        ([np.nan, 1.0], np.float64, [0, 1]),
    ],
)
def test_channels_of_all_types_reach_from_0_to_1(values, dtype, expected):
    attributes = {name: np.array(values, dtype=dtype) for name in ("red", "green", "blue")}
    assert np.allclose(point_colors(Cloud(POINTS, attributes=attributes)), np.array(expected)[:, None])


def test_packed_colors_are_unpacked():
    packed = np.array([0x00FF0000, 0x000000FF], dtype=np.uint32)
    expected = [[1, 0, 0], [0, 0, 1]]
    assert np.allclose(point_colors(Cloud(POINTS, attributes={"rgb": packed.view(np.float32)})), expected)
    assert np.allclose(point_colors(Cloud(POINTS, attributes={"rgba": packed})), expected)


def test_no_colors_are_none():
    assert point_colors(Cloud(POINTS, attributes={"red": np.zeros(2), "green": np.zeros(2)})) is None
    assert point_colors(Cloud(np.zeros((0, 3)))) is None


def test_normals_show_as_the_usual_colors():
    assert np.allclose(normal_colors(np.array([[0, 0, 1.0], [-1, 0, 0]])), [[0.5, 0.5, 1], [0, 0.5, 0.5]])
