"""Errors for networks whose weights are finite but give no normals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from jetnormal.estimators.base import no_finite_normals


@contextmanager
def usable_weights(name: str) -> Iterator[None]:
    """Raise an error that names the model if a decomposition fails inside the block, as that of NaN does.

    Raises:
        ModelError: one has failed.
    """
    try:
        yield
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise no_finite_normals(name) from error


def check_finite(normals: Tensor, name: str) -> None:
    """Check that any of the (B, 3) normals that a model predicts is finite.

    Raises:
        ModelError: there are normals, and none is finite.
    """
    if len(normals) and not bool(torch.isfinite(normals).all(dim=1).any()):
        raise no_finite_normals(name)
