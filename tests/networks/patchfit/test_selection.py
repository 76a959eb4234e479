from __future__ import annotations

import pytest
import torch

from jetnormal.networks.patchfit.selection import _farthest_by_batch, every_nth, farthest_points, smallest


@pytest.mark.parametrize("search", [farthest_points, _farthest_by_batch])
def test_farthest_points_equal_a_naive_loop(search):
    points = torch.randn(3, 50, 3, generator=torch.Generator().manual_seed(0))
    kept = search(points, 12)
    for patch, found in zip(points, kept.tolist(), strict=True):
        chosen = [0]
        while len(chosen) < 12:
            gaps = [min((p - patch[j]).norm().item() for j in chosen) for p in patch]
            chosen.append(max(range(50), key=gaps.__getitem__))
        assert found == chosen


def test_every_nth_starts_at_the_query_and_spreads_evenly():
    points = torch.randn(2, 256, 3)
    kept = every_nth(points, 64)
    assert torch.equal(kept, torch.arange(0, 256, 4).expand(2, 64))
    assert every_nth(points[:, :10], 4).tolist() == [[0, 2, 5, 7]] * 2


@pytest.mark.parametrize("search", [farthest_points, _farthest_by_batch])
def test_the_first_of_equally_far_points_is_kept(search):
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [1, 1, 0]]).float()[None]
    assert search(corners, 4).tolist() == [[0, 3, 1, 2]]


def test_points_that_need_a_gradient_or_are_not_contiguous_can_be_sampled():
    points = torch.randn(2, 3, 40).transpose(1, 2).requires_grad_()
    assert torch.equal(farthest_points(points, 8), _farthest_by_batch(points.detach(), 8))


@pytest.mark.parametrize(("n", "k"), [(1, 1), (30, 8), (30, 30), (200, 40)])
def test_the_smallest_come_in_order_and_the_first_of_equals_first(n, k):
    scores = torch.randint(0, 25, (3, 5, n), generator=torch.Generator().manual_seed(n)).float()
    expected = scores.argsort(dim=2, stable=True)[..., :k]
    assert torch.equal(smallest(scores, k), expected)
