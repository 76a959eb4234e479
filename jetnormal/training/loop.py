"""The training loop: Adam over batches of patches, resumable at any step."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from jetnormal.data.sources import DataSource
from jetnormal.errors import ModelError, UsageError
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig, parameter_count
from jetnormal.support.report import logger
from jetnormal.training.batches import Batch, PatchSampler, labeled_patches
from jetnormal.training.epochs import HELD_OUT_EPOCH, MAX_GRADIENT, train_epochs
from jetnormal.training.losses import LossWeights, total_loss
from jetnormal.training.run import Run

DROPS = (300 / 700, 550 / 700)  # the paper's schedule: a tenth of the rate after these shares of the epochs
VALIDATION_QUERIES = 250  # per cloud


@dataclass(frozen=True)
class TrainOptions:
    """How to train; the defaults are the paper's.

    Attributes:
        epochs: passes over `patches_per_cloud` patches of each cloud.
        batch_size: patches in a batch.
        learning_rate: Adam's, at the start.
        schedule: "step" (the paper's: a tenth after 300/700 and 550/700 of the epochs) or "cosine" (to zero).
        patches_per_cloud: queries drawn from each cloud in an epoch.
        seed: of the data, their order and the initial weights.
        device: "cpu", "cuda" or "cuda:N".
        bfloat16: whether matrix products run in bfloat16 (the jet never does).
        losses: factors of the loss terms.
        data: name of the data, for the record.
        initial: name or file of a model whose weights to start from; empty starts from random ones.
    """

    epochs: int = 700
    batch_size: int = 256
    learning_rate: float = 1e-3
    schedule: str = "step"
    patches_per_cloud: int = 1000
    seed: int = 1
    device: str = "cpu"
    bfloat16: bool = False
    losses: LossWeights = dataclasses.field(default_factory=LossWeights)
    data: str = ""
    initial: str = ""


def train(
    config: PatchFitConfig,
    source: DataSource,
    folder: Path,
    options: TrainOptions,
    *,
    validation: DataSource | None = None,
    resume: bool = False,
    tensorboard: bool = False,
) -> dict[str, Any]:
    """Trains a network and leaves it in a folder (see `training.run`).

    The same arguments give the same network, interrupted and resumed or not, on the same machine with the same
    number of threads.

    Args:
        config: of the network.
        source: of the training clouds.
        folder: of the run.
        options: how to train.
        validation: clouds to validate on after each epoch; None takes held-out clouds of `source`.
        resume: whether to go on from the last saved state in `folder`.
        tensorboard: whether to write the metrics as TensorBoard events, too.

    Returns:
        model (the file), parameters, and of the last epoch: epoch, patches, seconds, loss terms and validation errors.

    Raises:
        InputError: if the folder holds another run, or nothing to resume, or a cloud cannot be used.
        UsageError: if the run to resume began with other options, an epoch has less than one batch, or TensorBoard
            is asked for and not installed.
        ModelError: if the loss or its gradient is no longer a number, or `options.initial` cannot be started from.
    """
    torch.manual_seed(options.seed)
    network = PatchFit(config).to(options.device)
    optimizer = torch.optim.Adam(network.parameters(), lr=options.learning_rate, weight_decay=1e-7)
    facts = {"config": dataclasses.asdict(config), "options": dataclasses.asdict(options)}
    del facts["options"]["device"]  # a run may move to another machine
    run = Run(folder, json.loads(json.dumps(facts)), network, optimizer, tensorboard)
    sampler = PatchSampler(source, config.neighbors, options.patches_per_cloud, options.batch_size, options.seed)
    if sampler.batches_per_epoch == 0:
        raise UsageError("an epoch has fewer patches than a batch: lower --batch-size or train on more clouds")
    if resume:
        run.resume()
    else:
        run.begin(options.initial)
    held_out = _validation_batches(validation or source, config.neighbors, options.seed)
    logger.info("training %s parameters", f"{parameter_count(network):,}")

    def step(batch: Batch, share: float) -> dict[str, float]:
        return _step(run, batch, learning_rate(share, options), options)

    row = train_epochs(
        run, sampler, options.epochs, step, lambda: validate(network, held_out), samples=lambda _: options.batch_size,
        unit="patches", units=options.batch_size,
    )  # fmt: skip
    return {"model": str(run.model_path), "parameters": parameter_count(network)} | row


def _step(run: Run, batch: Batch, rate: float, options: TrainOptions) -> dict[str, float]:
    """One step of the optimizer; the values of the loss terms before it."""
    for group in run.optimizer.param_groups:
        group["lr"] = rate
    points, normals = batch.points.to(options.device), batch.normals.to(options.device)
    with torch.autocast(points.device.type, torch.bfloat16, enabled=options.bfloat16):
        prediction = run.network(points, neighbors=True)
    terms = total_loss(prediction, normals, options.losses)
    run.optimizer.zero_grad(set_to_none=True)
    terms["loss"].backward()
    slope = torch.nn.utils.clip_grad_norm_(run.network.parameters(), MAX_GRADIENT)
    if not torch.isfinite(terms["loss"] + slope):  # before the step, so that no such weights are ever saved
        raise ModelError(
            f"the loss is {terms['loss'].item()} and its gradient {slope.item()} after {run.position.patches:,} "
            f"patches; lower --learning-rate (what is saved in {run.folder} is sound)"
        )
    run.optimizer.step()
    return {name: value.item() for name, value in terms.items()}


def learning_rate(share: float, options: TrainOptions) -> float:
    """The rate after a share, in [0, 1), of the training."""
    if options.schedule == "cosine":
        return options.learning_rate * (1 + math.cos(math.pi * share)) / 2
    return options.learning_rate * 0.1 ** sum(share >= drop for drop in DROPS)


def validate(network: PatchFit, batches: list[Batch]) -> dict[str, float]:
    """RMSE in degrees of the refined, the rough and the z-direction normals over all patches."""
    device = next(network.parameters()).device
    found: dict[str, list[np.ndarray]] = {"rmse": [], "rmse_rough": [], "rmse_z": []}
    network.eval()
    with torch.inference_mode():
        for batch in batches:
            prediction = network(batch.points.to(device))
            true = batch.normals[:, 0].numpy()
            directions = (prediction.refined, prediction.rough, prediction.rotation[:, :, 2])
            for errors, normals in zip(found.values(), directions, strict=True):
                errors.append(angles(normals.cpu().numpy(), true))
    return {name: rmse(np.concatenate(errors)) for name, errors in found.items()}


def _validation_batches(source: DataSource, neighbors: int, seed: int) -> list[Batch]:
    """One batch of patches from each held-out cloud of a source."""
    batches = []
    for number in range(source.clouds_per_epoch):
        cloud = source.cloud(HELD_OUT_EPOCH, number, seed)
        candidates = np.arange(len(cloud.points)) if cloud.queries is None else cloud.queries
        rng = np.random.default_rng([seed, number])
        queries = rng.choice(candidates, min(VALIDATION_QUERIES, len(candidates)), replace=False)
        batches.append(labeled_patches(cloud, NeighborIndex(cloud.points), queries, neighbors))
    return batches
