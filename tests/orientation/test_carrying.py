"""Signs of a thinned cloud, carried to the whole."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import even_sphere

from jetnormal.geometry import blocks
from jetnormal.orientation.carrying import Thinned, carry_in_blocks, carry_signs


def plate(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Both sides of a plate that is as thick as the points of every tenth are apart, and their outward normals."""
    rng = np.random.default_rng(0)
    up = np.repeat([1.0, -1.0], count // 2)
    points = np.column_stack([rng.random((len(up), 2)), 0.5 * np.sqrt(20 / count) * up])
    return points, np.column_stack([np.zeros((len(up), 2)), up])


def thinned(points: np.ndarray, normals: np.ndarray, step: int) -> Thinned:
    return Thinned(points[::step], normals[::step], np.ones(len(points[::step])))


@pytest.mark.parametrize("shape", ["sphere", "plate"])
def test_signs_are_carried(shape):
    points, true = plate(8000) if shape == "plate" else (even_sphere(8000), even_sphere(8000))
    scrambled = true * np.random.default_rng(1).choice([-1.0, 1.0], (len(true), 1))
    flips, sure = carry_signs(points, scrambled, thinned(points, true, 10))
    carried = np.where(flips[:, None], -scrambled, scrambled)
    right = np.einsum("nd,nd->n", carried, true) > 0
    assert right.mean() > 0.999
    assert ((sure >= 0.5) & (sure <= 1)).all() and sure.mean() > 0.9


def test_a_guess_stays_a_guess():
    """Of two balls, one of which had its signs guessed."""
    ball = even_sphere(2000)
    points, normals = np.concatenate([ball, ball + np.array([5.0, 0, 0])]), np.concatenate([ball, ball])
    known = np.where(points[::10, 0] < 2.5, 0.5, 1.0)
    _, sure = carry_signs(points, normals, Thinned(points[::10], normals[::10], known))
    np.testing.assert_array_equal(sure[:2000], 0.5)
    assert sure[2000:].min() > 0.9


def test_a_cloud_that_is_not_thinned_keeps_its_signs():
    """Even wrong ones: they were decided with everything in view."""
    points = even_sphere(500)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (500, 1))
    flips, _ = carry_signs(points, points, Thinned(points, points * signs, np.ones(500)))
    np.testing.assert_array_equal(flips, signs[:, 0] < 0)


def test_points_without_a_direction_are_left_alone():
    points = even_sphere(500)
    normals = points.copy()
    normals[3] = np.nan
    flips, sure = carry_signs(points, normals, thinned(points, points, 10))
    assert not flips[3] and sure[3] == 0


def test_oriented_points_keep_their_signs():
    """Even wrong ones: whoever settled them saw the whole cloud."""
    points = even_sphere(2000)
    wrong = np.ones((200, 1))
    wrong[::20] = -1
    known = Thinned(points[::10], points[::10] * wrong, np.linspace(0.5, 1, 200))
    flips, sure = carry_signs(points, points, known)
    np.testing.assert_array_equal(flips[::10], wrong[:, 0] < 0)
    np.testing.assert_array_equal(sure[::10], known.sure)
    assert not np.delete(flips, np.s_[::10]).any()


def test_signs_are_the_same_block_by_block(monkeypatch):
    """They are told by what is near."""
    monkeypatch.setattr(blocks, "CORE", 2000)
    points, true = plate(8000)
    true[::2] *= -1
    known = thinned(points, np.sign(points) * [0, 0, 1], 10)
    whole, of_blocks = carry_signs(points, true, known), carry_in_blocks(points, true.astype(np.float32), known)
    np.testing.assert_array_equal(of_blocks[0], whole[0])
    np.testing.assert_allclose(of_blocks[1], whole[1], atol=0.02)
