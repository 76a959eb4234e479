from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal.geometry.balls import BallIndex


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(400, 3)) * [3, 2, 0.2] + [100, 0, 0]


def test_balls_hold_what_lies_inside_and_the_query_first(points: np.ndarray):
    index = BallIndex(points)
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    balls = index.balls(np.array([7, 30]), (0.05, 0.1), 400)
    distances = np.linalg.norm(points - points[7], axis=1)
    for scale, radius in enumerate((0.05, 0.1)):
        count = int(balls.counts[0, scale])
        assert count == (distances <= radius * diagonal).sum()
        found = balls.points[0, scale]
        assert (found[0] == 0).all() and (found[count:] == 0).all()
        inside = np.sort(distances[distances <= radius * diagonal]) / (radius * diagonal)
        np.testing.assert_allclose(np.sort(found[:count].norm(dim=1).numpy()), inside, atol=1e-6)
    assert torch.equal(balls.frame, torch.eye(3).expand(2, 3, 3))


def test_a_full_ball_draws_the_same_points_each_time(points: np.ndarray):
    index = BallIndex(points)
    one, two = (index.balls(np.array([5]), (0.2,), 20) for _ in range(2))
    assert int(one.counts[0, 0]) == 20
    assert len(torch.unique(one.points[0, 0], dim=0)) == 20
    assert torch.equal(one.points, two.points)


def test_principal_axes_turn_with_the_cloud(points: np.ndarray):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    query = np.array([11])
    before = BallIndex(points).balls(query, (0.2,), 400, principal_axes=True)
    around = points - points[11]
    ball = around[np.linalg.norm(around, axis=1) <= 0.2 * BallIndex(points).diagonal]
    normal = np.linalg.svd(ball - ball.mean(axis=0))[2][2]
    assert abs(normal @ before.frame[0, :, 2].numpy()) == pytest.approx(1, abs=1e-5)
    assert before.frame[0].det().item() == pytest.approx(1, abs=1e-5)
    assert bool(before.spans_plane)
    turned = BallIndex(points @ turn.T)
    radius = 0.2 * BallIndex(points).diagonal / turned.diagonal
    after = turned.balls(query, (radius,), 400, principal_axes=True)
    torch.testing.assert_close(after.points, before.points, atol=1e-5, rtol=0)


def test_lines_and_lonely_points_span_no_plane():
    line = np.column_stack([np.linspace(0, 1, 50), np.zeros((50, 2))])
    assert not BallIndex(line).balls(np.array([0, 20]), (0.3,), 30).spans_plane.any()
    assert not BallIndex(np.eye(3)).balls(np.array([0]), (0.1,), 30).spans_plane.any()
