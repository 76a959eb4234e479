"""CloudFit: shapes, size, equivariance to float tolerance, determinism, and that it learns."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation

from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig, CloudPrediction, tangent_frame

TINY = CloudFitConfig(channels=(8, 8, 8), hidden=4, up_layers=(1, 1, 1), down_layers=(1, 1, 0))


def bumpy_sphere(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a unit sphere with a little noise, and its normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * (1 + 0.01 * rng.normal(size=(count, 1))), normals


def predict(network: CloudFit, points: np.ndarray, iterations: int = 1) -> CloudPrediction:
    encoding = network.encode(build_pyramid(points, len(network.config.channels)))
    return network.fit(encoding, torch.arange(len(points)), iterations)


@pytest.fixture
def network() -> CloudFit:
    torch.manual_seed(0)
    return CloudFit(TINY).for_inference()


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arcsin(np.linalg.norm(np.cross(a, b), axis=1).clip(0, 1)))


def test_shapes_and_unit_length(network: CloudFit):
    points, _ = bumpy_sphere(300)
    prediction = predict(network, points)
    for normals in (prediction.direction, prediction.rough, prediction.refined):
        assert normals.shape == (300, 3)
        torch.testing.assert_close(normals.norm(dim=1), torch.ones(300), atol=1e-5, rtol=0)
    assert prediction.jet.coefficients.shape == (300, 6)
    assert prediction.confidence.shape == prediction.unit.shape == (300,)


def test_the_default_has_2_1_million_parameters():
    assert sum(parameter.numel() for parameter in CloudFit(CloudFitConfig()).parameters()) == 2_129_273


@pytest.mark.parametrize("iterations", [1, 3])
def test_the_result_turns_moves_scales_and_permutes_with_the_cloud(network: CloudFit, iterations: int):
    points, _ = bumpy_sphere(800)
    turn = Rotation.from_euler("xyz", [1.0, 0.4, -2.0]).as_matrix()
    order = np.random.default_rng(1).permutation(len(points))
    moved = (points @ turn.T * 1e-3 + [5000.0, -3000.0, 10.0])[order]
    before, after = predict(network, points, iterations), predict(network, moved, iterations)
    expected = before.refined.numpy()[order] @ turn.T
    assert degrees(expected, after.refined.numpy()).max() < 0.05
    torch.testing.assert_close(after.confidence, before.confidence[order], atol=1e-3, rtol=0)
    torch.testing.assert_close(after.unit, 1e-3 * before.unit[order], atol=0, rtol=1e-4)


def test_the_signs_of_the_first_normals_do_not_matter(network: CloudFit):
    points, _ = bumpy_sphere(500)
    pyramid = build_pyramid(points, 3)
    expected = network.fit(network.encode(pyramid), torch.arange(500)).refined.numpy()
    for level in pyramid:
        level.normals[::2] *= -1
    assert degrees(expected, network.fit(network.encode(pyramid), torch.arange(500)).refined.numpy()).max() < 0.01


def test_threads_and_chunks_do_not_change_a_bit(network: CloudFit):
    points, _ = bumpy_sphere(10_000)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            with torch.inference_mode():
                results.append(predict(network, points).refined)
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
    difference = degrees(fast.refined.numpy(), whole.refined.detach().numpy())
    assert np.sqrt(np.mean(difference**2)) < 0.05


def test_every_parameter_gets_a_gradient():
    points, normals = bumpy_sphere(400)
    network = CloudFit(TINY)
    encoding = network.encode(build_pyramid(points, 3))
    prediction = network.fit(encoding, torch.arange(400))
    true = torch.from_numpy(normals).float()
    loss = sum((1 - (found * true[origin]).sum(1).abs()).mean() for found, origin in encoding.directions)
    loss = loss + prediction.confidence.mean()
    for found in (prediction.direction, prediction.rough, prediction.refined):
        loss = loss + (1 - (found * true).sum(1).abs()).mean()
    loss.backward()
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
    for _ in range(30):
        prediction = network.fit(network.encode(pyramid), torch.arange(600))
        loss = sum((1 - (n * true).sum(1).abs()).mean() for n in (prediction.direction, prediction.refined))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


def test_tangent_frames_are_rotations_with_z_last():
    z = F.normalize(torch.cat([torch.randn(50, 3), torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])]), dim=1)
    frame = tangent_frame(z)
    torch.testing.assert_close(frame @ frame.transpose(1, 2), torch.eye(3).expand(53, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(53), atol=1e-5, rtol=0)
    torch.testing.assert_close(frame[:, :, 2], z)


@pytest.mark.parametrize(
    "change",
    [{"channels": (8, 8)}, {"channels": (8, 7, 8)}, {"order": 5}, {"hidden": 0}, {"up_layers": (1, 1)}],
)
def test_impossible_configurations_are_refused(change: dict):
    fields = {"channels": (8, 8, 8), "hidden": 4, "up_layers": (1, 1, 1), "down_layers": (1, 1, 0)}
    with pytest.raises(ValueError, match=r"channels|order"):
        CloudFitConfig(**(fields | change))
