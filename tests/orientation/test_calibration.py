from __future__ import annotations

import numpy as np
import pytest
import shapes

from jetnormal.orientation.calibration import probability
from jetnormal.orientation.methods import choose_signs


@pytest.mark.parametrize("kind", ["outward", "view", "lean", "terrain", "mst", "sight"])
def test_who_is_surer_is_more_often_right(kind):
    values = probability(np.linspace(0, 1, 101), kind)
    assert (np.diff(values) >= 0).all() and values[0] >= 0.5 and values[-1] <= 1


def test_nothing_tells_whether_a_guess_is_right():
    assert (probability(np.linspace(0, 1, 5), "guess") == 0.5).all()


def test_a_closed_surface_is_sure_and_an_open_one_that_nothing_tells_of_is_a_guess():
    points = shapes.sphere(3000)
    assert choose_signs(points, points).confidence.mean() > 0.95
    upper = points[points[:, 2] > 0]
    flat = choose_signs(upper, upper)
    assert flat.open.all() and (flat.confidence == 0.5).all()
