"""Estimators that look at whole clouds, block by block."""

import numpy as np

from jetnormal.estimators import blocks
from jetnormal.estimators.base import Prediction, scattered
from jetnormal.geometry import blocks as cut


def test_what_is_asked_for_comes_in_its_order_from_the_whole_cloud(monkeypatch):
    """Whoever asks for some points has cut the cloud already; for all of them, it is cut here."""
    monkeypatch.setattr(blocks, "TOGETHER", 1000)
    monkeypatch.setattr(cut, "CORE", 500)
    points, looks = np.random.default_rng(0).random((3000, 3)) * [1, 1, 0], []

    def first_coordinate(block, asked):
        looks.append(len(block))
        x = np.repeat(block[asked, :1], 3, axis=1).astype(np.float32)
        return [Prediction(x, x, x[:, 0], None)]

    queries = np.array([7, 2999, 7, 12])
    some = blocks.in_blocks(points, queries, first_coordinate, reach=5.0)
    assert looks == [3000]
    np.testing.assert_array_equal(some.confidence, points[queries, 0].astype(np.float32))
    every = blocks.in_blocks(points, None, first_coordinate, reach=5.0)
    assert len(looks) > 5 and all(500 < count < 1500 for count in looks[1:])
    np.testing.assert_array_equal(every.confidence, points[:, 0].astype(np.float32))


def test_parts_are_put_where_they_belong():
    values = np.arange(12, dtype=np.float32).reshape(4, 3)
    parts = [(rows, Prediction(values[rows], -values[rows], values[rows, 0], None)) for rows in ([2, 0], [1, 3])]
    whole = scattered(((np.array(rows), part) for rows, part in parts), 4)
    np.testing.assert_array_equal(whole.normals, values)
    np.testing.assert_array_equal(whole.rough, -values)
    np.testing.assert_array_equal(whole.confidence, values[:, 0])
    assert whole.curvatures is None
