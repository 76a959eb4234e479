"""Start and resume trainings by their recipes."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import torch

from jetnormal.data.dataset import open_dataset
from jetnormal.data.sources import VALIDATION_LIST, DataSource
from jetnormal.errors import InputError
from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.support.report import logger
from jetnormal.training.families import family
from jetnormal.training.optimizers import make_optimizer
from jetnormal.training.options import DataOptions
from jetnormal.training.recipe import Recipe, read_recipe, recipe_text
from jetnormal.training.run import CONFIG_NAME, SAVE_INTERVAL, Run
from jetnormal.training.trainer import Trainer


def train(
    recipe: Recipe,
    folder: Path,
    *,
    resume: bool = False,
    device: str = "auto",
    threads: int | None = None,
    tensorboard: bool = False,
    save_interval: float = SAVE_INTERVAL,
    source: DataSource | None = None,
    validation: DataSource | None = None,
) -> dict[str, Any]:
    """Train a network and leave it in a folder (`training.run`).

    The same recipe gives the same network, interrupted and resumed or not, on the same machine with the same number of
    threads.

    Args:
        recipe: of the network, the data and the training.
        folder: of the run.
        resume: whether to go on from the last saved state in `folder`. The recipe may then have more epochs; the
            schedule of the rate is that of all of them.
        device: "auto", "cpu", "cuda" or "cuda:N".
        threads: CPU threads; None for all cores.
        tensorboard: whether to write the metrics as TensorBoard events, too.
        save_interval: seconds from one save to the next within an epoch.
        source: training clouds instead of those that the recipe names.
        validation: clouds to validate on instead of those that the recipe names.

    Returns:
        model (the file), parameters, and of the last epoch: epoch, samples, seconds, loss terms and validation errors.

    Raises:
        InputError: the folder holds another run, or nothing to resume, or another process trains in it, or a cloud
            cannot be used.
        UsageError: the run to resume began with other options or has more epochs already, or an epoch has less than one
            batch.
        ModelError: the loss, its gradient or the weights are no longer finite, or `initial` cannot be started from.
        ResourceError: the device is not there, PyTorch lacks the optimizer, or TensorBoard is asked for and not
            installed.
    """
    options, located = recipe.training, _located(recipe)
    config = recipe_text(located)
    torch.manual_seed(options.seed)
    source = source or open_training(located.data)
    validation = validation or open_validation(located.data)
    prepare = family(recipe.family).task
    with prepare(recipe.network, options, recipe.losses, device, threads) as task:
        network, parameters = task.network, parameter_count(task.network)
        optimizer = make_optimizer(network, options)
        run = Run(folder, recipe.facts(), network, optimizer, options.average, tensorboard, save_interval)
        trainer = Trainer(task, run, options, source, validation)
        with run:
            if resume:
                run.resume(config, options.epochs)
            else:
                run.begin(config, options.initial)
            logger.info("training %s parameters", f"{parameters:,}")
            record = trainer.train()
    return {"model": str(run.model_path), "parameters": parameters} | record


def recipe_of_run(folder: Path) -> Recipe:
    """Read the recipe of a run.

    Raises:
        InputError: there is no run in the folder.
        UsageError: the recipe does not fit this version of jetnormal.
    """
    path = folder / CONFIG_NAME
    if not path.is_file():
        raise InputError(f"{folder}: there is no run to resume; start one")
    return read_recipe(str(path))


def open_training(data: DataOptions) -> DataSource:
    """Open the training clouds; errors as `data.dataset.open_dataset`."""
    return open_dataset(
        data.folders,
        synthetic=data.synthetic,
        scans=data.scans,
        list_file=data.list_file,
        weights=data.weights,
        clouds_per_epoch=data.clouds_per_epoch,
        points=data.points_per_cloud,
        relief=data.relief,
    )


def open_validation(data: DataOptions) -> DataSource | None:
    """Open the clouds to validate on; None if there are none of their own."""
    folder = data.validation or next((name for name in data.folders if (Path(name) / VALIDATION_LIST).is_file()), None)
    if folder is None:
        return None
    return open_dataset(
        [folder],
        list_file=data.validation_list,
        default_list=VALIDATION_LIST,
        clouds_per_epoch=data.clouds_per_epoch,
        points=data.points_per_cloud,
    )


def _located(recipe: Recipe) -> Recipe:
    """The recipe with the whole paths of its folders, so that the run can be resumed from anywhere."""
    data = recipe.data
    folders = tuple(os.path.realpath(folder) for folder in data.folders)
    validation = data.validation and os.path.realpath(data.validation)
    return dataclasses.replace(recipe, data=dataclasses.replace(data, folders=folders, validation=validation))
