from __future__ import annotations

import numpy as np
import pytest

from jetnormal.geometry.metrics import angles, auc, oriented_accuracy, pgp, rmse


def turned(degrees):
    """x turned about z by each angle."""
    radians = np.radians(np.asarray(degrees, dtype=np.float64))
    return np.stack([np.cos(radians), np.sin(radians), np.zeros_like(radians)], axis=1)


def x_axis(n):
    return np.tile([1.0, 0.0, 0.0], (n, 1))


def test_angles_are_those_of_the_turn():
    turns = np.array([0, 1e-10, 1e-3, 30, 89, 90, 91, 150, 180])
    np.testing.assert_allclose(angles(turned(turns), x_axis(9), oriented=True), turns, rtol=1e-12, atol=1e-14)
    unoriented = np.minimum(turns, 180 - turns)
    np.testing.assert_allclose(angles(turned(turns), x_axis(9)), unoriented, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("length", [1e-300, 0.5, 1e300])
def test_lengths_do_not_matter(length):
    np.testing.assert_allclose(angles(length * turned([40]), 3 * x_axis(1)), [40], rtol=1e-12)


@pytest.mark.parametrize("refused", [np.nan, np.inf, 0.0])
def test_a_refused_point_counts_as_the_worst(refused):
    estimate = np.full((1, 3), refused)
    assert angles(estimate, x_axis(1)) == [90]
    assert angles(estimate, x_axis(1), oriented=True) == [180]
    assert oriented_accuracy(estimate, x_axis(1)) == (0, 0)


def test_rmse_pgp_and_auc_have_their_closed_forms():
    errors = np.array([0.0, 3.0, 4.0, 50.0])
    assert rmse(errors[1:3]) == pytest.approx(np.sqrt(12.5))
    assert pgp(errors, 4.0) == 0.5
    assert auc(errors, 10.0) == pytest.approx((1 + 0.7 + 0.6 + 0) / 4)
    uniform = (np.arange(1000) + 0.5) * 0.09
    thresholds = np.linspace(0, 90, 2001)
    assert auc(uniform, 90.0) == pytest.approx(np.mean([pgp(uniform, t) for t in thresholds]), abs=1e-3)


def test_oriented_accuracy_before_and_after_a_global_flip():
    estimated = turned([10, 120, 179, 200])
    assert oriented_accuracy(estimated, x_axis(4)) == (0.25, 0.75)
    assert oriented_accuracy(-estimated, x_axis(4)) == (0.75, 0.75)


def test_no_points_give_nan():
    none = np.empty((0, 3))
    shares = [rmse(np.empty(0)), pgp(np.empty(0), 5), auc(np.empty(0), 90), *oriented_accuracy(none, none)]
    assert np.isnan(shares).all()


def test_unusable_arguments_are_refused():
    with pytest.raises(ValueError, match="compared"):
        angles(x_axis(2), x_axis(3))
    with pytest.raises(ValueError, match="shape"):
        angles(np.ones(3), np.ones(3))
    with pytest.raises(ValueError, match="true normal"):
        angles(x_axis(1), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="positive"):
        auc(np.zeros(3), 0)
