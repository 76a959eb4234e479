from __future__ import annotations

import numpy as np
import pytest
import shapes

from jetnormal.orientation.dipole_field import DipoleField


@pytest.fixture
def sphere():
    return 5 + 2 * shapes.sphere(20_000), shapes.sphere(20_000)


def test_the_indicator_of_a_sphere_falls_by_one_and_not_along_the_surface(sphere):
    points, normals = sphere
    spacing, every = np.full(len(points), np.sqrt(4 * np.pi * 2**2 / len(points))), np.arange(len(points))
    field = DipoleField(points, every, spacing)
    field.solve(normals, spacing, np.ones(len(points)))
    within = np.flatnonzero(np.abs(normals).max(axis=1) < 0.8)  # four cells farther out, the field still has values
    assert field.drop(4 * normals, within) == pytest.approx(1, abs=0.2)
    assert field.drop(4 * normals, within).mean() == pytest.approx(1, abs=0.03)
    along = np.cross(normals, [0.6, 0.0, 0.8])
    assert np.abs(field.drop(along, every)).mean() < 0.05


def test_the_indicator_falls_outward_and_rises_where_a_normal_is_wrong(sphere):
    points, normals = sphere
    wrong = np.arange(len(points)) % 50 == 0
    turned = normals * np.where(wrong, -1, 1)[:, None]
    spacing, every = np.full(len(points), np.sqrt(4 * np.pi * 2**2 / len(points))), np.arange(len(points))
    field = DipoleField(points, every, spacing)
    field.solve(turned, spacing, np.ones(len(points)))
    assert ((field.drop(turned, every) < 0) == wrong).all()
