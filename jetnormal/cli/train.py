"""`jetnormal train`: a network from clouds with known normals, from meshes, or from procedural solids."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from jetnormal.cli.options import Device, Json, Quiet, Threads, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.support.report import logger, print_json

# What only patch networks, or only cloudfit, have; any other choice of model refuses them.
PATCH_OPTIONS = (
    "config", "neighbors", "transform", "no_correction", "offsets", "width", "transform_width", "patches_per_cloud",
    "schedule", "lambda_z", "lambda_consistency", "lambda_sparsity", "lambda_regularisation", "lambda_offsets",
    "bfloat16",
)  # fmt: skip
CLOUD_OPTIONS = ("crop_points", "crops_per_cloud")


def parse_weights(text: str) -> list[float]:
    """Turn "20,2,8" into numbers."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not W,W,...: one number per source") from None


def train(
    context: typer.Context,
    data: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR", help="PCPNet clouds or meshes (.ply .obj .off .stl .npz); repeat it to mix."),
    ] = None,
    synthetic: Annotated[bool, typer.Option("--synthetic", help="Train on procedural solids, too.")] = False,
    weights: Annotated[
        Any,
        typer.Option(
            parser=parse_weights,
            metavar="W,W,...",
            help="Shares of the sources: of each --data in turn, then of --synthetic.",
            show_default="their clouds per epoch",
        ),
    ] = None,
    list_file: Annotated[
        str | None,
        typer.Option(
            "--list",
            metavar="FILE",
            help="List of the training clouds in a PCPNet folder.",
            show_default="trainingset_whitenoise.txt, else all, with noise added",
        ),
    ] = None,
    validation: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Clouds or meshes to validate on.", show_default="from --data, else held out"),
    ] = None,
    validation_list: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="List of the validation clouds.", show_default="validationset_whitenoise.txt, else all"
        ),
    ] = None,
    clouds_per_epoch: Annotated[
        int, typer.Option(min=1, metavar="N", help="Clouds drawn from a folder of meshes, and solids, in an epoch.")
    ] = 24,
    points_per_cloud: Annotated[
        int, typer.Option(min=1, metavar="N", help="Largest number of points drawn from a mesh or a solid.")
    ] = 100_000,
    model: Annotated[
        Literal["deepfit", "adafit", "graphfit", "cloudfit"],
        typer.Option(help="Weight predictor of a patch network, or the whole-cloud network."),
    ] = "deepfit",
    config: Annotated[
        Literal["paper", "small"], typer.Option(help="Network to start from: as published, or for a CPU.")
    ] = "paper",
    neighbors: Annotated[
        int | None, typer.Option(min=16, metavar="K", help="Points in a patch.", show_default="the configuration's")
    ] = None,
    order: Annotated[
        int | None,
        typer.Option(min=1, max=4, metavar="N", help="Order of the fitted jet.", show_default="the configuration's"),
    ] = None,
    transform: Annotated[
        Literal["ztransform", "qstn"] | None,
        typer.Option(help="The paper's z-direction transform, or DeepFit's.", show_default="the configuration's"),
    ] = None,
    no_correction: Annotated[
        bool, typer.Option("--no-correction", help="Leave the normal error estimation out.")
    ] = False,
    offsets: Annotated[
        bool | None,
        typer.Option("--offsets/--no-offsets", help="Move the points, too.", show_default="yes, but for deepfit"),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(min=0.0625, metavar="F", help="Factor on the channels.", show_default="the configuration's"),
    ] = None,
    transform_width: Annotated[
        float | None,
        typer.Option(min=0.0625, metavar="F", help="Factor on the transform's.", show_default="the configuration's"),
    ] = None,
    epochs: Annotated[
        int, typer.Option(min=1, metavar="N", help="Passes over the data.", show_default="700, or 30 for cloudfit")
    ] = 700,
    patches_per_cloud: Annotated[
        int, typer.Option(min=1, metavar="N", help="Patches of each cloud in an epoch.")
    ] = 1000,
    crop_points: Annotated[
        int, typer.Option(min=64, metavar="N", help="Points of a crop; half of them are learned from (cloudfit).")
    ] = 8000,
    crops_per_cloud: Annotated[
        int, typer.Option(min=1, metavar="N", help="Crops of each cloud in an epoch (cloudfit).")
    ] = 12,
    batch_size: Annotated[
        int,
        typer.Option(
            min=1, metavar="B", help="Patches or crops per step.", show_default="256, or 2 crops for cloudfit"
        ),
    ] = 256,
    learning_rate: Annotated[
        float,
        typer.Option(min=0, metavar="R", help="Of Adam, at its highest.", show_default="0.001, or 0.002 for cloudfit"),
    ] = 1e-3,
    schedule: Annotated[
        Literal["step", "cosine"], typer.Option(help="A tenth after 3/7 and 11/14 of the epochs, or a cosine to 0.")
    ] = "step",
    lambda_z: Annotated[
        float | None,
        typer.Option(min=0, metavar="F", help="Factor of the z-direction loss.", show_default="2, or 0 for qstn"),
    ] = None,
    lambda_consistency: Annotated[float, typer.Option(min=0, metavar="F", help="Of the neighbors' normals.")] = 0.25,
    lambda_sparsity: Annotated[float, typer.Option(min=0, metavar="F", help="Of -log w, times the one before.")] = 0.2,
    lambda_regularisation: Annotated[float, typer.Option(min=0, metavar="F", help="Of the feature transform.")] = 0.1,
    lambda_offsets: Annotated[float, typer.Option(min=0, metavar="F", help="Of the squared offsets.")] = 0.1,
    bfloat16: Annotated[bool, typer.Option("--bfloat16", help="Multiply matrices in bfloat16: faster.")] = False,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Of data, order and initial weights.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="RUN", help="Folder of the run.")] = Path("run"),
    initial: Annotated[
        str,
        typer.Option(metavar="NAME|FILE", help="Model to start from, as far as its weights fit.", show_default="none"),
    ] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Also write TensorBoard events.")] = False,
    device: Device = "auto",
    threads: Threads = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Train a network; the defaults are the paper's, and for cloudfit those of the packaged weights.

    RUN gets model.safetensors, which `jetnormal estimate --model` takes, metrics.csv, and what --resume needs.
    A run is saved every 45 seconds; to go on with it, repeat its options with --resume.

    \b
    Examples:
      jetnormal train --data pcpnet -o run
      jetnormal train --data pcpnet --model graphfit --transform qstn --no-correction -o baseline
      jetnormal train --data meshes --config small --schedule cosine --epochs 50 -o run
      jetnormal train --data meshes --data pcpnet --synthetic --weights 20,2,8 --validation held_out -o run
      jetnormal train --model cloudfit --data meshes --synthetic -o run
      jetnormal train --model cloudfit --initial cloudfit --data forest --epochs 5 --learning-rate 5e-4 -o run
      jetnormal train --data pcpnet -o run --resume
    """
    set_verbosity(quiet, verbose)
    chosen = _chosen(context)
    for foreign in PATCH_OPTIONS if model == "cloudfit" else CLOUD_OPTIONS:
        if foreign in chosen:
            raise UsageError(f"--{foreign.replace('_', '-')} is no option of {model}: leave it out")
    from jetnormal.data.sources import VALIDATION_LIST, open_dataset
    from jetnormal.support.device import resolve_device, torch_threads

    open_source = partial(open_dataset, clouds_per_epoch=clouds_per_epoch, points=points_per_cloud)
    source = open_source(data or [], synthetic=synthetic, weights=weights, list_file=list_file)
    held_out = None
    validation = validation or next((folder for folder in data or [] if (folder / VALIDATION_LIST).is_file()), None)
    if validation:
        held_out = open_source([validation], list_file=validation_list, default_list=VALIDATION_LIST)
    name = " ".join([folder.resolve().name for folder in data or []] + ["synthetic"] * synthetic)
    arguments: dict[str, Any] = {"validation": held_out, "resume": resume, "tensorboard": tensorboard}
    if model == "cloudfit":
        from jetnormal.networks.cloudfit.network import CloudFitConfig
        from jetnormal.training.cloudloop import CloudTrainOptions, train_cloudfit

        if device not in ("auto", "cpu"):
            raise UsageError("cloudfit trains on the CPU: leave --device out")
        own = {field.name for field in dataclasses.fields(CloudTrainOptions)}
        cloud_options = CloudTrainOptions(
            data=name, **{key: value for key, value in chosen.items() if key in own - {"data"}}
        )
        layout = CloudFitConfig() if order is None else CloudFitConfig(order=order)
        summary = train_cloudfit(layout, source, out, cloud_options, **arguments)
    else:
        from jetnormal.networks.patchfit.network import CONFIGS
        from jetnormal.training.loop import TrainOptions, train
        from jetnormal.training.losses import LossWeights, published_losses

        if batch_size < 2:
            raise UsageError("--batch-size must be 2 or more: patch networks normalise over a batch")
        changes = {"neighbors": neighbors, "order": order, "transform": transform, "width": width, "offsets": offsets}
        changes |= {"transform_width": transform_width, "correction": False if no_correction else None}
        given: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
        network = dataclasses.replace(CONFIGS[config][model], **given)
        losses = LossWeights(
            consistency=lambda_consistency,
            regularisation=lambda_regularisation,
            z_direction=published_losses(network).z_direction if lambda_z is None else lambda_z,
            sparsity=lambda_sparsity,
            offsets=lambda_offsets,
        )
        options = TrainOptions(
            epochs=epochs,
            batch_size=batch_size,
            learning_rate=learning_rate,
            schedule=schedule,
            patches_per_cloud=patches_per_cloud,
            seed=seed,
            device=resolve_device(device),
            bfloat16=bfloat16,
            losses=losses,
            data=name,
            initial=initial,
        )
        with torch_threads(threads):
            summary = train(network, source, out, options, **arguments)
    logger.info("the network is %s", summary["model"])
    if json:
        print_json(summary)


def _chosen(context: typer.Context) -> dict[str, Any]:
    """The options on the command line, without those left at their defaults."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name: context.params[name] for name, source in sources.items() if source and source.name == "COMMANDLINE"}
