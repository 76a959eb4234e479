"""Options of a training; the defaults are those of the paper's patch networks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from jetnormal.data.options import CLOUDS_PER_EPOCH, POINTS_PER_CLOUD
from jetnormal.networks.packaged import complete_network
from jetnormal.support.options import Option, OptionSet

EXTENDABLE = ("epochs", "validate_every")  # what a resumed run may change


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
            "Folder of PCPNet clouds or of meshes (.ply .obj .off .stl .glb .gltf .npz); several are mixed.",
            names=("--data", "-d"),
            metavar="DIR",
            group="Data",
        ),
    ] = ()
    synthetic: Annotated[bool, Option("Train on procedural solids as well.", group="Data")] = False
    scans: Annotated[
        bool,
        Option("Train on scans by virtual scanners as well: of the meshes, of solids and of scenes.", group="Data"),
    ] = False
    weights: Annotated[
        tuple[float, ...] | None,
        Option(
            "Share of each source of data: the folders in their order, then the solids, then the scans.",
            metavar="W,W,...",
            default="as many clouds as each has in an epoch",
            parse=parse_numbers,
            group="Data",
        ),
    ] = None
    relief: Annotated[
        float,
        Option(
            "Share of the clouds of meshes, solids and scans that get fine bumps and grooves.",
            low=0,
            high=1,
            flag=False,
        ),
    ] = 0.0
    list_file: Annotated[
        str | None,
        Option(
            "File in a PCPNet folder that lists the training clouds.",
            default="trainingset_whitenoise.txt, else all clouds, with noise added",
            flag=False,
        ),
    ] = None
    validation: Annotated[
        str | None,
        Option(
            "Folder of clouds or meshes to validate on.",
            metavar="DIR",
            default="the first folder with a validation list, else held-out clouds",
            group="Data",
        ),
    ] = None
    validation_list: Annotated[
        str | None,
        Option(
            "File in that folder that lists the validation clouds.",
            default="validationset_whitenoise.txt, else all",
            flag=False,
        ),
    ] = None
    clouds_per_epoch: Annotated[
        int,
        Option(
            "Clouds in an epoch: from each folder of meshes, from the solids, and from the scans.", low=1, flag=False
        ),
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
            "Random seed of the data, their order and the initial weights.",
            low=0,
            high=2**32 - 1,
            metavar="S",
            group="Training",
        ),
    ] = 1
    initial: Annotated[
        str,
        Option(
            "Model to start from; the weights that fit are taken over.",
            metavar="NAME|FILE",
            default="none",
            complete=complete_network,
            group="Training",
        ),
    ] = ""
    validate_every: Annotated[int, Option("Validate after every N epochs.", low=1, metavar="N", group="Training")] = 1
    batch_size: Annotated[
        int, Option("Patches, or crops of clouds, in a step of the optimizer.", low=1, flag=False)
    ] = 256
    optimizer: Annotated[
        Literal["adam", "adamw", "muon", "sgd"],
        Option(
            "adam; adamw (decoupled weight decay); muon (for matrices, adamw for the rest); or sgd (with a momentum of "
            "0.9).",
            flag=False,
        ),
    ] = "adam"
    learning_rate: Annotated[float, Option("Highest learning rate of the schedule.", low=0, high=1000, flag=False)] = (
        1e-3
    )
    weight_decay: Annotated[float, Option("Weight decay of the optimizer.", low=0, flag=False)] = 1e-7
    schedule: Annotated[
        Literal["step", "cosine", "warm-cosine", "constant"],
        Option(
            "Learning rate over the training: step (a tenth after 3/7 and after 11/14 of the epochs), cosine (down to "
            "0), warm-cosine (a short rise first), or constant.",
            flag=False,
        ),
    ] = "step"
    average: Annotated[
        float,
        Option(
            "Decay per step of an exponential moving average of the weights. The average is what is validated and "
            "saved. 0: no average.",
            low=0,
            high=0.99999,
            flag=False,
        ),
    ] = 0.0


@dataclass(frozen=True)
class PatchTraining(TrainOptions):
    """How a patch network is trained; the defaults are the paper's."""

    patches_per_cloud: Annotated[int, Option("Patches drawn from each cloud in an epoch.", low=1, flag=False)] = 1000
    validation_patches: Annotated[int, Option("Patches of each validation cloud.", low=1, flag=False)] = 250
    bfloat16: Annotated[
        bool, Option("Multiply matrices in bfloat16, which is faster; fits stay in float32.", flag=False)
    ] = False


@dataclass(frozen=True)
class CloudTraining(TrainOptions):
    """How CloudFit is trained; what made the packaged weights is the recipe `cloudfit`."""

    crop_points: Annotated[
        int, Option("Points of a crop; the inner half is learned from, the rest is context.", low=64, flag=False)
    ] = 8000
    crops_per_cloud: Annotated[int, Option("Crops drawn from each cloud in an epoch.", low=1, flag=False)] = 12


@dataclass(frozen=True)
class IterTraining(TrainOptions):
    """How IterNet is trained; the recipe `iternet` goes on from the packaged weights."""

    crop_points: Annotated[
        int, Option("Points of a crop; the inner half is learned from, the rest is context.", low=64, flag=False)
    ] = 1000
    crops_per_cloud: Annotated[int, Option("Crops drawn from each cloud in an epoch.", low=1, flag=False)] = 24
    bfloat16: Annotated[
        bool, Option("Multiply matrices in bfloat16, which is faster; fits stay in float32.", flag=False)
    ] = False


@dataclass(frozen=True)
class LossWeights(OptionSet):
    """Factors of the terms of a patch network's loss; the first three are lambda 1, 2 and 3 of the paper."""

    consistency: Annotated[
        float,
        Option("Factor of the consistency term: the normals of the neighbors by the fitted jet.", low=0, flag=False),
    ] = 0.25
    regularization: Annotated[
        float, Option("Factor of the term that keeps the feature transform close to a rotation.", low=0, flag=False)
    ] = 0.1
    z_direction: Annotated[
        float, Option("Factor of the z-direction loss; the published baselines have 0.", low=0, flag=False)
    ] = 2.0
    sparsity: Annotated[
        float,
        Option(
            "Factor of -log w within the consistency term; it keeps all weights from going to zero.", low=0, flag=False
        ),
    ] = 0.2
    offsets: Annotated[
        float, Option("Factor of the squared offsets of the points (AdaFit, GraphFit).", low=0, flag=False)
    ] = 0.1
