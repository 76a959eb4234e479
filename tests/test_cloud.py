from __future__ import annotations

import numpy as np
import pytest

from jetnormal.cloud import Cloud, Source


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
