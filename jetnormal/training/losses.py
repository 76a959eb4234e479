"""The paper's losses (Du et al., CVPR 2023, eqs. 7, 11 and 12), each a mean over the batch.

Normals have no sign here: the sine of the angle between two directions is the same for n and -n.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from jetnormal.networks.patchfit.network import PatchFitConfig, PatchPrediction


@dataclass(frozen=True)
class LossWeights:
    """Factors of the terms of the training loss; the first three are the paper's lambda 1, 2 and 3.

    Attributes:
        consistency: of the neighbors' normals.
        regularisation: of the feature transform.
        z_direction: of the z-direction transform; the baselines have no such loss.
        sparsity: of -log w inside the consistency term, which keeps the weights from vanishing (DeepFit).
        offsets: of the squared offsets of the points (AdaFit).
    """

    consistency: float = 0.25
    regularisation: float = 0.1
    z_direction: float = 2.0
    sparsity: float = 0.2
    offsets: float = 0.1


def published_losses(config: PatchFitConfig) -> LossWeights:
    """The factors that a configuration was published with: without the paper's transform there is no loss on its z."""
    return LossWeights() if config.transform == "ztransform" else LossWeights(z_direction=0.0)


def sine(estimated: Tensor, true: Tensor) -> Tensor:
    """|a x b| of (..., 3) unit vectors: the sine of the angle between two directions, (...)."""
    return torch.linalg.cross(estimated, true).square().sum(-1).clamp_min(1e-16).sqrt()


def normal_loss(prediction: PatchPrediction, normals: Tensor) -> Tensor:
    """L_normal: the sine of the rough plus that of the refined normal, if there is one, against (B, 3) true normals."""
    sines = sine(prediction.rough, normals)
    if prediction.refined is not prediction.rough:
        sines = sines + sine(prediction.refined, normals)
    return sines.mean()


def consistency_loss(prediction: PatchPrediction, neighbor_normals: Tensor, sparsity: float) -> Tensor:
    """L_con: weighted sines of the jet's and the refined normals at the (B, m, 3) neighbors, minus the mean log weight.

    A point whose normal the fit does not explain loses weight; the logarithm forbids the empty explanation.
    """
    assert prediction.rough_neighbors is not None and prediction.refined_neighbors is not None
    sines = sine(prediction.rough_neighbors, neighbor_normals) + sine(prediction.refined_neighbors, neighbor_normals)
    return (prediction.weights * sines).mean() / 2 - sparsity * prediction.weights.log().mean()


def orthogonality_loss(matrices: Tensor) -> Tensor:
    """L_reg: mean squared entry of T T^T - I of (B, C, C) matrices."""
    identity = torch.eye(matrices.shape[1], device=matrices.device)
    return (matrices @ matrices.transpose(1, 2) - identity).square().mean()


def z_direction_loss(rotation: Tensor, normals: Tensor) -> Tensor:
    """L_trans: |n T x z|, the sine between z and the turned true normal (eq. 7)."""
    turned = (normals[:, None] @ rotation)[:, 0]
    return turned[:, :2].square().sum(1).clamp_min(1e-16).sqrt().mean()


def total_loss(prediction: PatchPrediction, neighbor_normals: Tensor, factors: LossWeights) -> dict[str, Tensor]:
    """All terms and their weighted sum, "loss" (eq. 12).

    Args:
        prediction: of a batch, with the neighbors' normals.
        neighbor_normals: (B, k, 3) true normals in the patch frame; index 0 is the query. Those of points that are
            not fitted do not matter.
        factors: of the terms.
    """
    normals = neighbor_normals[:, 0]
    neighbor_normals = neighbor_normals[:, : prediction.weights.shape[1]]
    terms = {
        "normal": normal_loss(prediction, normals),
        "consistency": consistency_loss(prediction, neighbor_normals, factors.sparsity),
        "z_direction": z_direction_loss(prediction.rotation, normals),
    }
    loss = terms["normal"] + factors.consistency * terms["consistency"] + factors.z_direction * terms["z_direction"]
    if prediction.feature_transform is not None:
        terms["regularisation"] = orthogonality_loss(prediction.feature_transform)
        loss = loss + factors.regularisation * terms["regularisation"]
    if prediction.offsets is not None:
        terms["offsets"] = prediction.offsets.square().mean()
        loss = loss + factors.offsets * terms["offsets"]
    return terms | {"loss": loss}
