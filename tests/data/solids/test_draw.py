from __future__ import annotations

import numpy as np
import pytest

from jetnormal.data.solids.csg import Part, Solid
from jetnormal.data.solids.draw import random_solid
from jetnormal.data.solids.primitives import ConvexPolyhedron, Lathe, RoundedBox, RoundedCylinder, Torus
from jetnormal.data.solids.starshaped import BumpySphere, Superellipsoid

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
WAVES = np.array([[3.0, 0, 1], [0, 4, 2], [-2, 2, 5]])

# Each primitive with its area, from a formula where there is one.
PRIMITIVES = {
    "box": (RoundedBox([1, 2, 3]), 88.0),
    "plate": (RoundedBox([1, 0.5, 0.01]), 2 * 2 * 1 + 2 * 0.02 * 3),
    "sphere": (RoundedBox([0, 0, 0], 0.7), 4 * np.pi * 0.49),
    "capsule": (RoundedBox([0.5, 0, 0], 0.2), 4 * np.pi * 0.04 + 2 * np.pi * 0.2),
    "rounded box": (RoundedBox([0.3, 0.4, 0.5], 0.1), None),
    "rounded cylinder": (RoundedCylinder(0.5, 0.4, 0.15), None),
    "torus": (Torus(0.8, 0.3), 4 * np.pi**2 * 0.24),
    "cylinder": (Lathe(1.0, 0.5), 2 * np.pi * 0.5 * 2 + 2 * np.pi * 0.25),
    "cone": (Lathe(0.5, 0.5, -1.0), np.pi * np.sqrt(2) + np.pi),
    "vase": (Lathe(1.0, 0.5, 0.1, 0.15, 6.0, 0.4), None),
    "tetrahedron": (ConvexPolyhedron(TETRAHEDRON), 8 * np.sqrt(3)),
    "round ellipsoid": (Superellipsoid([0.6, 0.6, 0.6]), 4 * np.pi * 0.36),
    "spheroid": (Superellipsoid([0.5, 0.5, 1.0]), None),
    "superellipsoid": (Superellipsoid([0.5, 0.7, 1.0], 5.0), None),
    "bumpy sphere": (BumpySphere([0.08, 0.06, 0.05], WAVES, [0.1, 1.2, 2.5]), None),
}


@pytest.fixture(params=PRIMITIVES)
def primitive(request):
    return PRIMITIVES[request.param][0]


def numerical_gradient(function, points, step=1e-6):
    gradient = np.empty_like(points)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        gradient[:, axis] = function(points + offset) - function(points - offset)
    return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


@pytest.mark.parametrize("name", [name for name, (_, area) in PRIMITIVES.items() if area is not None])
def test_area_matches_the_formula(name):
    primitive, area = PRIMITIVES[name]
    assert primitive.area == pytest.approx(area, rel=1e-3)


def test_points_lie_on_the_surface(primitive):
    points, normals = primitive.sample(2_000, np.random.default_rng(0))
    assert points.shape == normals.shape == (2_000, 3)
    np.testing.assert_allclose(primitive.implicit(points), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)


def test_normals_are_the_gradient_of_the_implicit_function(primitive):
    points, normals = primitive.sample(2_000, np.random.default_rng(0))
    gradient = numerical_gradient(primitive.implicit, points)
    cosine = (gradient * normals).sum(axis=1)
    # Within a step of an edge the difference sees both of its sides.
    assert (cosine > 1 - 1e-5).mean() > 0.998


def test_points_are_uniform_over_the_surface(primitive):
    """The volume of a thin layer, found by a grid of random points, holds as much area as the samples say."""
    rng = np.random.default_rng(1)
    points, _ = primitive.sample(40_000, rng)
    low, high = points.min(axis=0) - 0.05, points.max(axis=0) + 0.05
    cloud = rng.uniform(low, high, (1_500_000, 3))
    # Divided by the gradient's length, the implicit function is the distance to first order.
    step = 1e-5
    near = cloud[np.abs(primitive.implicit(cloud)) < 0.05]
    slope = np.stack([primitive.implicit(near + step * e) - primitive.implicit(near - step * e) for e in np.eye(3)])
    distance = primitive.implicit(near) / np.linalg.norm(slope / (2 * step), axis=0)
    layer = near[np.abs(distance) < 0.006]
    direction = np.random.default_rng(2).normal(size=3)
    cuts = np.quantile(points @ direction, [0.2, 0.4, 0.6, 0.8])
    shares = np.bincount(np.searchsorted(cuts, layer @ direction), minlength=5) / len(layer)
    np.testing.assert_allclose(shares, 0.2, atol=0.02)


def test_every_face_of_a_box_gets_its_share():
    _, normals = RoundedBox([1, 2, 3]).sample(40_000, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(normals).mean(axis=0), np.array([48, 24, 16]) / 88, atol=0.01)
    np.testing.assert_allclose(normals.mean(axis=0), 0, atol=0.02)


def test_zones_of_an_ellipsoid_get_their_share():
    """The cap z > c/2 of a prolate spheroid, integrated along its axis."""
    points, _ = Superellipsoid([0.5, 0.5, 1.0]).sample(40_000, np.random.default_rng(0))
    z = np.linspace(-1, 1, 200_001)
    strip = np.sqrt(0.25 * (1 - z**2) + 0.0625 * z**2)  # rho times the arc length per dz
    expected = strip[z > 0.5].sum() / strip.sum()
    assert (points[:, 2] > 0.5).mean() == pytest.approx(expected, abs=0.008)


@pytest.mark.parametrize("name", ["cylinder", "rounded cylinder"])
def test_caps_are_uniform_discs(name):
    points, normals = PRIMITIVES[name][0].sample(40_000, np.random.default_rng(0))
    for side in (-1, 1):
        cap = points[normals[:, 2] * side > 1 - 1e-12]
        rho = np.hypot(cap[:, 0], cap[:, 1])
        assert (rho < 0.25).mean() == pytest.approx(0.25, abs=0.02)  # half of the radius, a quarter of the disc


def test_cut_turns_the_normals_of_the_hole():
    ball = RoundedBox([0, 0, 0], 0.5)
    solid = Solid([Part(RoundedBox([1, 1, 1])), Part(ball, "difference", np.array([0, 0, 1.0]))])
    points, normals = solid.sample(20_000, np.random.default_rng(0))
    hole = np.abs(np.linalg.norm(points - [0, 0, 1], axis=1) - 0.5) < 1e-9
    np.testing.assert_allclose(normals[hole], ([0, 0, 1] - points[hole]) / 0.5, atol=1e-9)
    assert points[:, 2].max() <= 1 + 1e-12
    rim = np.pi * 0.25
    assert hole.mean() == pytest.approx(2 * rim / (24 - rim + 2 * rim), abs=0.01)


def test_union_buries_the_inner_surface():
    ball = RoundedBox([0, 0, 0], 1.0)
    solid = Solid([Part(ball), Part(ball, "union", np.array([1.0, 0, 0]), scale=0.8)])
    points, normals = solid.sample(10_000, np.random.default_rng(0))
    first, second = np.linalg.norm(points, axis=1), np.linalg.norm(points - [1, 0, 0], axis=1)
    assert first.min() > 1 - 1e-9
    assert second.min() > 0.8 - 1e-9
    on_first = np.abs(first - 1) < 1e-9
    np.testing.assert_allclose(normals[on_first], points[on_first], atol=1e-9)
    np.testing.assert_allclose(normals[~on_first], (points[~on_first] - [1, 0, 0]) / 0.8, atol=1e-9)


def test_parts_apply_in_their_order():
    """A boss added after the drilling closes the hole, one added before it is drilled."""
    block, drill = Part(RoundedBox([1, 1, 1])), Part(Lathe(2.0, 0.3), "difference")
    boss = Part(RoundedBox([0.5, 0.5, 1.2]))
    center = np.zeros((1, 3))
    assert Solid([block, drill, boss]).contains(center)[0]
    assert not Solid([block, boss, drill]).contains(center)[0]


def test_solid_that_is_cut_away_is_refused():
    solid = Solid([Part(RoundedBox([0.5, 0.5, 0.5])), Part(RoundedBox([1, 1, 1]), "difference")])
    with pytest.raises(ValueError, match="no surface"):
        solid.sample(10, np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(40))
def test_random_solids_have_outward_unit_normals(seed):
    rng = np.random.default_rng(seed)
    solid = random_solid(rng)
    points, normals = solid.sample(3_000, rng)
    assert points.shape == normals.shape == (3_000, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    # Steps of 1e-5 cross the other side only next to an edge.
    assert solid.contains(points - 1e-5 * normals).mean() > 0.997
    assert solid.contains(points + 1e-5 * normals).mean() < 0.003


def test_random_solids_are_repeatable_and_differ():
    draw = lambda seed: random_solid(np.random.default_rng(seed)).sample(50, np.random.default_rng(0))[0]  # noqa: E731
    np.testing.assert_array_equal(draw(1), draw(1))
    assert not np.allclose(draw(1), draw(2))


def test_random_solids_have_edges_and_thin_walls():
    """Over many solids there are neighbors across sharp edges and points close behind one another."""
    from scipy.spatial import cKDTree

    sharp, thin = 0, 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points, normals = random_solid(rng).sample(4_000, rng)
        diagonal = np.linalg.norm(np.ptp(points, axis=0))
        pairs = cKDTree(points).query_pairs(0.02 * diagonal, output_type="ndarray")
        cosine = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1)
        sharp += (np.abs(cosine) < 0.5).mean() > 0.01
        thin += (cosine < -0.9).mean() > 0.01
    assert sharp >= 10
    assert thin >= 3
