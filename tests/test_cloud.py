from __future__ import annotations

import numpy as np
import pytest

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError


def test_points_become_contiguous_float64():
    cloud = Cloud(np.arange(12, dtype=np.float32).reshape(3, 4).T[:, :3])
    assert cloud.points.dtype == np.float64
    assert cloud.points.flags.c_contiguous
    assert len(cloud) == 4


def test_valid_marks_rows_with_nan_or_infinity():
    cloud = Cloud(np.array([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [1, 2, 3]]))
    assert cloud.valid.tolist() == [True, False, False, True]


def test_two_clouds_share_no_attributes():
    first, second = Cloud(np.zeros((1, 3))), Cloud(np.zeros((1, 3)))
    first.attributes["label"] = np.zeros(1)
    assert second.attributes == {}
    assert second.source == Source()


@pytest.mark.parametrize(
    "arguments",
    [
        {"points": np.zeros((4, 2))},
        {"points": np.zeros(3)},
        {"points": np.zeros((4, 3)), "normals": np.zeros((3, 3))},
        {"points": np.zeros((4, 3)), "normals": np.zeros((4, 2))},
        {"points": np.zeros((4, 3)), "attributes": {"label": np.zeros(5)}},
        {"points": np.zeros((4, 3)), "attributes": {"label": np.float64(1)}},
    ],
)
def test_arrays_without_one_row_per_point_are_refused(arguments):
    with pytest.raises(ValueError, match=r"point|normals|shape"):
        Cloud(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"points": np.zeros((4, 3), complex)},
        {"points": np.full((4, 3), "a")},
        {"points": np.full((4, 3), object())},
        {"points": np.zeros((4, 3)), "attributes": {7: np.zeros(4)}},
        {"points": np.zeros((4, 3)), "attributes": {"\ud800": np.zeros(4)}},
        {"points": np.zeros((4, 3)), "attributes": {"ragged": [[1], [1, 2], [], []]}},
    ],
)
def test_what_no_file_can_hold_is_refused(arguments):
    with pytest.raises(InputError, match=r"numbers|text|array"):
        Cloud(**arguments)


def test_masked_values_are_nan():
    hidden = np.array([[0, 0, 0], [0, 1, 0]])
    points = np.ma.masked_array(np.arange(6).reshape(2, 3), hidden)
    cloud = Cloud(points, attributes={"time": np.ma.masked_array([1, 2], [1, 0]), "label": [3, 4]})
    np.testing.assert_array_equal(cloud.points, [[0, 1, 2], [3, np.nan, 5]])
    np.testing.assert_array_equal(cloud.attributes["time"], [np.nan, 2])
    assert cloud.attributes["label"].dtype == np.int64
