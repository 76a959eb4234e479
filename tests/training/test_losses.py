from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from jetnormal.geometry.jet import Jet
from jetnormal.networks.patchfit.network import PatchPrediction
from jetnormal.networks.patchfit.ztransform import rotation_matrix, rotation_to_z
from jetnormal.training.losses import (
    consistency_loss,
    normal_loss,
    orthogonality_loss,
    sine,
    total_loss,
    z_direction_loss,
)
from jetnormal.training.options import LossWeights

BATCH, K = 6, 10


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def directions(*shape: int) -> torch.Tensor:
    return normalize(torch.randn(*shape, 3), dim=-1)


def off_by(normals: torch.Tensor, degrees: float) -> torch.Tensor:
    """Normals turned by an angle about random axes at right angles to them."""
    axes = normalize(torch.linalg.cross(normals, torch.randn_like(normals), dim=-1), dim=-1)
    angle = np.radians(degrees)
    return np.cos(angle) * normals + np.sin(angle) * torch.linalg.cross(axes, normals, dim=-1)


def prediction(normals: torch.Tensor, **changed) -> PatchPrediction:
    """A faultless prediction of (B, k, 3) normals, and what a test changes in it."""
    fields = {
        "rotation": rotation_to_z(normals[:, 0]),
        "weights": torch.ones(BATCH, K),
        "jet": Jet(torch.zeros(BATCH, 10), 3),
        "rough": normals[:, 0],
        "refined": normals[:, 0],
        "rough_neighbors": normals,
        "refined_neighbors": normals,
        "feature_transform": torch.eye(8).expand(BATCH, 8, 8),
        "offsets": None,
    }
    return PatchPrediction(**(fields | changed))


@pytest.mark.parametrize("degrees", [0.1, 30.0, 90.0, 150.0])
def test_the_sine_of_a_known_angle(degrees):
    true = directions(50)
    expected = torch.full((50,), np.sin(np.radians(degrees)))
    torch.testing.assert_close(sine(off_by(true, degrees), true), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(sine(-off_by(true, degrees), true), expected, rtol=0, atol=1e-5)


def test_the_sine_has_a_finite_gradient_where_it_vanishes():
    true = directions(5)
    estimated = true.clone().requires_grad_()
    sine(estimated, true).sum().backward()
    assert torch.isfinite(estimated.grad).all()
    assert sine(true, true).max() < 1e-6


def test_the_normal_loss_adds_rough_and_refined():
    normals = directions(BATCH, K)
    given = prediction(normals, rough=off_by(normals[:, 0], 30), refined=-off_by(normals[:, 0], 90))
    assert normal_loss(given, normals[:, 0]).item() == pytest.approx(1.5, abs=1e-5)
    assert normal_loss(prediction(normals), normals[:, 0]).item() < 1e-6


def test_without_a_correction_the_normal_counts_once():
    normals = directions(BATCH, K)
    rough = off_by(normals[:, 0], 30)
    given = prediction(normals, rough=rough, refined=rough)
    assert normal_loss(given, normals[:, 0]).item() == pytest.approx(0.5, abs=1e-5)


def test_offsets_cost_their_mean_square():
    normals = directions(BATCH, K)
    offsets = torch.randn(BATCH, K, 3)
    terms = total_loss(prediction(normals, offsets=offsets), normals, LossWeights(offsets=0.3))
    torch.testing.assert_close(terms["offsets"], (offsets**2).sum() / (BATCH * K * 3))
    without = total_loss(prediction(normals), normals, LossWeights())
    assert "offsets" not in without
    torch.testing.assert_close(terms["loss"], without["loss"] + 0.3 * terms["offsets"])


def test_normals_beyond_the_fitted_points_do_not_matter():
    normals = directions(BATCH, 3 * K)
    given = prediction(normals[:, :K], rough=directions(BATCH))
    expected = total_loss(given, normals[:, :K], LossWeights())
    assert torch.equal(total_loss(given, normals, LossWeights())["loss"], expected["loss"])


def test_the_z_loss_vanishes_where_the_transform_aligns():
    normals = directions(BATCH)
    rotation = rotation_to_z(normals)
    about_z = rotation_matrix(torch.tensor([[0.0, 0, 0, 0.7]]))
    for aligned in (rotation, rotation @ about_z):  # what turns about z does not matter
        for sign in (1, -1):
            assert z_direction_loss(aligned, sign * normals).item() < 1e-6
    half = np.radians(25) / 2
    tilt = rotation_matrix(torch.tensor([[np.cos(half) - 1, np.sin(half), 0, 0]], dtype=torch.float32))
    assert z_direction_loss(rotation @ tilt, normals).item() == pytest.approx(np.sin(np.radians(25)), abs=1e-5)


def test_the_z_loss_is_the_cross_product_of_the_paper():
    normals, rotation = directions(BATCH), rotation_matrix(torch.randn(BATCH, 4))
    turned = torch.stack([normal @ matrix for normal, matrix in zip(normals, rotation, strict=True)])
    expected = sine(turned, torch.tensor([0.0, 0, 1]).expand(BATCH, 3)).mean()
    torch.testing.assert_close(z_direction_loss(rotation, normals), expected)


def test_consistency_weighs_the_sines_of_the_neighbors():
    normals = directions(BATCH, K)
    weights = 0.01 + torch.rand(BATCH, K)
    given = prediction(
        normals, weights=weights, rough_neighbors=off_by(normals, 30), refined_neighbors=off_by(normals, 90)
    )
    expected = (weights.mean() * 1.5 / 2).item()
    assert consistency_loss(given, normals, sparsity=0.0).item() == pytest.approx(expected, abs=1e-5)
    expected -= 0.2 * np.log(weights.numpy()).mean()
    assert consistency_loss(given, normals, sparsity=0.2).item() == pytest.approx(expected, abs=1e-5)


def test_a_point_of_no_weight_is_not_asked_to_be_consistent():
    normals = directions(BATCH, K)
    wrong = normals.clone()
    wrong[:, 3:] = off_by(normals[:, 3:], 60)
    weights = torch.ones(BATCH, K)
    weights[:, 3:] = 1e-8
    given = prediction(normals, weights=weights, rough_neighbors=wrong, refined_neighbors=wrong)
    assert consistency_loss(given, normals, sparsity=0.0).item() < 1e-6


def test_small_weights_cost():
    normals = directions(BATCH, K)
    costs = [
        consistency_loss(prediction(normals, weights=torch.full((BATCH, K), w)), normals, 0.2).item()
        for w in (0.01, 0.1, 1.0)
    ]
    assert costs[0] > costs[1] > costs[2]
    assert costs[0] == pytest.approx(-0.2 * np.log(0.01), abs=1e-5)


def test_a_rotation_is_orthogonal_and_a_scaled_one_is_not():
    """The element-wise product of the published code is positive for most rotations."""
    rotations = rotation_matrix(torch.randn(20, 4))
    assert orthogonality_loss(rotations).item() < 1e-12
    orthogonal = torch.linalg.qr(torch.randn(4, 16, 16)).Q
    assert orthogonality_loss(orthogonal).item() < 1e-12
    # 1.5 Q: (2.25 - 1)^2 on the diagonal, one entry in C
    assert orthogonality_loss(1.5 * orthogonal).item() == pytest.approx(1.25**2 / 16, rel=1e-4)


def test_the_total_is_the_weighted_sum_of_the_paper():
    normals = directions(BATCH, K)
    given = prediction(
        normals,
        weights=0.01 + torch.rand(BATCH, K),
        rotation=rotation_matrix(torch.randn(BATCH, 4)),
        rough=directions(BATCH),
        refined=directions(BATCH),
        rough_neighbors=directions(BATCH, K),
        refined_neighbors=directions(BATCH, K),
        feature_transform=torch.randn(BATCH, 8, 8),
    )
    terms = total_loss(given, normals, LossWeights())
    assert set(terms) == {"normal", "consistency", "z_direction", "regularization", "loss"}
    torch.testing.assert_close(terms["normal"], normal_loss(given, normals[:, 0]))
    torch.testing.assert_close(terms["consistency"], consistency_loss(given, normals, 0.2))
    torch.testing.assert_close(terms["z_direction"], z_direction_loss(given.rotation, normals[:, 0]))
    torch.testing.assert_close(terms["regularization"], orthogonality_loss(given.feature_transform))
    expected = terms["normal"] + 0.25 * terms["consistency"] + 0.1 * terms["regularization"] + 2 * terms["z_direction"]
    torch.testing.assert_close(terms["loss"], expected)

    other = total_loss(given, normals, LossWeights(consistency=0.0, regularization=0.0, z_direction=0.5))
    torch.testing.assert_close(other["loss"], terms["normal"] + 0.5 * terms["z_direction"])


def test_without_a_feature_transform_there_is_nothing_to_regularise():
    normals = directions(BATCH, K)
    terms = total_loss(prediction(normals, feature_transform=None), normals, LossWeights())
    assert "regularization" not in terms
    assert terms["loss"].item() < 1e-5  # a faultless prediction of weight 1 costs nothing


def test_no_loss_depends_on_the_signs_of_the_normals():
    normals = directions(BATCH, K)
    given = prediction(normals, rough=directions(BATCH), refined_neighbors=directions(BATCH, K))
    before = total_loss(given, normals, LossWeights())["loss"]
    torch.testing.assert_close(total_loss(given, -normals, LossWeights())["loss"], before)
