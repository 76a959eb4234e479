"""CloudFit: shapes, size, equivariance to float tolerance, determinism, and that it learns."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.config import CloudFitConfig, check_shapes, parameter_shapes
from jetnormal.networks.cloudfit.inference import Inference
from jetnormal.networks.cloudfit.network import CloudFit, CloudPrediction
from jetnormal.networks.cloudfit.torch_ops import plain_torch

TINY = CloudFitConfig(channels=(8, 8, 8), hidden=4, up_layers=(1, 1, 1), down_layers=(1, 1, 0))


def bumpy_sphere(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a unit sphere with a little noise, and its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * (1 + 0.01 * rng.normal(size=(count, 1))), normals


def predict(network: CloudFit, points: np.ndarray) -> CloudPrediction:
    return network(build_pyramid(points, len(network.config.channels)))


def lines(count: int, apart: float) -> np.ndarray:
    """About `count` points of a wavy height field in scan lines, `apart` times as far apart as their samples."""
    number = round(np.sqrt(count / apart))
    x, y = np.meshgrid(np.linspace(0, 1, round(number * apart)), np.linspace(0, 1, number))
    xy = np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(0).normal(scale=1e-4, size=(x.size, 2))
    return np.column_stack([xy, 0.1 * np.sin(5 * xy[:, 0]) * np.cos(4 * xy[:, 1])])


@pytest.fixture
def network() -> CloudFit:
    torch.manual_seed(0)
    return CloudFit(TINY).for_inference()


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arcsin(np.linalg.norm(np.cross(a, b), axis=1).clip(0, 1)))


def test_shapes_and_unit_length(network: CloudFit):
    points, _ = bumpy_sphere(300)
    prediction = predict(network, points)
    for normals in (prediction.normals, prediction.rough):
        assert normals.shape == (300, 3)
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(300), atol=1e-5, rtol=0)
    assert prediction.confidence.shape == (300,)
    assert len(prediction.levels[0].positions) == 300


def test_the_default_has_4_million_parameters():
    assert sum(parameter.numel() for parameter in CloudFit(CloudFitConfig()).parameters()) == 4_354_435


@pytest.mark.parametrize("points", [bumpy_sphere(800)[0], lines(3000, 10)], ids=["sphere", "lines"])
def test_the_result_turns_moves_scales_and_permutes_with_the_cloud(network: CloudFit, points: np.ndarray):
    turn = Rotation.from_euler("xyz", [1.0, 0.4, -2.0]).as_matrix()
    order = np.random.default_rng(1).permutation(len(points))
    moved = (points @ turn.T * 1e-3 + [5000.0, -3000.0, 10.0])[order]
    before, after = predict(network, points), predict(network, moved)
    expected = before.normals.numpy()[order] @ turn.T
    assert degrees(expected, after.normals.numpy()).max() < 0.05
    torch.testing.assert_close(after.confidence, before.confidence[order], atol=1e-3, rtol=0)


def test_points_that_the_finest_level_leaves_out_get_normals_of_their_own(network: CloudFit):
    points = lines(3000, 10)
    pyramid = build_pyramid(points, 3)
    prediction = network(pyramid)
    assert len(pyramid.left_out) > 1000
    assert len(prediction.normals) == len(points)
    normals, origins = prediction.directions[-1]
    assert torch.equal(prediction.normals[origins], normals)
    assert np.array_equal(origins.numpy(), pyramid.left_out)
    nearest = prediction.levels[0].normals[torch.from_numpy(pyramid.carried.neighbors[:, 0]).long()]
    assert (normals != nearest).any()


def test_the_signs_of_the_first_normals_do_not_matter(network: CloudFit):
    points, _ = bumpy_sphere(500)
    pyramid = build_pyramid(points, 3)
    expected = network(pyramid).normals.numpy()
    for level in pyramid.levels:
        level.normals[::2] *= -1
    assert degrees(expected, network(pyramid).normals.numpy()).max() < 0.01


def test_threads_and_chunks_do_not_change_a_bit(network: CloudFit):
    points, _ = bumpy_sphere(10_000)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            with torch.inference_mode():
                results.append(predict(network, points).normals)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_chunks_give_what_one_call_with_gradients_gives(network: CloudFit):
    points, _ = bumpy_sphere(6000)
    with torch.inference_mode():
        fast = predict(network, points)
    network.requires_grad_(True)
    whole = predict(network, points)
    difference = degrees(fast.normals.numpy(), whole.normals.detach().numpy())
    assert np.sqrt(np.mean(difference**2)) < 0.05


def test_plain_pytorch_gives_what_the_compiled_loops_give(network: CloudFit):
    points = lines(3000, 10)
    compiled = predict(network, points)
    with plain_torch():
        plain = predict(network, points)
    assert degrees(compiled.normals.numpy(), plain.normals.numpy()).max() < 0.01
    torch.testing.assert_close(compiled.confidence, plain.confidence, atol=1e-4, rtol=1e-4)


def test_inference_without_pytorch_gives_the_same(network: CloudFit):
    pyramid = build_pyramid(lines(9000, 10), 3)
    weights = {name: values.numpy() for name, values in network.state_dict().items()}
    expected = network(pyramid)
    results = [Inference(TINY, weights)(pyramid, threads) for threads in (1, 3)]
    assert degrees(results[0].normals, expected.normals.numpy()).max() < 0.05
    assert degrees(results[0].rough, expected.rough.numpy()).max() < 0.05
    np.testing.assert_allclose(results[0].confidence, expected.confidence.numpy(), atol=0.02)
    np.testing.assert_array_equal(results[0].normals, results[1].normals)  # whatever the threads


@pytest.mark.parametrize("config", [TINY, CloudFitConfig()])
def test_the_shapes_of_the_parameters_follow_from_the_configuration(config: CloudFitConfig):
    shapes = {name: tuple(values.shape) for name, values in CloudFit(config).state_dict().items()}
    assert shapes == parameter_shapes(config)
    check_shapes(config, shapes)
    for wrong in (shapes | {"carry.edge": (1, 1)}, shapes | {"more": (1,)}, dict(list(shapes.items())[1:])):
        with pytest.raises(ValueError, match=r"carry\.edge|more|without"):
            check_shapes(config, wrong)


def test_every_parameter_gets_a_gradient():
    points = lines(3000, 10)
    network = CloudFit(TINY)
    prediction = predict(network, points)
    true = torch.tensor([0.0, 0.0, 1.0])
    loss = sum((1 - (found * true).sum(1).abs()).mean() for found, _ in prediction.directions)
    (loss + prediction.confidence.mean()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_a_few_steps_learn_a_noisy_edge():
    rng = np.random.default_rng(0)
    flat = rng.random((600, 2)) * [1, 2] - [0, 1]
    points = np.where(flat[:, 1:] > 0, flat @ [[1, 0, 0], [0, 1, 0]], flat @ [[1, 0, 0], [0, 0, 1]])
    true = torch.where(torch.from_numpy(flat[:, 1:]) > 0, torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0]))
    pyramid = build_pyramid(points + 0.01 * rng.normal(size=points.shape), 3)
    torch.manual_seed(0)
    network = CloudFit(TINY)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(80):
        loss = (1 - (network(pyramid).normals * true).sum(1).abs()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


@pytest.mark.parametrize(
    "change",
    [{"channels": (8, 8)}, {"channels": (8, 7, 8)}, {"hidden": 0}, {"up_layers": (1, 1)}],
)
def test_impossible_configurations_are_refused(change: dict):
    fields = {"channels": (8, 8, 8), "hidden": 4, "up_layers": (1, 1, 1), "down_layers": (1, 1, 0)}
    with pytest.raises(ValueError, match=r"channels|hidden"):
        CloudFitConfig(**(fields | change))
