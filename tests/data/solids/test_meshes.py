"""Meshes of the primitives, and rays cast at solids."""

import numpy as np
import pytest

from jetnormal.data.scanners.targets import SolidTarget
from jetnormal.data.solids.csg import Part, Solid
from jetnormal.data.solids.draw import random_solid
from jetnormal.data.solids.primitives import ConvexPolyhedron, Lathe, RoundedBox, RoundedCylinder, Torus
from jetnormal.data.solids.starshaped import BumpySphere, Superellipsoid

PRIMITIVES = [
    RoundedBox([0.5, 0.4, 0.3]),
    RoundedBox([0.5, 0.4, 0.3], 0.1),
    RoundedBox([0.5, 0.0, 0.0], 0.2),
    RoundedBox(np.zeros(3), 0.5),
    RoundedCylinder(0.4, 0.3, 0.1),
    Torus(0.6, 0.2),
    Lathe(0.5, 0.4),
    Lathe(0.8, 0.4, 0.1, 0.1, 5.0, 1.0),
    ConvexPolyhedron(np.concatenate([np.eye(3), -np.eye(3)])),
    Superellipsoid([0.5, 0.8, 1.0], 4.0),
    BumpySphere([0.05, 0.03], [[3.0, 1.0, 2.0], [-2.0, 4.0, 1.0]], [0.3, 1.0]),
]


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=lambda primitive: type(primitive).__name__)
def test_the_mesh_is_the_surface(primitive):
    mesh = primitive.mesh()
    assert np.abs(primitive.implicit(mesh.vertices[np.unique(mesh.faces)])).max() < 1e-9
    area = mesh.area_vectors()
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(primitive.area, rel=3e-3)
    assert np.abs(area.sum(0)).max() < 1e-9  # closed
    assert (mesh.vertices[mesh.faces].mean(1) * area).sum() > 0  # wound outwards


def test_rays_pass_through_a_hole():
    plate = Solid([Part(RoundedBox([1.0, 1.0, 0.1])), Part(Lathe(2.0, 0.3), "difference")])
    target = SolidTarget(plate)
    origins = np.array([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [-1.0, 0.0, 0.0]]) / target.size - target.center / target.size
    directions = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    origins[2] = (np.array([0.0, 0.0, 0.0]) - target.center) / target.size  # from the middle of the hole to its wall
    hits = target.cast(origins, directions)
    assert np.isinf(hits.distance[0])
    np.testing.assert_allclose(hits.distance[1:] * target.size, [1.9, 0.3], atol=1e-9)
    np.testing.assert_allclose(hits.normals[1:], [[0, 0, 1], [-1, 0, 0]], atol=1e-9)
    under = (np.array([[0.5, 0.0, -0.1]]) - target.center) / target.size
    assert target.visible(under, under - np.eye(3)[2:]) == [True]
    assert target.visible(under, under + np.eye(3)[2:]) == [False]


@pytest.mark.parametrize("seed", range(4))
def test_hits_lie_on_random_solids(seed):
    rng = np.random.default_rng(seed)
    solid = random_solid(rng)
    target = SolidTarget(solid)
    eyes = rng.normal(size=(1000, 3))
    eyes *= 2 / np.linalg.norm(eyes, axis=1, keepdims=True)
    directions = 0.2 * rng.normal(size=(1000, 3)) - eyes
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = target.cast(eyes, directions)
    met = np.isfinite(hits.distance)
    assert met.mean() > 0.2
    points = target.center + target.size * (eyes[met] + hits.distance[met, None] * directions[met])
    off = np.min([np.abs(part.implicit(points)) for part in solid.parts], axis=0)
    assert np.quantile(off, 0.98) < 1e-9 and off.max() < 1e-3 * target.size
    step = 1e-4 * hits.normals[met]
    assert solid.contains(points - step).mean() > 0.99
    assert solid.contains(points + step).mean() < 0.01
    assert ((hits.normals * directions)[met].sum(1) <= 0).all()
