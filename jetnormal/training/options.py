"""Options of a training; the defaults are those of the paper's patch networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from jetnormal.support.options import Option, OptionSet

CLOUDS_PER_EPOCH = 24
POINTS_PER_CLOUD = 100_000


def parse_numbers(text: str) -> tuple[float, ...]:
    """Turn "20,2,8" into numbers.

    Raises:
        ValueError: it is something else.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{text!r} is not W,W,...: one number per source") from None


@dataclass(frozen=True)
class DataOptions(OptionSet):
    """Where the training clouds come from."""

    folders: Annotated[
        tuple[str, ...],
        Option(
            "PCPNet clouds or meshes (.ply .obj .off .stl .npz); repeat it to mix.",
            names=("--data", "-d"),
            metavar="DIR",
            group="Data",
        ),
    ] = ()
    synthetic: Annotated[bool, Option("Train on procedural solids, too.", group="Data")] = False
    scans: Annotated[
        bool, Option("Train on scans of the meshes and of solids by virtual scanners, too.", group="Data")
    ] = False
    weights: Annotated[
        tuple[float, ...] | None,
        Option(
            "Shares of the sources: of each folder in turn, then of the solids, then of the scans.",
            metavar="W,W,...",
            default="their clouds per epoch",
            parse=parse_numbers,
            group="Data",
        ),
    ] = None
    relief: Annotated[
        float,
        Option("Share of the clouds of meshes, solids and scans that get a fine relief.", low=0, high=1, flag=False),
    ] = 0.0
    list_file: Annotated[
        str | None,
        Option(
            "List of the training clouds in a PCPNet folder.",
            default="trainingset_whitenoise.txt, else all clouds, with noise added",
            flag=False,
        ),
    ] = None
    validation: Annotated[
        str | None,
        Option(
            "Clouds or meshes to validate on.",
            metavar="DIR",
            default="the first folder with a validation list, else held-out clouds",
            group="Data",
        ),
    ] = None
    validation_list: Annotated[
        str | None,
        Option("List of the validation clouds.", default="validationset_whitenoise.txt, else all", flag=False),
    ] = None
    clouds_per_epoch: Annotated[
        int, Option("Clouds that a folder of meshes, the solids, and the scans give in an epoch.", low=1, flag=False)
    ] = CLOUDS_PER_EPOCH
    points_per_cloud: Annotated[
        int, Option("Largest number of points drawn from a mesh or a solid.", low=1, flag=False)
    ] = POINTS_PER_CLOUD


@dataclass(frozen=True)
class TrainOptions(OptionSet):
    """How any network is trained."""

    epochs: Annotated[int, Option("Passes over the data.", low=1, metavar="N", group="Training")] = 700
    seed: Annotated[
        int,
        Option(
            "Of the data, their order and the initial weights.", low=0, high=2**32 - 1, metavar="S", group="Training"
        ),
    ] = 1
    initial: Annotated[
        str,
        Option(
            "Model to start from, as far as its weights fit.", metavar="NAME|FILE", default="none", group="Training"
        ),
    ] = ""
    validate_every: Annotated[
        int, Option("Epochs from one validation to the next.", low=1, metavar="N", group="Training")
    ] = 1
    batch_size: Annotated[int, Option("Patches, or crops, in a step.", low=1, flag=False)] = 256
    optimizer: Annotated[
        Literal["adam", "adamw", "sgd"],
        Option(
            "Adam; AdamW, whose weight decay is no part of the gradient; or descent with a momentum of 0.9.", flag=False
        ),
    ] = "adam"
    learning_rate: Annotated[float, Option("Of the optimizer, at its highest.", low=0, high=1000, flag=False)] = 1e-3
    weight_decay: Annotated[float, Option("Of the optimizer.", low=0, flag=False)] = 1e-7
    schedule: Annotated[
        Literal["step", "cosine", "warm-cosine", "constant"],
        Option(
            "Of the rate: a tenth after 3/7 and 11/14 of the epochs, a cosine to 0, the cosine after a short rise, "
            "or none.",
            flag=False,
        ),
    ] = "step"
    average: Annotated[
        float,
        Option(
            "Decay, per step, of the exponential moving average of the weights, which is then validated and saved; "
            "0 for the weights themselves.",
            low=0,
            high=0.99999,
            flag=False,
        ),
    ] = 0.0


@dataclass(frozen=True)
class PatchTraining(TrainOptions):
    """How a patch network is trained; the defaults are the paper's."""

    patches_per_cloud: Annotated[int, Option("Patches of each cloud in an epoch.", low=1, flag=False)] = 1000
    validation_patches: Annotated[int, Option("Patches of a cloud to validate on.", low=1, flag=False)] = 250
    bfloat16: Annotated[bool, Option("Multiply matrices in bfloat16, but never in the fit: faster.", flag=False)] = (
        False
    )


@dataclass(frozen=True)
class CloudTraining(TrainOptions):
    """How CloudFit is trained; what made the packaged weights is the recipe `cloudfit`."""

    crop_points: Annotated[
        int, Option("Points of a crop, about half of which are learned from.", low=64, flag=False)
    ] = 8000
    crops_per_cloud: Annotated[int, Option("Crops of each cloud in an epoch.", low=1, flag=False)] = 12


@dataclass(frozen=True)
class IterTraining(TrainOptions):
    """How IterNet is trained; the recipe `iternet` goes on from the packaged weights."""

    crop_points: Annotated[int, Option("Points of a crop, half of which are learned from.", low=64, flag=False)] = 1000
    crops_per_cloud: Annotated[int, Option("Crops of each cloud in an epoch.", low=1, flag=False)] = 24
    bfloat16: Annotated[bool, Option("Multiply matrices in bfloat16, but never in the fit: faster.", flag=False)] = (
        False
    )


@dataclass(frozen=True)
class LossWeights(OptionSet):
    """Factors of the terms of a patch network's loss; the first three are the paper's lambda 1, 2 and 3."""

    consistency: Annotated[float, Option("Of the neighbors' normals.", low=0, flag=False)] = 0.25
    regularisation: Annotated[float, Option("Of the feature transform.", low=0, flag=False)] = 0.1
    z_direction: Annotated[
        float, Option("Of the z-direction transform; the published baselines have 0.", low=0, flag=False)
    ] = 2.0
    sparsity: Annotated[
        float,
        Option("Of -log w inside the consistency term, which keeps all weights from going to zero.", low=0, flag=False),
    ] = 0.2
    offsets: Annotated[float, Option("Of the squared offsets of the points (AdaFit).", low=0, flag=False)] = 0.1
