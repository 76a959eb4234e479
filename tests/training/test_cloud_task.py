from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from jetnormal.data.sources import SyntheticSolids
from jetnormal.errors import ModelError, ResourceError
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.config import CloudFitConfig
from jetnormal.networks.cloudfit.network import CloudFit
from jetnormal.networks.cloudfit.torch_ops import plain_torch
from jetnormal.support.device import worker_pool
from jetnormal.training import cloud_task
from jetnormal.training.cloud_task import CloudTask
from jetnormal.training.losses import FLOOR, cloudfit_loss
from jetnormal.training.options import CloudTraining
from jetnormal.training.recipe import read_recipe
from jetnormal.training.train import train

LAYERS = {"channels": (4, 4, 4), "hidden": 4, "up_layers": (1, 1, 1), "down_layers": (1, 1, 0)}
TINY = CloudFitConfig(**LAYERS)
SOLIDS = SyntheticSolids(clouds_per_epoch=2, points=400)
RECIPE = read_recipe(
    "cloudfit", {"network": LAYERS, "training": {"epochs": 2, "crop_points": 150, "crops_per_cloud": 3}}
)


def test_an_interrupted_run_ends_as_an_uninterrupted_one(resumed_equals_whole):
    summary = resumed_equals_whole(RECIPE, CloudTask, SOLIDS, threads=2)
    assert summary["epoch"] == 2
    assert 2 * 3 * 2 * 40 < summary["samples"] < 2 * 3 * 2 * 150


def test_a_loss_that_is_no_number_stops_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    terms = {"loss": torch.tensor(math.nan, requires_grad=True)}
    monkeypatch.setattr(cloud_task, "cloudfit_loss", lambda *_: terms)
    with pytest.raises(ModelError, match="lower the learning rate"):
        train(RECIPE, tmp_path, source=SOLIDS)


def test_a_device_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(ResourceError, match="no device cuda:99"):
        train(RECIPE, tmp_path, source=SOLIDS, device="cuda:99")


def test_gradients_of_plain_pytorch_are_those_of_the_compiled_loops():
    with worker_pool(1) as pool:
        task = CloudTask(TINY, CloudTraining(crop_points=150), pool)
        crops = task.held_out(SOLIDS)[:1]
        terms = task.backward(crops)
        compiled = {name: p.grad.clone() for name, p in task.network.named_parameters()}
        with plain_torch():
            assert task.backward(crops)["loss"] == pytest.approx(terms["loss"], rel=1e-3)
    for name, parameter in task.network.named_parameters():
        scale = compiled[name].abs().max().item() + 1e-4
        torch.testing.assert_close(parameter.grad / scale, compiled[name] / scale, atol=0.02, rtol=0)


def test_the_average_is_validated(tmp_path: Path):
    """The errors are those of the network given, not of the task's own."""
    with worker_pool(1) as pool:
        task = CloudTask(TINY, CloudTraining(crop_points=150), pool)
        held_out = task.held_out(SOLIDS)
        assert len(held_out) == 4
        other = CloudFit(TINY)
        assert task.errors(other, held_out) != task.errors(task.network, held_out)
        assert task.errors(task.network, held_out) == task.errors(task.network, held_out)


def test_loss_of_the_truth_is_its_floor():
    rng = np.random.default_rng(0)
    normals = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    prediction = CloudFit(TINY)(build_pyramid(rng.random((200, 3)), 3))
    learned = torch.arange(200) < 50
    assert cloudfit_loss(prediction, normals, learned)["normals"] > 0.3
    prediction.normals.data[:50] = -normals[:50]  # signs do not matter
    assert cloudfit_loss(prediction, normals, learned)["normals"].item() == pytest.approx(FLOOR, rel=0.01)
