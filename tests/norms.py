"""Normalizations as training leaves them."""

from __future__ import annotations

from torch import nn


def with_statistics(module: nn.Module) -> nn.Module:
    """Give every normalization statistics and gains of its own, as training does; evaluation mode."""
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm1d):
            nn.init.uniform_(layer.running_mean, -0.5, 0.5)
            nn.init.uniform_(layer.running_var, 0.5, 2)
            nn.init.uniform_(layer.weight, -1, 2)
            nn.init.uniform_(layer.bias, -0.5, 0.5)
    return module.eval().requires_grad_(False)
