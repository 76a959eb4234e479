"""PCPNet: published sizes, what changes nothing, and that it learns."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from jetnormal.networks.patchfit.network import parameter_count
from jetnormal.networks.pcpnet import PCPNet, PCPNetConfig
from jetnormal.training.losses import pcpnet_loss

TINY = PCPNetConfig(points=20, width=0.125)


def tilted_planes(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(count, 3, 20, 3) balls on planes, and their normals."""
    generator = torch.Generator().manual_seed(0)
    normals = F.normalize(torch.randn(count, 3, generator=generator), dim=1)
    points = torch.rand(count, 3, 20, 3, generator=generator) * 1.2 - 0.6
    points = points - (points * normals[:, None, None]).sum(-1, keepdim=True) * normals[:, None, None]
    points[:, :, 0] = 0
    return points, normals


@pytest.mark.parametrize(("radii", "count"), [((0.01, 0.03, 0.05), 22_362_055), ((0.05,), 3_469_255)])
def test_the_published_sizes(radii: tuple[float, ...], count: int):
    network = PCPNet(PCPNetConfig(radii=radii))
    assert parameter_count(network) == count
    if len(radii) == 3:  # Du et al. print 85.41 MB, that is 2^20 bytes
        assert sum(t.numel() * t.element_size() for t in network.state_dict().values()) / 2**20 == pytest.approx(
            85.4, abs=0.02
        )


@pytest.mark.parametrize("radii", [(0.05,), (0.01, 0.03, 0.05)])
def test_folding_and_the_order_of_points_change_nothing(radii: tuple[float, ...]):
    torch.manual_seed(0)
    network = PCPNet(PCPNetConfig(radii=radii, points=20, width=0.125)).train()
    points = tilted_planes(8)[0][:, : len(radii)]
    network(points)  # statistics that are not those of the start
    network.eval()
    expected = network(points)
    shuffled = points[:, :, torch.randperm(20)]
    torch.testing.assert_close(network(shuffled), expected, atol=1e-5, rtol=1e-4)
    normals, confidence = network.for_inference().estimate(points, torch.full((8, len(radii)), 20))
    torch.testing.assert_close(normals, F.normalize(expected, dim=1), atol=1e-4, rtol=0)
    torch.testing.assert_close(confidence, expected.norm(dim=1).clamp(0, 1), atol=1e-4, rtol=0)


def test_the_loss_has_no_sign():
    normals = F.normalize(torch.randn(6, 3), dim=1)
    assert pcpnet_loss(-normals, normals) == 0
    torch.testing.assert_close(pcpnet_loss(torch.zeros(6, 3), normals), torch.tensor(1.0))


def test_it_learns_planes_and_every_parameter_takes_part():
    torch.manual_seed(0)
    network = PCPNet(TINY).train()
    points, normals = tilted_planes(16)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for step in range(25):
        loss = pcpnet_loss(network(points), normals)
        optimizer.zero_grad()
        loss.backward()
        if step == 3:  # the transforms' last layers start at zero and hide what lies before them
            assert all(parameter.grad is not None for parameter in network.parameters())
            assert all(parameter.grad.isfinite().all() for parameter in network.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("change", [{"radii": ()}, {"radii": (0.01, -1)}, {"points": 2}, {"width": 0.0}])
def test_impossible_configurations_are_refused(change: dict):
    with pytest.raises(ValueError, match="not"):
        PCPNetConfig(**change)
