"""Selection of points of a patch: by compiled loops on a CPU, by PyTorch operations on a GPU or for ONNX."""

from __future__ import annotations

import torch
from torch import Tensor


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Sample the farthest points from index 0 on: (B, count) indices of (B, n, 3) points; of equals, the first."""
    points = points.detach().float()
    if not _compiled(points):
        return _farthest_by_batch(points, count)
    from jetnormal.networks.patchfit.kernels import farthest_points  # brings numba along

    kept = torch.zeros((len(points), count), dtype=torch.int64)
    farthest_points(points.contiguous().numpy(), kept.numpy())
    return kept


def every_nth(points: Tensor, count: int) -> Tensor:
    """Return (B, count) indices of (B, n, 3) points at equal steps from index 0 on."""
    steps = torch.arange(count, device=points.device) * points.shape[1] // count
    return steps.expand(points.shape[0], count)


def smallest(scores: Tensor, k: int) -> Tensor:
    """Find the indices (..., k) of the k smallest of each row of (..., n) float32 scores, ascending.

    On a CPU, the first of equals is taken.
    """
    if not _compiled(scores):
        return scores.topk(k, largest=False, sorted=True).indices
    from jetnormal.networks.patchfit.kernels import smallest

    found = torch.empty((*scores.shape[:-1], k), dtype=torch.int64)
    smallest(scores.contiguous().view(-1, scores.shape[-1]).numpy(), found.view(-1, k).numpy())
    return found


def _compiled(tensor: Tensor) -> bool:
    """Whether the loops of `kernels` do the work: on a CPU, but not in a graph that is exported."""
    return tensor.device.type == "cpu" and not torch.onnx.is_in_onnx_export()


def _farthest_by_batch(points: Tensor, count: int) -> Tensor:
    """A few operations on all patches for each point that is kept."""
    planes = points.transpose(1, 2).contiguous()  # (B, 3, n): a sum over rows is several times faster
    kept = [torch.zeros(points.shape[0], dtype=torch.int64, device=points.device)]
    distance = torch.full_like(planes[:, 0], torch.inf)
    while len(kept) < count:
        newest = planes.gather(2, kept[-1][:, None, None].expand(-1, 3, 1))
        distance = torch.minimum(distance, (planes - newest).square_().sum(1))
        kept.append(distance.argmax(1))
    return torch.stack(kept, 1)
