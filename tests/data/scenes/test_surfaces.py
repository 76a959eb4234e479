"""Pieces of surface against what is known of them in closed form."""

import numpy as np
import pytest

from jetnormal.data.scenes.surfaces import (
    Piece,
    box,
    frustum,
    height_field,
    joined,
    lathe,
    leaves,
    rectangle,
    star,
    tube,
    turned,
    wall,
)
from jetnormal.data.solids.starshaped import Superellipsoid


def face_areas(piece: Piece) -> np.ndarray:
    corners = piece.vertices[piece.faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def area(piece: Piece) -> float:
    return float(np.linalg.norm(face_areas(piece), axis=1).sum())


def assert_normals_fit(piece: Piece, degrees: float) -> None:
    """The normals have unit length and are those of the faces, up to the turn within a face."""
    np.testing.assert_allclose(np.linalg.norm(piece.normals, axis=1), 1, atol=1e-12)
    faces = face_areas(piece)
    size = np.linalg.norm(faces, axis=1)
    real = size > 1e-12
    cosine = np.abs(((faces[real] / size[real, None])[:, None] * piece.normals[piece.faces[real]]).sum(2))
    assert cosine.min() > np.cos(np.radians(degrees))


def test_box():
    piece = box([1.0, 2.0, 3.0], [5.0, 0.0, 1.0])
    assert area(piece) == pytest.approx(22)
    np.testing.assert_allclose(piece.vertices.min(0), [4.5, -1, 1])
    np.testing.assert_allclose(piece.vertices.max(0), [5.5, 1, 4])
    assert_normals_fit(piece, 0.01)
    # All normals look outwards.
    assert (((piece.vertices - [5, 0, 2.5]) * piece.normals).sum(1) > 0).all()


def test_cone_has_the_normals_of_a_cone():
    piece = frustum([0, 0, 0], [0, 0, 2.0], 1.0, 0.0)
    assert area(piece) == pytest.approx(np.pi * np.hypot(1, 2) + np.pi, rel=2e-3)
    slanted = np.abs(piece.normals[:, 2]) < 0.9
    np.testing.assert_allclose(piece.normals[slanted, 2], 1 / np.sqrt(5), atol=1e-9)


def test_tube_keeps_its_distance_from_the_middle_line():
    piece = tube([[0, 0, 0], [2, 0, 0], [2, 3, 0]], 0.1, 0.5)
    x, y, z = piece.vertices.T
    along = np.where(
        (x > 1.5) & (y < 0.5), np.abs(np.hypot(x - 1.5, y - 0.5) - 0.5), np.where(y >= 0.5, np.abs(x - 2), np.abs(y))
    )
    assert np.hypot(along, z).max() < 0.1 + 1e-9
    assert_normals_fit(joined([piece]), 12)


def test_smooth_pieces_have_their_own_normals():
    assert_normals_fit(star(Superellipsoid([1.0, 0.8, 0.7])), 8)
    assert_normals_fit(lathe(1.0, lambda z: (0.3 + 0.1 * np.sin(5 * z), 0.5 * np.cos(5 * z))), 4)
    line = np.linspace(0, 1, 50)
    hill = height_field(line, line, lambda x, y: (x * y, y, x))
    np.testing.assert_allclose(hill.normals[0], [0, 0, 1], atol=1e-12)
    assert_normals_fit(hill, 2)


def test_bowl_is_hollow():
    piece = turned([0, 1.0, 1.0, 0.9, 0.9, 0], [0, 0, 1.0, 1.0, 0.1, 0.1])
    inner = np.isclose(np.hypot(piece.vertices[:, 0], piece.vertices[:, 1]), 0.9) & (np.abs(piece.normals[:, 2]) < 0.5)
    assert inner.any() and ((piece.vertices * piece.normals)[inner, :2].sum(1) < 0).all()
    assert_normals_fit(piece, 4)


def test_wall_with_a_window():
    piece = wall(4.0, 3.0, 0.2, [(1.0, 2.0, 1.0, 2.5)])
    sides = 2 * (4 * 3 - 1.5)
    edges = 0.2 * (2 * (4 + 3) + 2 * (1 + 1.5))
    assert area(piece) == pytest.approx(sides + edges)


def test_turned_piece():
    piece = rectangle([0, 0, 0], [2, 0, 0], [0, 1, 0]).placed([5, 0, 1], np.pi / 2)
    np.testing.assert_allclose(piece.vertices.max(0), [5, 2, 1], atol=1e-12)
    np.testing.assert_allclose(piece.normals, np.tile([0, 0, 1.0], (4, 1)), atol=1e-12)


def test_leaves_have_no_normals():
    piece = leaves(10, 0.1, [1, 1, 1], np.random.default_rng(0))
    assert piece.faces.shape == (10, 3) and not piece.normals.any()
