"""The packaged network keeps its promise on clouds that it has never seen."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal import load_model
from jetnormal.estimators import make_estimator
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.networks.checkpoint import packaged_names
from jetnormal.training.corruption import add_noise
from jetnormal.training.shapes import random_solid

SEEDS = (90_001, 90_002, 90_003)  # of solids; training draws from others


def error(model: str, noise: float) -> float:
    """RMSE in degrees over 300 points of each solid."""
    estimator = make_estimator(model)
    errors = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        points, normals = random_solid(rng).sample(30_000, rng)
        queries = rng.choice(len(points), 300, replace=False)
        found = estimator(add_noise(points, noise, rng) if noise else points, queries)
        errors.append(angles(found.normals, normals[queries]))
    return rmse(np.concatenate(errors))


def test_deepfit_is_packaged_and_small():
    assert "deepfit" in packaged_names()
    assert sum(p.numel() for p in load_model("deepfit").parameters()) < 1_000_000


@pytest.mark.parametrize(("noise", "share"), [(0.0, 0.75), (1.25e-3, 0.85), (6e-3, 1.0)])
def test_deepfit_beats_a_plane_and_a_jet(noise, share):
    classical = min(error("pca:k=112", noise), error("jet:k=122,order=2", noise))
    assert error("deepfit", noise) < share * classical


def test_confidence_tells_good_normals_from_bad():
    rng = np.random.default_rng(SEEDS[0])
    points, normals = random_solid(rng).sample(30_000, rng)
    queries = rng.choice(len(points), 1000, replace=False)
    found = make_estimator("deepfit")(points, queries)
    errors = angles(found.normals, normals[queries])
    order = np.argsort(found.confidence)
    assert rmse(errors[order[:200]]) > 1.2 * rmse(errors[order[-500:]])
