from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from jetnormal.data.sources import SyntheticSolids
from jetnormal.errors import InputError, ModelError
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.checkpoint import load_model
from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig
from jetnormal.training import cloudloop
from jetnormal.training.cloudloop import CloudTrainOptions, learning_rate, loss_terms, train_cloudfit

TINY = CloudFitConfig(channels=(4, 4, 4), hidden=4, up_layers=(1, 1, 1), down_layers=(1, 1, 0))
SOLIDS = SyntheticSolids(clouds_per_epoch=2, points=400)
OPTIONS = CloudTrainOptions(epochs=2, crop_points=150, crops_per_cloud=3, threads=2)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_model(folder / "model.safetensors").state_dict()


def test_an_interrupted_run_ends_as_an_uninterrupted_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    summary = train_cloudfit(TINY, SOLIDS, tmp_path / "whole", OPTIONS)
    assert summary["epoch"] == 2
    steps = []

    def stop_in_the_second_epoch(*arguments):
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt
        return step(*arguments)

    step = cloudloop._step
    monkeypatch.setattr(cloudloop, "_step", stop_in_the_second_epoch)
    monkeypatch.setattr("jetnormal.training.run.SAVE_INTERVAL", -1.0)  # after each step
    with pytest.raises(KeyboardInterrupt):
        train_cloudfit(TINY, SOLIDS, tmp_path / "parts", OPTIONS)
    monkeypatch.setattr(cloudloop, "_step", step)
    train_cloudfit(TINY, SOLIDS, tmp_path / "parts", OPTIONS, resume=True)
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    assert all(torch.equal(value, parts[name]) for name, value in whole.items())


def test_a_run_is_not_started_over_another(tmp_path: Path):
    train_cloudfit(TINY, SOLIDS, tmp_path, OPTIONS)
    with pytest.raises(InputError, match="holds a run already"):
        train_cloudfit(TINY, SOLIDS, tmp_path, OPTIONS)


def test_a_loss_that_is_no_number_stops_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    terms = {"loss": torch.tensor(math.nan, requires_grad=True)}
    monkeypatch.setattr(cloudloop, "loss_terms", lambda *_: terms)
    with pytest.raises(ModelError, match="lower --learning-rate"):
        train_cloudfit(TINY, SOLIDS, tmp_path, OPTIONS)


def test_rate_rises_and_falls():
    rates = [learning_rate(share, 1.0) for share in np.linspace(0, 0.999, 200)]
    assert rates[0] == pytest.approx(0.01)
    assert max(rates) > 0.99
    assert rates[-1] < 1e-3
    top = int(np.argmax(rates))
    assert rates[top:] == sorted(rates[top:], reverse=True)


def test_loss_of_the_truth_is_its_floor():
    rng = np.random.default_rng(0)
    normals = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    network = CloudFit(TINY)
    encoding = network.encode(build_pyramid(rng.random((200, 3)), 3))
    prediction = network.fit(encoding, torch.arange(50))
    terms = loss_terms(encoding, prediction, normals, 50)
    assert terms["refined"] > 0.3
    prediction.refined.data.copy_(-normals[:50])  # signs do not matter
    assert loss_terms(encoding, prediction, normals, 50)["refined"].item() == pytest.approx(cloudloop.FLOOR, rel=0.01)
