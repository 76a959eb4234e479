"""Classical and learned estimators on surfaces whose normals and curvatures are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from shapes import sphere

from jetnormal.estimators.factory import make_estimator
from jetnormal.estimators.patchwise import BATCH_POINTS, jet_estimator, network_estimator, pca_estimator
from jetnormal.geometry.metrics import angles
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig

TINY = PatchFitConfig(neighbors=64, width=0.125, transform_width=0.125, feature_transform=False, light=True)


def torus(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and principal curvatures (by outward normal) of a torus with radii 1 and 0.4."""
    u, v = np.random.default_rng(1).uniform(0, 2 * np.pi, size=(2, count))
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], 1)
    ring = np.stack([np.cos(u), np.sin(u), np.zeros(count)], 1)
    curvatures = np.stack([-np.cos(v) / (1 + 0.4 * np.cos(v)), np.full(count, -1 / 0.4)], 1)
    return ring + 0.4 * normals, normals, curvatures


@pytest.fixture(scope="module")
def network() -> PatchFit:
    torch.manual_seed(0)
    return PatchFit(TINY).for_inference()


def test_pca_and_jet_find_the_normals_of_a_sphere():
    points = normals = sphere(4000)
    assert np.median(angles(make_estimator("pca")(points).normals, normals)) < 1.5
    assert np.median(angles(make_estimator("jet")(points).normals, normals)) < 0.1


def test_a_jet_of_higher_order_is_better_on_a_smooth_surface():
    points, normals, _ = torus(8000)
    errors = [np.median(angles(make_estimator(f"jet:k=60,order={n}")(points).normals, normals)) for n in (1, 2, 3, 4)]
    assert errors[1] < errors[0] / 3 and errors[3] < errors[2] < errors[1]


def test_jet_curvatures_of_a_torus_in_the_unit_of_the_cloud():
    points, normals, true = torus(20_000)
    found = make_estimator("jet:k=40,order=3")(10 * points)
    outward = (found.normals * normals).sum(1) > 0
    curvatures = np.where(outward[:, None], found.curvatures, -found.curvatures[:, ::-1])
    assert np.median(np.abs(10 * curvatures - true)) < 0.05


@pytest.mark.parametrize("name", ["pca:k=20", "jet:k=40,order=3", "network"])
def test_turning_moving_and_scaling_the_cloud_turns_the_normals(name, network):
    rng = np.random.default_rng(5)
    points = rng.normal(size=(300, 3)) * [1, 0.7, 0.2]
    estimator = network_estimator("tiny", network) if name == "network" else make_estimator(name)
    rotation = Rotation.random(rng=rng).as_matrix()
    moved = 30 * points @ rotation.T + [5e6, -4e6, 3e5]
    before, after = estimator(points), estimator(moved)
    assert angles(after.normals, before.normals @ rotation.T).max() < 0.05
    assert np.abs(after.confidence - before.confidence).max() < 1e-3


def test_the_order_of_the_points_does_not_matter(network):
    points = sphere(500)
    order = np.random.default_rng(2).permutation(500)
    for estimator in (make_estimator("jet"), network_estimator("tiny", network)):
        assert angles(estimator(points[order]).normals, estimator(points).normals[order]).max() < 0.01


def test_batches_and_queries_do_not_change_the_result(network):
    points = sphere(300)
    whole = network_estimator("tiny", network)(points)
    done = []
    parts = network_estimator("tiny", network, batch_size=7)(points, np.arange(100, 151), done.append)
    assert np.abs(parts.normals - whole.normals[100:151]).max() < 1e-5
    assert sum(done) == 51


def test_two_runs_are_equal_bit_for_bit(network):
    points = sphere(400)
    estimator = network_estimator("tiny", network)
    assert np.array_equal(estimator(points).normals, estimator(points).normals)


def test_iterations_change_the_fit_and_stay_unit(network):
    points = sphere(300)
    once = network_estimator("tiny", network)(points)
    twice = network_estimator("tiny", network, iterations=2)(points)
    assert not np.allclose(once.normals, twice.normals)
    assert np.allclose(np.linalg.norm(twice.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("name", ["pca", "jet", "network"])
def test_collinear_neighbors_have_no_normal_and_no_confidence(name, network):
    line = np.linspace(0, 1, 100)[:, None] * [1.0, 2.0, 3.0] + [5e6, 0, 0]
    found = (network_estimator("tiny", network) if name == "network" else make_estimator(name))(line)
    assert np.isnan(found.normals).all()
    assert (found.confidence == 0).all()


def test_a_line_beside_a_plane_harms_only_itself():
    rng = np.random.default_rng(3)
    plane = np.c_[rng.random((500, 2)), np.zeros(500)]
    line = np.linspace(0, 1, 60)[:, None] * [0.0, 0.0, 1.0] + [9.0, 9.0, 9.0]
    found = make_estimator("pca:k=20")(np.r_[plane, line])
    assert np.isnan(found.normals).all(1).tolist() == [False] * 500 + [True] * 60
    assert np.abs(found.normals[:500, 2]).min() > 1 - 1e-6


def test_three_points_give_their_plane():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    for name in ("pca", "jet"):
        assert np.abs(make_estimator(name)(triangle).normals[:, 2]).min() > 1 - 1e-6


def test_confidence_is_high_on_a_plane_and_lower_in_a_ball():
    rng = np.random.default_rng(4)
    plane = np.c_[rng.random((500, 2)), np.zeros(500)]
    ball = rng.normal(size=(500, 3))
    for name, gap in (("pca", 0.3), ("jet", 0.02)):
        estimator = make_estimator(name)
        assert np.median(estimator(plane).confidence) > 0.99
        assert np.median(estimator(ball).confidence) < 0.99 - gap


def test_large_patches_come_in_batches_of_bounded_memory():
    for k in (6, 30, 500, 100_000):
        for estimator in (pca_estimator(k), jet_estimator(k)):
            assert 0 < estimator.batch_size * k <= BATCH_POINTS + k
    assert pca_estimator(500, batch_size=2000).batch_size == 2000
