"""Winding numbers between regions of surfaces for which Gauss's formula gives them in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import shapes
from scipy.sparse import csr_matrix

from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.geometry.neighbors import spatial_order
from jetnormal.orientation.agreement import LeastSquares, Surface, relax
from jetnormal.orientation.methods import choose_signs
from jetnormal.orientation.winding import settle_by_winding, winding_matrix


def square(count, height):
    """An even grid on a square of side 2, count points along each side."""
    along = (np.arange(count) + 0.5) * 2 / count - 1
    x, y = (axis.ravel() for axis in np.meshgrid(along, along))
    return np.column_stack([x, y, np.full(len(x), height)])


def plate(count, thickness):
    """Two parallel squares, each in four regions by quadrants; its sides are left out."""
    points = np.concatenate([square(count, thickness / 2), square(count, -thickness / 2)])
    points = points[spatial_order(points)]  # as those of a surface are
    normals = np.where(points[:, 2:] > 0, 1.0, -1.0) * [0, 0, 1]
    region = 4 * (points[:, 2] < 0) + 2 * (points[:, 0] > 0) + (points[:, 1] > 0)
    return points, normals, region


def test_a_square_gives_its_solid_angle():
    """A square of half side a seen from height d over its middle: 4 atan(a^2 / (d sqrt(2 a^2 + d^2)))."""
    for height in (0.5, 1.0, 3.0):
        seen = np.tile([0.0, 0.0, -height], (2, 1))
        points = np.concatenate([square(60, 0.0), seen])
        normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        areas = np.append(np.full(3600, 4 / 3600), [0.0, 0.0])
        region = np.append(np.zeros(3600, dtype=np.int64), [1, 1])
        found = winding_matrix(points, normals, np.maximum(areas, 1e-12), region)
        expected = 4 * np.arctan(1 / (height * np.sqrt(2 + height**2))) / (4 * np.pi)
        assert found[1, 0] == pytest.approx(expected, rel=0.02)
        assert found[0, 0] == found[1, 1] == 0


def test_the_winding_number_is_one_half_on_a_sphere():
    points = shapes.even_sphere(20_000)
    points = points[spatial_order(points)]
    region = np.unique(np.floor(points * 2.999).astype(int), axis=0, return_inverse=True)[1].ravel()
    areas = np.full(len(points), 4 * np.pi / len(points))
    total = winding_matrix(points, points, areas, region).sum(axis=1)
    own = np.bincount(region, areas) / (8 * np.pi)  # on a sphere, an area gives each place of it area / 8 pi
    np.testing.assert_allclose(total + own, 0.5, atol=0.06)  # the points of a source are averaged


def test_a_demand_is_met_where_nothing_is_coupled():
    matrix = np.array([[2.0, 1.0], [0.0, 4.0]], np.float32)
    x = relax(csr_matrix((2, 2)), np.zeros(2), LeastSquares(matrix, np.array([1.0, 5.0]), 0.5, np.arange(2), 2))
    np.testing.assert_allclose(x, [0.1875, 0.125], atol=1e-5)


def test_a_demand_on_some_leaves_the_others_to_their_votes():
    matrix = np.array([[2.0, 1.0], [0.0, 4.0]], np.float32)
    demand = LeastSquares(matrix, np.array([1.0, 5.0]), 0.5, np.array([0, 2]), 3)
    x = relax(csr_matrix((3, 3)), np.array([0.0, -1.0, 0.0]), demand)
    np.testing.assert_allclose(x, [0.1875, -1, 0.125], atol=1e-5)


def settled_plate():
    """Signs of the regions of a plate, of which number 8 is a corner of number 7."""
    points, normals, region = plate(40, 0.15)
    region[(region == 7) & (points[:, :2] > 0.8).all(axis=1)] = 8
    wrong = np.isin(region, [4, 5, 8])
    surface = Surface(points, np.where(wrong[:, None], -normals, normals))
    # the couplings take both sides for one sheet where 4 and 5 are wrong, and hold the others together weakly
    pairs = [(0, 1, 1.0), (1, 3, 1.0), (3, 2, 1.0), (6, 7, 1.0), (4, 5, 1.0), (4, 0, 0.4), (5, 1, 0.4), (6, 2, -0.4)]
    i, j, agreement = np.array([*pairs, (7, 8, -0.4)]).T
    coupling = csr_matrix((agreement, (i.astype(int), j.astype(int))), (9, 9))
    told = np.zeros(9)
    told[0] = 0.1
    return settle_by_winding(surface, np.arange(len(points)), region, coupling + coupling.T, told, np.ones(9))


def test_a_side_of_a_plate_that_neighbors_turn_the_wrong_way_is_turned_back():
    np.testing.assert_array_equal(settled_plate()[0] < 0, [False] * 4 + [True] * 2 + [False] * 2 + [True])


def test_a_surface_of_which_a_side_is_missing_is_not_whole():
    """Half of a wave's crests and troughs have the wrong winding number, whichever side is outward."""
    x, y = np.random.default_rng(0).uniform(0, 4 * np.pi, (2, 8000))
    points = np.stack([x, y, np.sin(x)], axis=1)
    normals = np.stack([-np.cos(x), np.zeros(len(x)), np.ones(len(x))], axis=1)
    surface = Surface(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))
    region = (x // (np.pi / 2)).astype(np.int32)
    chain = csr_matrix((np.ones(7), (np.arange(7), np.arange(1, 8))), (8, 8))
    arguments = surface, np.arange(len(points)), region, chain + chain.T, np.full(8, 0.1), np.ones(8)
    assert not settle_by_winding(*arguments)[1]
    assert settled_plate()[1]


def test_regions_beyond_the_largest_follow_their_couplings(monkeypatch):
    monkeypatch.setattr("jetnormal.orientation.winding.MAX_REGIONS", 8)
    np.testing.assert_array_equal(settled_plate()[0] < 0, [False] * 4 + [True] * 2 + [False] * 2 + [True])
    monkeypatch.setattr("jetnormal.orientation.winding.MAX_REGIONS", 3)  # these hold too few of the points
    np.testing.assert_array_equal(settled_plate()[0], np.ones(9))


@pytest.mark.parametrize("method", ["global", "mst"])
def test_the_walls_of_a_noisy_box_with_a_deep_pocket_look_outward(method):
    """Walls four deviations of the noise thick: by neighbors alone, inner sides get the sign of outer ones."""
    rng = np.random.default_rng(3)
    outer, inner = np.ones(3), np.full(3, 0.8)
    parts = []
    for half, sign in ((outer, 1), (inner, -1)):
        for axis in range(3):
            for side in (-1, 1):
                if (axis, side) == (2, 1):
                    continue
                count = round(3600 * half[0] ** 2)
                points = rng.uniform(-1, 1, (count, 3)) * half
                points[:, axis] = side * half[axis]
                if axis < 2 and sign < 0:  # up to the rim
                    points[:, 2] = rng.uniform(-half[2], 1, count)
                parts.append((points, np.tile(sign * side * np.eye(3)[axis], (count, 1))))
    rim = rng.uniform(-1, 1, (3600, 3))
    rim = rim[np.abs(rim[:, :2]).max(axis=1) > 0.8]
    rim[:, 2] = 1
    parts.append((rim, np.tile([0.0, 0.0, 1.0], (len(rim), 1))))
    points, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    noisy = points + rng.normal(scale=0.05, size=points.shape)
    signs = rng.choice([-1.0, 1.0], (len(points), 1))
    assert oriented_accuracy(choose_signs(noisy, normals * signs, method).normals, normals)[0] > 0.94
