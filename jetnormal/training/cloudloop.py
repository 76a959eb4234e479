"""The training loop of CloudFit: AdamW over crops of clouds, a thread per crop, resumable at any step."""

from __future__ import annotations

import dataclasses
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from jetnormal.data.sources import DataSource
from jetnormal.errors import ModelError, UsageError
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig, CloudPrediction, Encoding
from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.support.device import worker_pool
from jetnormal.training.crops import Crop, CropSampler, draw_crops
from jetnormal.training.epochs import HELD_OUT_EPOCH, MAX_GRADIENT, train_epochs
from jetnormal.training.run import Run

WARM_UP = 0.02  # share of the training in which the rate rises
FLOOR = 0.05  # radians: what is below is good enough
SURE = math.radians(10)


@dataclass(frozen=True)
class CloudTrainOptions:
    """How to train; the defaults made the packaged weights.

    Attributes:
        epochs: passes over the source.
        batch_size: crops in a step.
        learning_rate: AdamW's at its highest; it follows a cosine to zero.
        crop_points: points of a crop, half of which are learned from.
        crops_per_cloud: crops of each cloud in an epoch.
        seed: of the data, their order and the initial weights.
        threads: crops computed at a time; None for all cores.
        data: name of the data, for the record.
        initial: name or file of a model whose weights to start from; empty starts from random ones.
    """

    epochs: int = 30
    batch_size: int = 2
    learning_rate: float = 2e-3
    crop_points: int = 8000
    crops_per_cloud: int = 12
    seed: int = 1
    threads: int | None = None
    data: str = ""
    initial: str = ""


def train_cloudfit(
    config: CloudFitConfig,
    source: DataSource,
    folder: Path,
    options: CloudTrainOptions,
    *,
    validation: DataSource | None = None,
    resume: bool = False,
    tensorboard: bool = False,
) -> dict[str, Any]:
    """Trains a CloudFit network and leaves it in a folder; arguments, result and errors as `training.loop.train`."""
    torch.manual_seed(options.seed)
    network = CloudFit(config)
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.learning_rate, weight_decay=1e-4)
    facts = {"config": dataclasses.asdict(config), "options": dataclasses.asdict(options)}
    del facts["options"]["threads"]
    run = Run(folder, json.loads(json.dumps(facts)), network, optimizer, tensorboard)
    sampler = CropSampler(source, options.crop_points, options.crops_per_cloud, options.batch_size, options.seed)
    if sampler.batches_per_epoch == 0:
        raise UsageError("an epoch has fewer crops than a batch: lower --batch-size or train on more clouds")
    if resume:
        run.resume()
    else:
        run.begin(options.initial)
    held_out = _held_out(validation or source, options)
    with worker_pool(options.threads) as pool:

        def step(batch: list[Crop], share: float) -> dict[str, float]:
            return _step(run, batch, learning_rate(share, options.learning_rate), pool)

        row = train_epochs(
            run, sampler, options.epochs, step, lambda: validate(network, held_out, pool),
            samples=lambda batch: sum(crop.inner for crop in batch), unit="steps", units=1,
        )  # fmt: skip
    return {"model": str(run.model_path), "parameters": parameter_count(network)} | row


def learning_rate(share: float, highest: float) -> float:
    """The rate after a share, in [0, 1), of the training: a short rise and a cosine to zero."""
    return highest * min(1.0, share / WARM_UP + 0.01) * (1 + math.cos(math.pi * share)) / 2


def _step(run: Run, batch: list[Crop], rate: float, pool: ThreadPoolExecutor) -> dict[str, float]:
    """One step of the optimizer; the means of the loss terms before it."""
    network = run.network
    assert isinstance(network, CloudFit)
    parameters = list(network.parameters())

    def slope(crop: Crop) -> tuple[tuple[Tensor, ...], dict[str, float]]:
        terms = loss_terms(*_predict(network, crop), torch.from_numpy(crop.normals).float(), crop.inner)
        gradients = torch.autograd.grad(terms["loss"], parameters, allow_unused=True, materialize_grads=True)
        return gradients, {name: value.item() for name, value in terms.items()}

    results = list(pool.map(slope, batch))
    for group in run.optimizer.param_groups:
        group["lr"] = rate
    for parameter, *gradients in zip(parameters, *(gradients for gradients, _ in results), strict=True):
        parameter.grad = torch.stack(gradients).mean(0)
    norm = torch.nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT)
    means = {name: float(np.mean([terms[name] for _, terms in results])) for name in results[0][1]}
    if not math.isfinite(means["loss"] + norm.item()):  # before the step, so that no such weights are ever saved
        raise ModelError(
            f"the loss is {means['loss']} and its gradient {norm.item()} after {run.position.patches:,} normals; "
            f"lower --learning-rate (what is saved in {run.folder} is sound)"
        )
    run.optimizer.step()
    return means


def _predict(network: CloudFit, crop: Crop) -> tuple[Encoding, CloudPrediction]:
    encoding = network.encode(build_pyramid(crop.points, len(network.config.channels), threads=1))
    return encoding, network.fit(encoding, torch.arange(crop.inner))


def loss_terms(encoding: Encoding, prediction: CloudPrediction, normals: Tensor, inner: int) -> dict[str, Tensor]:
    """The terms of the loss of a crop and their weighted sum, "loss".

    Each compares directions by the root mean square over the crop, as the measure of the field does over a cloud.
    """
    true = normals[:inner]
    terms = {"refined": _rms(prediction.refined, true), "rough": _rms(prediction.rough, true)}
    inside = [(found[origin < inner], true[origin[origin < inner]]) for found, origin in encoding.directions]
    errors = [_rms(found, theirs) for found, theirs in inside if len(found)]  # a coarse level may have none there
    terms["z_direction"] = _rms(prediction.direction, true)
    terms["votes"] = torch.stack(errors).mean()
    with torch.no_grad():
        good = (_square(prediction.refined, true) < 2 * (1 - math.cos(SURE))).float()
    terms["confidence"] = F.binary_cross_entropy_with_logits(prediction.confidence, good)
    terms["loss"] = (
        terms["refined"]
        + 0.5 * terms["rough"]
        + 0.5 * terms["z_direction"]
        + terms["votes"]
        + 0.1 * terms["confidence"]
    )
    return terms


def _square(estimated: Tensor, true: Tensor) -> Tensor:
    """(N,) squared chord between two directions: the squared angle, for small ones."""
    return 2 * (1 - (estimated * true).sum(1).abs()).clamp_min(0)


def _rms(estimated: Tensor, true: Tensor) -> Tensor:
    return (_square(estimated, true).mean() + FLOOR**2).sqrt()


def _held_out(source: DataSource, options: CloudTrainOptions) -> list[Crop]:
    """Two crops from each held-out cloud of a source."""
    crops = []
    for number in range(source.clouds_per_epoch):
        cloud = source.cloud(HELD_OUT_EPOCH, number, options.seed)
        crops += draw_crops(cloud, options.crop_points, 2, np.random.default_rng([options.seed, number]))
    return crops


def validate(network: CloudFit, crops: list[Crop], pool: ThreadPoolExecutor) -> dict[str, float]:
    """Means over the crops of the RMSE in degrees of the refined, the rough and the z-direction normals."""

    @torch.inference_mode()
    def errors(crop: Crop) -> list[float]:
        _, prediction = _predict(network, crop)
        directions = (prediction.refined, prediction.rough, prediction.direction)
        return [rmse(angles(normals.numpy(), crop.normals[: crop.inner])) for normals in directions]

    means = np.mean(list(pool.map(errors, crops)), axis=0)
    return dict(zip(("rmse", "rmse_rough", "rmse_z"), map(float, means), strict=True))
