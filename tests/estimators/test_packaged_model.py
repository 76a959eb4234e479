"""The packaged network keeps its promise on clouds that it has never seen."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from shapes import sphere

from jetnormal import load_model
from jetnormal.data.corruption import add_noise
from jetnormal.data.solids.draw import random_solid
from jetnormal.estimators import patchwise
from jetnormal.estimators.factory import make_estimator
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.jobs.options import DEFAULT_MODEL
from jetnormal.networks.packaged import packaged_names

PATCH_NETWORKS = ("deepfit-small", "adafit-small", "graphfit-small")
SEEDS = (90_001, 90_002, 90_003)  # of solids; training draws from others


@functools.cache
def error(model: str, noise: float) -> float:
    """RMSE in degrees over 150 points of each solid."""
    estimator = make_estimator(model)
    errors = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        points, normals = random_solid(rng).sample(30_000, rng)
        queries = rng.choice(len(points), 150, replace=False)
        found = estimator(add_noise(points, noise, rng) if noise else points, queries)
        errors.append(angles(found.normals, normals[queries]))
    return rmse(np.concatenate(errors))


@pytest.mark.parametrize("model", PATCH_NETWORKS)
def test_patch_networks_are_packaged_and_small(model):
    assert model in packaged_names()
    assert sum(p.numel() for p in load_model(model).parameters()) < 1_000_000


def test_cloudfit_is_packaged_and_the_default():
    assert "cloudfit" in packaged_names()
    assert sum(p.numel() for p in load_model("cloudfit").parameters()) < 4_400_000
    assert DEFAULT_MODEL == "cloudfit"


@pytest.mark.parametrize("model", ["cloudfit", *PATCH_NETWORKS])
@pytest.mark.parametrize(("noise", "share"), [(0.0, 0.75), (1.25e-3, 0.85), (6e-3, 1.0)])
def test_networks_beat_a_plane_and_a_jet(model, noise, share):
    classical = min(error("pca:k=112", noise), error("jet:k=122,order=2", noise))
    assert error(model, noise) < share * classical


def test_iternet_is_packaged_and_beats_a_plane():
    rng = np.random.default_rng(SEEDS[0])
    points, normals = random_solid(rng).sample(8000, rng)
    queries = rng.choice(len(points), 500, replace=False)
    errors = {
        name: rmse(angles(make_estimator(name)(points, queries).normals, normals[queries]))
        for name in ("iternet", "pca:k=65")
    }
    assert errors["iternet"] < 0.6 * errors["pca:k=65"]


def test_bfloat16_products_leave_the_accuracy_alone(monkeypatch):
    errors = []
    for bfloat16 in (False, True):
        monkeypatch.setattr(patchwise, "multiplies_bfloat16", lambda _, known=bfloat16: known)
        errors.append(error.__wrapped__("deepfit-small", 1.25e-3))
    assert errors[0] != errors[1] and abs(errors[0] - errors[1]) < 0.05


@pytest.mark.parametrize("model", ["cloudfit", "deepfit-small"])
def test_confidence_tells_good_normals_from_bad(model):
    rng = np.random.default_rng(SEEDS[0])
    points, normals = random_solid(rng).sample(30_000, rng)
    queries = rng.choice(len(points), 1000, replace=False)
    found = make_estimator(model)(points, queries)
    errors = angles(found.normals, normals[queries])
    order = np.argsort(found.confidence)
    assert rmse(errors[order[:200]]) > 1.2 * rmse(errors[order[-500:]])


def test_confidence_of_cloudfit_is_the_share_of_normals_within_10_degrees():
    confidence, good = [], []
    estimator = make_estimator("cloudfit")
    for seed, noise in itertools.product(SEEDS, (0.0, 6e-3)):
        rng = np.random.default_rng(seed)
        points, normals = random_solid(rng).sample(30_000, rng)
        found = estimator(add_noise(points, noise, rng) if noise else points)
        confidence.append(found.confidence)
        good.append(angles(found.normals, normals) < 10)
    assert np.mean(np.concatenate(confidence)) == pytest.approx(np.mean(np.concatenate(good)), abs=0.07)


def test_cloudfit_follows_a_small_sphere_as_a_jet_does():
    normals = sphere(64)
    assert rmse(angles(make_estimator("cloudfit")(normals).normals, normals)) < 10


@pytest.mark.parametrize("shift", [1e-8, 1e-6, 1e-4])
def test_near_duplicates_change_nothing_for_cloudfit(shift):
    """Half of the points of a sphere, copied with a shift in units of its radius."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    doubled = np.concatenate([normals, normals[::2] + shift * rng.normal(size=(10_000, 3))])
    estimator = make_estimator("cloudfit")
    alone = rmse(angles(estimator(normals).normals, normals))
    assert rmse(angles(estimator(doubled).normals, np.concatenate([normals, normals[::2]]))) < 1.1 * alone
