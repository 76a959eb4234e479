from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.networks.patchfit.ztransform import (
    QSTN,
    FeatureTransform,
    ZTransform,
    rotation_matrix,
    rotation_to_z,
    scaled,
)

TRANSFORMS = {
    "full": lambda: ZTransform(0.125),
    "light": lambda: ZTransform(0.125, light=True),
    "qstn": lambda: QSTN(0.125),
}


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def stirred(transform: torch.nn.Module) -> torch.nn.Module:
    """A transform whose last layer, zero at first, is not zero; evaluation mode."""
    torch.nn.init.normal_(transform.quaternion[-1].weight, std=0.5)
    return transform.eval().requires_grad_(False)


def assert_rotations(matrices: torch.Tensor):
    identity = torch.eye(3).expand_as(matrices)
    torch.testing.assert_close(matrices @ matrices.transpose(1, 2), identity, rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(len(matrices)), rtol=0, atol=1e-5)


def test_parameters_are_those_of_the_publication():
    assert parameter_count(ZTransform()) == 980_212
    assert parameter_count(ZTransform(light=True)) == 980_212
    assert parameter_count(FeatureTransform()) == 1_857_344


@pytest.mark.parametrize("name", TRANSFORMS)
def test_a_transform_starts_as_the_identity(name):
    transform = TRANSFORMS[name]()
    assert torch.equal(transform(torch.randn(3, 64, 3)), torch.eye(3).expand(3, 3, 3))


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize("batch, count", [(1, 1), (1, 7), (5, 64), (2, 300)])
def test_a_transform_is_a_rotation_for_any_number_of_points(name, batch, count):
    rotations = stirred(TRANSFORMS[name]())(torch.randn(batch, count, 3))
    assert rotations.shape == (batch, 3, 3)
    assert_rotations(rotations)


@pytest.mark.parametrize("name", TRANSFORMS)
def test_different_patches_get_different_rotations(name):
    rotations = stirred(TRANSFORMS[name]())(torch.randn(2, 64, 3))
    assert (rotations[0] - rotations[1]).abs().max() > 1e-4


def test_the_light_form_sees_every_second_point():
    points, transform = torch.randn(2, 64, 3), stirred(TRANSFORMS["light"]())
    changed = points.clone()
    changed[:, 1::2] += 1
    assert torch.equal(transform(points), transform(changed))


def test_the_feature_transform_starts_as_the_identity():
    assert torch.equal(FeatureTransform(8, 0.125)(torch.randn(3, 20, 8)), torch.eye(8).expand(3, 8, 8))


def test_channels_scale_to_multiples_of_8():
    assert [scaled(64, w) for w in (1.0, 0.25, 0.2, 0.01)] == [64, 16, 16, 8]


@pytest.mark.parametrize("length", [0.01, 1.0, 30.0])
def test_a_quaternion_of_any_length_gives_its_rotation(length):
    axis = torch.tensor([[1.0, -2, 2]]) / 3
    angle = torch.tensor(0.8)
    quaternion = length * torch.cat([(angle / 2).cos().view(1, 1), (angle / 2).sin() * axis], dim=1)
    matrix = rotation_matrix(quaternion - torch.tensor([1.0, 0, 0, 0]))[0]
    x, y, z = axis[0]
    generator = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    torch.testing.assert_close(matrix, torch.linalg.matrix_exp(angle * generator), rtol=0, atol=1e-5)


def test_quaternions_give_rotations():
    assert_rotations(rotation_matrix(torch.randn(50, 4)))


def test_rotation_to_z_turns_a_normal_to_the_z_axis():
    special = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [-0.6, 0.8, 0], [-0.6, 0.8, -0.0], [1e-9, 0, -1]]
    normals = torch.cat([torch.tensor(special), normalize(torch.randn(100, 3), dim=1)])
    rotations = rotation_to_z(normals)
    assert_rotations(rotations)
    turned = (normals[:, None] @ rotations)[:, 0]
    expected = torch.where(normals[:, 2:] < 0, -1.0, 1.0) * torch.tensor([0.0, 0, 1])
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-6)


def test_rotation_to_z_is_the_smallest_and_ignores_the_sign():
    normals = normalize(torch.randn(100, 3), dim=1)
    rotations = rotation_to_z(normals)
    assert torch.equal(rotations, rotation_to_z(-normals))
    trace = rotations.diagonal(dim1=1, dim2=2).sum(1)
    torch.testing.assert_close((trace - 1) / 2, normals[:, 2].abs(), rtol=0, atol=1e-5)  # cosine of its angle
