"""PatchFit: transform, weights, jet, correction (Du et al., CVPR 2023, fig. 3), assembled from a configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from torch import Tensor, nn

from jetnormal.geometry.jet import MAX_ORDER, Jet, fit_jet
from jetnormal.networks.patchfit.adafit import AdaFit
from jetnormal.networks.patchfit.correction import NormalError
from jetnormal.networks.patchfit.deepfit import DeepFit
from jetnormal.networks.patchfit.graphfit import GraphFit
from jetnormal.networks.patchfit.layers import PointLayer, full_precision
from jetnormal.networks.patchfit.ztransform import QSTN, ZTransform, rotation_to_z
from jetnormal.support.options import Option

MAX_WIDTH = 16  # times the published channels


@dataclass(frozen=True)
class PatchFitConfig:
    """Configuration of a PatchFit network.

    Raises:
        ValueError: if a number is out of range.
    """

    weights: Annotated[
        Literal["deepfit", "adafit", "graphfit"], Option("Network that weighs the points: deepfit, adafit or graphfit.")
    ] = "deepfit"
    neighbors: Annotated[int, Option("Points of a patch.")] = 256
    order: Annotated[int, Option("Order of the jet, 1 to 4.")] = 3
    transform: Annotated[
        Literal["ztransform", "qstn"],
        Option("How a patch is turned first: ztransform (the paper's z-direction transform) or qstn (the baselines')."),
    ] = "ztransform"
    correction: Annotated[bool, Option("Whether the paper's normal error estimation follows the fit.")] = True
    width: Annotated[float, Option("Factor on all numbers of channels; 1 is as published.")] = 1.0
    transform_width: Annotated[
        float | None, Option("The same factor for the transform alone.", default="that of width")
    ] = None
    feature_transform: Annotated[
        bool, Option("Whether the network that weighs the points has PointNet's feature transform.")
    ] = True
    light: Annotated[bool, Option("Whether the z-direction transform looks at every second point only.")] = False
    offsets: Annotated[
        bool,
        Option("Whether the points are also moved before the fit; deepfit with offsets is the single-scale AdaFit."),
    ] = False

    def __post_init__(self) -> None:
        if self.neighbors < 3:
            raise ValueError(f"a patch has 3 points or more, not {self.neighbors}")
        if not 1 <= self.order <= MAX_ORDER:
            raise ValueError(f"the order of a jet is 1 to {MAX_ORDER}, not {self.order}")
        for width in (self.width, 1.0 if self.transform_width is None else self.transform_width):
            if not 0 < width <= MAX_WIDTH:
                raise ValueError(f"the width of a network is a positive number up to {MAX_WIDTH}, not {width}")


_PAPER = {  # as published, with both of the paper's additions
    "deepfit": PatchFitConfig(),
    "adafit": PatchFitConfig("adafit", neighbors=700, offsets=True),
    "graphfit": PatchFitConfig("graphfit", neighbors=500, offsets=True),
}


def _small(config: PatchFitConfig) -> PatchFitConfig:
    return replace(config, width=0.5, transform_width=0.25, feature_transform=False, light=True)


CONFIGS = {
    "paper": _PAPER,
    # Two CPU cores train these in hours. GraphFit has half of its points, because its edges cost most.
    "small": {
        "deepfit": _small(_PAPER["deepfit"]),
        "adafit": _small(_PAPER["adafit"]),
        "graphfit": replace(_small(_PAPER["graphfit"]), neighbors=256),
    },
}


@dataclass(frozen=True)
class PatchPrediction:
    """The output of the network for B patches. Normals are unit vectors in the patch frame, of arbitrary sign.

    Attributes:
        rotation: (B, 3, 3) z-direction transform, `points @ rotation` has the normal near z.
        weights: (B, m) of the m nearest points, those that are fitted.
        jet: the fit, in the rotated frame.
        rough: (B, 3) normals of the fit.
        refined: (B, 3) corrected normals; `rough` itself without a correction.
        rough_neighbors, refined_neighbors: (B, m, 3) normals at the fitted points, if asked for.
        feature_transform: (B, F, F) matrices or None.
        offsets: (B, m, 3) by which the fitted points were moved, in the rotated frame, or None.
    """

    rotation: Tensor
    weights: Tensor
    jet: Jet
    rough: Tensor
    refined: Tensor
    rough_neighbors: Tensor | None
    refined_neighbors: Tensor | None
    feature_transform: Tensor | None
    offsets: Tensor | None


PREDICTORS: dict[str, type[DeepFit | AdaFit | GraphFit]] = {"deepfit": DeepFit, "adafit": AdaFit, "graphfit": GraphFit}


class PatchFit(nn.Module):
    """A patch network: rotate the patch, weigh its points, fit a jet, correct its normal."""

    architecture = "patchfit"  # in model files

    def __init__(self, config: PatchFitConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width if config.transform_width is None else config.transform_width
        transforms = {"ztransform": lambda: ZTransform(width, config.light), "qstn": lambda: QSTN(width)}
        self.transform = transforms[config.transform]()
        predictor = PREDICTORS[config.weights]
        self.weights = predictor(config.width, config.feature_transform, config.offsets)
        self.correction = NormalError(self.weights.channels) if config.correction else None

    def forward(self, points: Tensor, iterations: int = 1, neighbors: bool = False) -> PatchPrediction:
        """Predict the normals of patches.

        Args:
            points: (B, k, 3) patches in their own frame (`geometry.patches`).
            iterations: number of fits. From the second on, the normal found so far replaces the learned transform: the
                patch is rotated until this normal is z, and weights, fit and correction run again (the paper's
                iterative estimation).
            neighbors: whether to predict the neighbors' normals too, for training.
        """
        prediction = self._fit(points, self.transform(points), neighbors)
        for _ in range(iterations - 1):
            prediction = self._fit(points, rotation_to_z(prediction.refined), neighbors)
        return prediction

    def _fit(self, points: Tensor, rotation: Tensor, neighbors: bool) -> PatchPrediction:
        with full_precision(points):
            turned = points @ rotation
        weighting = self.weights(turned)
        fitted = turned[:, : weighting.weights.shape[1]]
        if weighting.offsets is not None:
            fitted = fitted + weighting.offsets
        with full_precision(points):
            jet = fit_jet(fitted, weighting.weights, self.config.order)
        normal = jet.normal
        rough = refined = _turned_back(normal[:, None], rotation)[:, 0]
        rough_neighbors = refined_neighbors = None
        if neighbors:
            at_neighbors = jet.normals_at(fitted[..., :2])
            rough_neighbors = refined_neighbors = _turned_back(at_neighbors, rotation)
        if self.correction is not None:
            corrected = self.correction(weighting.features, normal)
            refined = _turned_back(corrected[:, None], rotation)[:, 0]
            if neighbors:
                corrected = self.correction.neighbors(weighting.features, at_neighbors)
                refined_neighbors = _turned_back(corrected, rotation)
        return PatchPrediction(
            rotation=rotation,
            weights=weighting.weights,
            jet=jet,
            rough=rough,
            refined=refined,
            rough_neighbors=rough_neighbors,
            refined_neighbors=refined_neighbors,
            feature_transform=weighting.feature_transform,
            offsets=weighting.offsets,
        )

    def for_inference(self) -> PatchFit:
        """Fold the batch normalization into the linear maps; return the network itself, not to be saved again."""
        self.eval().requires_grad_(False)
        for module in self.modules():
            if isinstance(module, PointLayer):
                module.fold()
        return self


def _turned_back(normals: Tensor, rotation: Tensor) -> Tensor:
    """Rotate normals (B, n, 3) back from the rotated frame into the patch frame."""
    with full_precision(rotation):
        return normals @ rotation.transpose(1, 2)


def parameter_count(module: nn.Module) -> int:
    """Count the trainable values."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)
