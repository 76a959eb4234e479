"""What IterNet learns, and that its training is resumable and deterministic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from jetnormal.data.sources import SyntheticSolids
from jetnormal.errors import UsageError
from jetnormal.geometry.graph import cloud_spacing
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.networks.iternet import IterNet, IterNetConfig
from jetnormal.support.device import worker_pool
from jetnormal.training.iter_task import IterTask, Turned, round_crops
from jetnormal.training.options import IterTraining
from jetnormal.training.recipe import read_recipe
from jetnormal.training.train import train

SOLIDS = SyntheticSolids(clouds_per_epoch=2, points=400)
RECIPE = read_recipe(
    "iternet",
    {
        "network": {"neighbors": 12, "iterations": 2},
        "training": {"epochs": 2, "crop_points": 120, "crops_per_cloud": 3, "bfloat16": False},
    },
)


def test_an_interrupted_run_ends_as_an_uninterrupted_one(resumed_equals_whole):
    summary = resumed_equals_whole(RECIPE, IterTask, SOLIDS, threads=1)
    assert summary["parameters"] == 7_981
    assert summary["samples"] == 2 * 3 * 2 * 60


def test_clouds_are_turned_and_scaled_to_their_spacing():
    plain, turned = SOLIDS.cloud(0, 1, 5), Turned(SOLIDS).cloud(0, 1, 5)
    assert cloud_spacing(turned.points) == pytest.approx(1, rel=1e-6)
    assert np.linalg.norm(np.cross(plain.normals, turned.normals), axis=1).max() > 0.1
    before, after = (cloud.points - cloud.points.mean(axis=0) for cloud in (plain, turned))
    heights = (before * plain.normals).sum(axis=1) / cloud_spacing(plain.points)
    np.testing.assert_allclose((after * turned.normals).sum(axis=1), heights, atol=1e-6)


def test_the_gradient_is_that_of_the_mean_loss_of_the_iterations():
    cloud = Turned(SOLIDS).cloud(0, 0, 1)
    crops = round_crops(cloud, NeighborIndex(cloud.points), np.array([3, 90]), 120)
    assert [crop.learned.sum() for crop in crops] == [60, 60]
    with worker_pool(1) as pool:
        task = IterTask(IterNetConfig(12, 2), IterTraining(), pool)
        terms = task.backward(crops)
        assert terms["loss"] == pytest.approx((terms["iteration_1"] + terms["iteration_2"]) / 2)
        before = {name: parameter.grad for name, parameter in task.network.named_parameters()}
        step = 1e-2 / sum(gradient.square().sum() for gradient in before.values()).sqrt()
        with torch.no_grad():
            for name, parameter in task.network.named_parameters():
                parameter -= step * before[name]
        assert task.backward(crops)["loss"] < terms["loss"]


def test_the_network_given_is_validated():
    with worker_pool(1) as pool:
        task = IterTask(IterNetConfig(12, 2), IterTraining(crop_points=100), pool)
        held_out = task.held_out(SOLIDS)
        assert len(held_out) == 8
        torch.manual_seed(1)
        one, other = task.errors(task.network, held_out), task.errors(IterNet(IterNetConfig(12, 2)), held_out)
        assert one[0] != other[0]
        assert one[1] == other[1]  # the planes that both start from


def test_iternet_trains_on_the_cpu_only(tmp_path: Path):
    with pytest.raises(UsageError, match="iternet trains on the CPU, not on cuda"):
        train(RECIPE, tmp_path, source=SOLIDS, device="cuda")
