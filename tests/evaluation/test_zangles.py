from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from shapes import sphere

from jetnormal.estimators.patchwise import pca_estimator
from jetnormal.evaluation.clouds import BenchmarkCloud
from jetnormal.evaluation.zangles import SAMPLE, measure_z_angles


@pytest.fixture
def cloud():
    """A sphere, of which every third point is evaluated."""
    normals = sphere(6000)
    return BenchmarkCloud("sphere", [], 5 * normals + 7, normals, np.arange(0, 6000, 3))


def with_rotation(degrees):
    """An estimator whose transform turns every patch about its x axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = torch.tensor([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]], dtype=torch.float32)
    return replace(pca_estimator(k=16), transform=lambda points: rotation.expand(len(points), 3, 3))


def test_without_a_turn_the_angle_is_that_of_the_patch_plane(cloud):
    found = measure_z_angles(with_rotation(0), cloud)
    planes = pca_estimator(k=16)(cloud.points, cloud.queries[found.rows]).normals
    cosine = np.abs((planes * cloud.true_normals[found.rows]).sum(axis=1))
    np.testing.assert_allclose(found.before, np.degrees(np.arccos(np.minimum(cosine, 1))), atol=0.1)
    np.testing.assert_allclose(found.after, found.before, atol=1e-3)
    assert found.before.max() < 15


def test_a_turn_adds_to_the_angle(cloud):
    found = measure_z_angles(with_rotation(40), cloud)
    assert (np.abs(found.after - 40) <= found.before + 1e-3).all()


def test_an_even_selection_is_measured(cloud):
    found = measure_z_angles(with_rotation(0), cloud)
    np.testing.assert_array_equal(found.rows, np.arange(0, 2000, 2))
    assert len(found.rows) == len(found.before) == len(found.after) == SAMPLE


def test_classical_fits_have_none(cloud, turned):
    assert measure_z_angles(pca_estimator(k=16), cloud) is None
    assert measure_z_angles(turned(1.0), cloud) is None
