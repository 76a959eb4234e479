"""What PCPNet and Nesti-Net learn: their trainings from recipes, resumable and deterministic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from jetnormal.data.sources import SyntheticSolids
from jetnormal.errors import UsageError
from jetnormal.geometry.balls import BallIndex
from jetnormal.networks.checkpoint import load_model
from jetnormal.networks.pcpnet import PCPNetConfig
from jetnormal.training.ball_task import BallTask, labeled_balls
from jetnormal.training.recipe import Recipe, read_recipe
from jetnormal.training.train import train

SOLIDS = SyntheticSolids(clouds_per_epoch=2, points=300)
NETWORK = {"radii": [0.1, 0.2], "points": 16, "width": 0.0625}
TRAINING = {"epochs": 2, "batch_size": 4, "patches_per_cloud": 6, "validation_patches": 8, "bfloat16": False}


def recipe(name: str) -> Recipe:
    return read_recipe(name, {"network": NETWORK, "training": TRAINING})


@pytest.mark.parametrize("name", ["pcpnet-small", "nestinet-small"])
def test_an_interrupted_run_ends_as_an_uninterrupted_one(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    summary = train(recipe(name), tmp_path / "whole", source=SOLIDS, threads=1, device="cpu")
    assert summary["samples"] == 2 * 3 * 4
    assert 0 < summary["rmse"] < 90
    steps = []

    def stop_in_the_second_epoch(*arguments, backward=BallTask.backward):
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return backward(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(BallTask, "backward", stop_in_the_second_epoch)
        with pytest.raises(KeyboardInterrupt):
            train(recipe(name), tmp_path / "parts", source=SOLIDS, threads=1, device="cpu")
    train(recipe(name), tmp_path / "parts", source=SOLIDS, threads=1, device="cpu", resume=True)
    whole, parts = (load_model(tmp_path / run / "model.safetensors").state_dict() for run in ("whole", "parts"))
    assert all(torch.equal(value, parts[key]) for key, value in whole.items())


def test_normals_lie_in_the_frames_of_the_balls():
    cloud = SOLIDS.cloud(0, 0, 1)
    config = PCPNetConfig(radii=(0.3,), points=300, principal_axes=True)
    queries = np.array([3, 50])
    batch = labeled_balls(cloud, BallIndex(cloud.points), queries, config)
    index = BallIndex(cloud.points)
    inside = np.flatnonzero(np.linalg.norm(cloud.points - cloud.points[50], axis=1) <= 0.3 * index.diagonal)
    heights = np.sort((cloud.points[inside] - cloud.points[50]) @ cloud.normals[50]) / (0.3 * index.diagonal)
    found = np.sort((batch.points[1, 0, : len(inside)] @ batch.normals[1]).numpy())
    np.testing.assert_allclose(found, heights, atol=1e-5)


@pytest.mark.parametrize("name", ["pcpnet-paper", "pcpnet-single", "nestinet-paper"])
def test_the_published_recipes_can_be_read(name: str):
    found = read_recipe(name)
    assert found.training.batch_size == 64
    assert found.network.width == 1


def test_a_batch_has_two_queries_or_more(tmp_path: Path):
    alone = read_recipe("pcpnet-small", {"network": NETWORK, "training": TRAINING | {"batch_size": 1}})
    with pytest.raises(UsageError, match="2 or more"):
        train(alone, tmp_path, source=SOLIDS)
