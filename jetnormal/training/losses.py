"""Losses of the patch networks (Du et al., CVPR 2023, eqs. 7, 11 and 12) and of the other networks.

Normals have no sign here: what compares two directions is the same for n and -n.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from jetnormal.networks.patchfit.network import PatchPrediction
from jetnormal.training.options import LossWeights

if TYPE_CHECKING:
    from jetnormal.networks.cloudfit.network import CloudPrediction  # brings numba along

FLOOR = 0.02  # radians: what is below is good enough for CloudFit
ITERNET_FLOOR = 0.05  # radians
SURE = math.radians(10)


def sine(estimated: Tensor, true: Tensor) -> Tensor:
    """Compute |a x b| of (..., 3) unit vectors: the sine (...) of the angle between two directions."""
    return torch.linalg.cross(estimated, true).square().sum(-1).clamp_min(1e-16).sqrt()


def normal_loss(prediction: PatchPrediction, normals: Tensor) -> Tensor:
    """L_normal: the sine of the rough plus that of the refined normal, if there is one, against (B, 3) true normals."""
    sines = sine(prediction.rough, normals)
    if prediction.refined is not prediction.rough:
        sines = sines + sine(prediction.refined, normals)
    return sines.mean()


def consistency_loss(prediction: PatchPrediction, neighbor_normals: Tensor, sparsity: float) -> Tensor:
    """L_con: weighted sines of the jet's and the refined normals at the (B, m, 3) neighbors, minus the mean log weight.

    A point whose normal the fit does not explain loses weight; -log w keeps all weights from going to zero.
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
    """Return all terms and their weighted sum, "loss" (eq. 12).

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
        terms["regularization"] = orthogonality_loss(prediction.feature_transform)
        loss = loss + factors.regularization * terms["regularization"]
    if prediction.offsets is not None:
        terms["offsets"] = prediction.offsets.square().mean()
        loss = loss + factors.offsets * terms["offsets"]
    return terms | {"loss": loss}


def cloudfit_loss(prediction: CloudPrediction, normals: Tensor, learned: Tensor) -> dict[str, Tensor]:
    """Return the terms of CloudFit's loss on a crop and their weighted sum, "loss".

    Each compares directions by the root mean square over the crop, as the measure of the field does over a cloud.

    Args:
        prediction: for the crop.
        normals: (n, 3) true normals of the crop.
        learned: (n,) which points are learned from.
    """
    inside = [(found[learned[at]], normals[at[learned[at]]]) for found, at in prediction.directions]
    votes = [_rms(found, true) for found, true in inside if len(found)]  # a coarse level may have no point to learn
    terms = {"normals": _rms(prediction.normals[learned], normals[learned]), "votes": torch.stack(votes).mean()}
    with torch.no_grad():
        good = (_square(prediction.normals[learned], normals[learned]) < 2 * (1 - math.cos(SURE))).float()
    terms["confidence"] = F.binary_cross_entropy_with_logits(prediction.confidence[learned], good)
    terms["loss"] = 2 * terms["normals"] + terms["votes"] + 0.1 * terms["confidence"]
    return terms


def _square(estimated: Tensor, true: Tensor) -> Tensor:
    """(N,) squared chord between two directions: the squared angle, for small ones."""
    return 2 * (1 - (estimated * true).sum(1).abs()).clamp_min(0)


def _rms(estimated: Tensor, true: Tensor, floor: float = FLOOR) -> Tensor:
    return (_square(estimated, true).mean() + floor**2).sqrt()


def iternet_loss(estimated: Tensor, true: Tensor) -> Tensor:
    """IterNet's: the root mean square of the chords between (N, 3) directions, ITERNET_FLOOR as one of its parts.

    Published is their mean; the root mean square is what is measured.
    """
    return _rms(estimated, true, ITERNET_FLOOR)


def pcpnet_loss(predicted: Tensor, normals: Tensor) -> Tensor:
    """PCPNet's: the mean squared distance from (B, 3) predictions of any length to the nearer of n and -n."""
    squares = [(predicted - normals).square().sum(1), (predicted + normals).square().sum(1)]
    return torch.minimum(*squares).mean()


def nestinet_loss(answers: tuple[Tensor, Tensor], true: Tensor) -> Tensor:
    """Nesti-Net's: the mean of twice the sines of (B, E, 3) normals of experts to (B, 3) true ones, by probability."""
    normals, probabilities = answers
    sines = sine(F.normalize(normals, dim=2), true[:, None].expand_as(normals))
    return 2 * (probabilities * sines).sum(1).mean()
