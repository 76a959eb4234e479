from __future__ import annotations

import contextlib
import dataclasses

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.functional import normalize

from jetnormal.networks.patchfit import layers
from jetnormal.networks.patchfit import network as patchfit
from jetnormal.networks.patchfit.layers import PointLayer
from jetnormal.networks.patchfit.network import CONFIGS, PatchFit, PatchFitConfig, PatchPrediction, parameter_count
from jetnormal.networks.patchfit.ztransform import rotation_to_z
from jetnormal.training.losses import total_loss
from jetnormal.training.options import LossWeights

SMALL = PatchFitConfig(neighbors=32, width=0.125)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def bent_patches(batch: int, count: int = 32, noise: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, k, 3) random quadrics through the origin, tilted by up to 40 degrees, and the (B, k, 3) true normals."""
    xy = (torch.rand(batch, count, 2) - 0.5) * 1.4
    xy[:, 0] = 0
    a, b, c = torch.randn(3, batch, 1)
    x, y = xy.unbind(2)
    z = (a * x**2 + b * y**2) / 3 + c * x * y / 3
    points = torch.stack([x, y, z + noise * torch.randn_like(z)], dim=2)
    points[:, 0] = 0
    normals = torch.stack([-(2 * a * x + c * y) / 3, -(2 * b * y + c * x) / 3, torch.ones_like(x)], dim=2)
    axes = normalize(torch.cat([torch.randn(batch, 2), 2 * torch.ones(batch, 1)], 1), dim=1)
    turn = rotation_to_z(axes)
    return points @ turn, normalize(normals, dim=2) @ turn


def trained(config: PatchFitConfig, steps: int = 5) -> PatchFit:
    """A network after a few steps, so that statistics, transforms and correction have left their start."""
    network = PatchFit(config)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(steps):
        points, normals = bent_patches(8, config.neighbors)
        optimizer.zero_grad()
        total_loss(network(points, neighbors=True), normals, LossWeights())["loss"].backward()
        optimizer.step()
    return network


def assert_close(first: PatchPrediction, second: PatchPrediction, atol: float):
    for field in ("rotation", "weights", "rough", "refined"):
        torch.testing.assert_close(getattr(first, field), getattr(second, field), rtol=0, atol=atol)


@pytest.mark.parametrize(
    "weights, both, z_direction, correction, baseline",
    [
        ("deepfit", 3_734_468, 3_708_661, 3_556_052, 3_530_245),
        ("adafit", 4_378_247, 4_352_440, 4_199_831, 4_174_024),
        ("graphfit", 4_463_559, 4_437_752, 4_285_143, 4_259_336),
    ],
)
def test_parameters_are_those_of_the_publication(weights, both, z_direction, correction, baseline):
    config = CONFIGS["paper"][weights]
    assert parameter_count(PatchFit(config)) == both
    assert parameter_count(PatchFit(dataclasses.replace(config, correction=False))) == z_direction
    assert parameter_count(PatchFit(dataclasses.replace(config, transform="qstn"))) == correction
    assert parameter_count(PatchFit(dataclasses.replace(config, transform="qstn", correction=False))) == baseline
    # The paper prints millions in units of 1,024,000, some rounded, some cut.
    printed = {"deepfit": (3.64, 3.44), "adafit": (4.28, 4.07), "graphfit": (4.36, 4.16)}[weights]
    assert np.abs(np.array([both, baseline]) / 1_024_000 - printed).max() < 0.01


def test_the_defaults_are_the_paper():
    assert CONFIGS["paper"]["deepfit"] == PatchFitConfig()
    sizes = {weights: config.neighbors for weights, config in CONFIGS["paper"].items()}
    assert sizes == {"deepfit": 256, "adafit": 700, "graphfit": 500}


@pytest.mark.parametrize("weights", CONFIGS["paper"])
def test_the_small_configurations_are_small(weights):
    assert parameter_count(PatchFit(CONFIGS["small"][weights])) < 500_000


@pytest.mark.parametrize(
    "setting", [{"order": 0}, {"order": 5}, {"neighbors": 2}, {"width": 0.0}, {"transform_width": float("inf")}]
)
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(ValueError, match=", not "):
        PatchFitConfig(**setting)


CONFIGURATIONS = [
    SMALL,
    dataclasses.replace(SMALL, transform="qstn", correction=False),
    dataclasses.replace(SMALL, light=True, feature_transform=False, order=1),
    dataclasses.replace(SMALL, order=4, transform_width=0.25, offsets=True),
    dataclasses.replace(SMALL, weights="adafit", offsets=True, neighbors=64, order=2),
    dataclasses.replace(SMALL, weights="graphfit", offsets=True),
]


def fitted(config: PatchFitConfig, count: int) -> int:
    """How many of the points of a patch the jet is fitted to."""
    return max(1, count // 4) if config.weights == "adafit" else count


@pytest.mark.parametrize("config", CONFIGURATIONS)
@pytest.mark.parametrize("batch, count", [(1, 12), (1, 1), (17, 32), (2, 300)])
def test_shapes_for_any_batch_and_number_of_points(config, batch, count):
    network = PatchFit(config).for_inference()
    points = bent_patches(batch, count)[0]
    prediction = network(points, neighbors=True)
    assert prediction.rotation.shape == (batch, 3, 3)
    assert prediction.weights.shape == (batch, fitted(config, count))
    assert prediction.jet.order == config.order
    for normals in (prediction.rough, prediction.refined):
        assert normals.shape == (batch, 3)
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(batch))
    for normals in (prediction.rough_neighbors, prediction.refined_neighbors):
        assert normals.shape == (batch, fitted(config, count), 3)
        torch.testing.assert_close(normals.norm(dim=2), torch.ones(batch, fitted(config, count)))
    assert (prediction.feature_transform is None) != config.feature_transform
    alone = network(points)
    assert alone.rough_neighbors is None and alone.refined_neighbors is None
    assert torch.equal(alone.refined, prediction.refined)


@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_a_patch_is_predicted_alike_alone_and_in_a_batch(config):
    network = trained(config).for_inference()
    points = bent_patches(17, config.neighbors)[0]
    batch = network(points)
    for i in (0, 15, 16):
        alone = network(points[i : i + 1])
        torch.testing.assert_close(alone.refined[0], batch.refined[i], rtol=0, atol=1e-4)


@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_predictions_are_deterministic(config):
    network = trained(config).for_inference()
    points = bent_patches(9, config.neighbors)[0]
    first, second = network(points), network(points)
    assert torch.equal(first.refined, second.refined) and torch.equal(first.weights, second.weights)
    torch.manual_seed(0)
    again = trained(config).state_dict()
    torch.manual_seed(0)
    assert all(torch.equal(value, again[name]) for name, value in trained(config).state_dict().items())


@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_folding_leaves_the_prediction_unchanged(config):
    network = trained(config).eval().requires_grad_(False)
    points = bent_patches(9, config.neighbors)[0]
    before = network(points)
    assert network.for_inference() is network
    assert not any(isinstance(layer, nn.BatchNorm1d) for layer in network.modules())
    assert any(isinstance(layer, PointLayer) for layer in network.modules())
    assert not any(p.requires_grad for p in network.parameters())
    assert_close(network(points), before, atol=1e-4)
    with torch.inference_mode():  # row by row, in part
        assert_close(network(points), before, atol=1e-4)


@pytest.mark.parametrize("transform", ["ztransform", "qstn"])
def test_the_order_of_the_neighbors_does_not_matter(transform):
    network = trained(dataclasses.replace(SMALL, transform=transform)).for_inference()
    points = bent_patches(4)[0]
    order = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(31)])
    before, after = network(points), network(points[:, order])
    torch.testing.assert_close(after.rotation, before.rotation, rtol=0, atol=1e-4)
    torch.testing.assert_close(after.refined, before.refined, rtol=0, atol=1e-4)
    torch.testing.assert_close(after.weights, before.weights[:, order], rtol=0, atol=1e-4)


def test_normals_return_from_the_rotated_frame():
    """Weights and transform cannot matter on exact quadrics of order 2: the rough normals are the true ones."""
    network = PatchFit(dataclasses.replace(SMALL, order=2, correction=False)).for_inference()
    xy = torch.rand(5, 32, 2) - 0.5
    xy[:, 0] = 0
    slopes = torch.randn(5, 2) / 2
    plane = torch.cat([xy, (xy @ slopes[:, :, None])], dim=2)
    true = normalize(torch.cat([-slopes, torch.ones(5, 1)], dim=1), dim=1)
    assert torch.equal(network(plane).rotation, torch.eye(3).expand(5, 3, 3))
    torch.testing.assert_close(network(plane).rough, true, rtol=0, atol=1e-4)

    network.transform.quaternion[-1].bias.copy_(torch.tensor([0.1, 0.3, -0.2, 0.4]))
    prediction = network(plane, neighbors=True)
    assert (prediction.rotation - torch.eye(3)).abs().max() > 0.1
    sign = (prediction.rough * true).sum(1, keepdim=True).sign()
    torch.testing.assert_close(sign * prediction.rough, true, rtol=0, atol=1e-3)
    torch.testing.assert_close(
        sign[:, None] * prediction.rough_neighbors, true[:, None].expand(5, 32, 3), rtol=0, atol=1e-3
    )


def test_the_second_iteration_turns_the_normal_found_to_z():
    network = trained(SMALL).for_inference()
    points = bent_patches(6)[0]
    once, twice = network(points), network(points, iterations=2)
    assert torch.equal(twice.rotation, rotation_to_z(once.refined))
    turned = (once.refined[:, None] @ twice.rotation)[:, 0]
    torch.testing.assert_close(turned[:, 2].abs(), torch.ones(6))
    assert (twice.rough - once.rough).abs().max() > 1e-6
    assert torch.equal(network(points, iterations=3).rotation, rotation_to_z(twice.refined))


def test_the_jet_is_fitted_to_the_moved_points():
    """Offsets that flatten a patch make its normal z, whatever the points were."""
    network = PatchFit(dataclasses.replace(SMALL, offsets=True, correction=False)).for_inference()
    points = bent_patches(3)[0]

    def flattening(turned):
        weighting = type(network.weights).forward(network.weights, turned)
        return dataclasses.replace(weighting, offsets=-turned * torch.tensor([0.0, 0, 1]))

    before = network(points, neighbors=True)
    network.weights.forward = flattening
    after = network(points, neighbors=True)
    assert (before.rough[:, 2] < 0.999).any()
    z = torch.tensor([0.0, 0, 1])
    torch.testing.assert_close(after.rough, z.expand(3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(after.rough_neighbors, z.expand(3, 32, 3), rtol=0, atol=1e-5)


def test_iterating_does_not_move_an_exact_plane():
    network = PatchFit(dataclasses.replace(SMALL, order=2, correction=False)).for_inference()
    points = bent_patches(3)[0] * torch.tensor([1.0, 1, 0])
    torch.testing.assert_close(network(points, iterations=2).refined, network(points).refined, rtol=0, atol=1e-5)


@pytest.mark.parametrize("config", CONFIGURATIONS)
def test_gradients_reach_every_parameter(config):
    """All but those that normalization and softmax cancel out: biases before the one, shifts before the other."""
    network = PatchFit(config)
    zero_at_start = [network.transform.quaternion[-1]]
    if network.weights.transform is not None:
        zero_at_start.append(network.weights.transform.head[-1])
    if network.weights.offset is not None:
        zero_at_start.append(network.weights.offset)
    for layer in zero_at_start:  # what is before them learns from the second step on
        assert not layer.weight.any()
        nn.init.normal_(layer.weight, std=0.05)
    layers = [(name, layer) for name, layer in network.named_modules() if isinstance(layer, PointLayer)]
    canceled = {f"{name}.linear.bias" for name, layer in layers if layer.linear.bias is not None}
    canceled |= {name for name, _ in network.named_parameters() if name.endswith("attention.1.bias")}

    points, normals = bent_patches(8, 64, noise=0.05)
    total_loss(network(points, neighbors=True), normals, LossWeights())["loss"].backward()
    largest = {name: p.grad.abs().max().item() for name, p in network.named_parameters()}
    assert np.isfinite(list(largest.values())).all()
    assert [name for name, value in largest.items() if value == 0 and name not in canceled] == []
    assert max(largest[name] for name in canceled) < 1e-3 * max(largest.values())  # rounding


def test_the_last_layers_of_the_transforms_learn_from_the_start():
    network = PatchFit(SMALL)
    points, normals = bent_patches(8)
    total_loss(network(points, neighbors=True), normals, LossWeights())["loss"].backward()
    assert network.transform.quaternion[-1].weight.grad.abs().max() > 0
    assert network.weights.transform.head[-1].weight.grad.abs().max() > 0


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        dataclasses.replace(SMALL, light=True, feature_transform=False),
        dataclasses.replace(SMALL, weights="adafit", offsets=True, neighbors=64, order=1, light=True),
        dataclasses.replace(SMALL, weights="graphfit", offsets=True, light=True),
        dataclasses.replace(SMALL, weights="graphfit", offsets=True, transform="qstn", correction=False),
    ],
)
def test_a_network_overfits_a_few_patches(config):
    network = PatchFit(config)
    points, normals = bent_patches(32, config.neighbors, noise=0.1)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)

    def error() -> float:
        refined = prediction.refined.detach()
        sine = torch.linalg.cross(refined, normals[:, 0]).norm(dim=1).clamp(max=1)
        return torch.rad2deg(torch.asin(sine)).square().mean().sqrt().item()

    prediction = network(points, neighbors=True)
    start = error()
    for _ in range(70):
        prediction = network(points, neighbors=True)
        optimizer.zero_grad()
        total_loss(prediction, normals, LossWeights())["loss"].backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    assert start > 5
    assert error() < max(3.0, start / 3)


@pytest.mark.parametrize("weights", CONFIGS["paper"])
def test_the_jet_never_runs_in_half_precision(weights):
    network = PatchFit(dataclasses.replace(SMALL, weights=weights, neighbors=64, offsets=True))
    points, normals = bent_patches(4, 64)
    with torch.autocast("cpu", torch.bfloat16):
        prediction = network(points, neighbors=True)
    assert prediction.weights.dtype == prediction.rotation.dtype == torch.float32
    assert prediction.jet.coefficients.dtype == torch.float32
    assert prediction.rough.dtype == prediction.refined.dtype == torch.float32
    assert prediction.rough_neighbors.dtype == prediction.refined_neighbors.dtype == torch.float32
    loss = total_loss(prediction, normals, LossWeights())["loss"]
    assert loss.dtype == torch.float32
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_bfloat16_predicts_about_the_same_normals():
    network = trained(SMALL).for_inference()
    points = bent_patches(16)[0]
    with torch.autocast("cpu", torch.bfloat16):
        rounded = network(points).refined
    cosine = (rounded * network(points).refined).sum(1).abs()
    assert torch.rad2deg(torch.acos(cosine.clamp(max=1))).median() < 3


@pytest.mark.parametrize("transform", ["ztransform", "qstn"])
@pytest.mark.parametrize("weights", CONFIGS["paper"])
def test_nothing_stays_on_the_cpu_when_a_network_runs_elsewhere(weights, transform, monkeypatch):
    for module in (layers, patchfit):  # the device that only knows shapes has no automatic mixed precision
        monkeypatch.setattr(module, "full_precision", lambda _: contextlib.nullcontext())
    config = dataclasses.replace(SMALL, weights=weights, transform=transform, neighbors=64, offsets=True)
    network = PatchFit(config).to("meta")
    prediction = network(torch.empty(3, 64, 3, device="meta"), iterations=2, neighbors=True)
    assert prediction.refined.device.type == prediction.refined_neighbors.device.type == "meta"
    assert prediction.jet.curvatures()[0].device.type == "meta"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("weights", CONFIGS["paper"])
def test_a_gpu_predicts_the_same_normals(weights):
    config = dataclasses.replace(SMALL, weights=weights, neighbors=64, offsets=True)
    torch.manual_seed(0)
    network = PatchFit(config).for_inference()
    points = bent_patches(16, 64)[0]
    expected = network(points).refined
    torch.testing.assert_close(network.to("cuda")(points.to("cuda")).refined.cpu(), expected, rtol=0, atol=1e-3)
