"""The optimizers of a training."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from jetnormal.errors import ResourceError
from jetnormal.training.options import TrainOptions

LEAST_SIDE = 32  # of the matrices that Muon steps; smaller ones have little to orthogonalize


def make_optimizer(network: torch.nn.Module, options: TrainOptions) -> torch.optim.Optimizer:
    """Return the optimizer of the options for the parameters of a network.

    Raises:
        ResourceError: the optimizer is not in this version of PyTorch.
    """
    kind = OPTIMIZERS[options.optimizer]
    return kind(network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay)


class MuonAdamW(torch.optim.Optimizer):
    """Muon for matrices, AdamW for all other parameters, both at one rate.

    Muon (Jordan et al., 2024) makes the momentum of a matrix orthogonal, so that rare directions are learned as fast as
    frequent ones. Its steps are scaled to the size of AdamW's (Liu et al., "Muon is scalable for LLM training", 2025).

    Args:
        parameters: of a network; matrices whose sides are `LEAST_SIDE` long or longer are Muon's.
        lr: learning rate.
        weight_decay: decoupled weight decay.

    Raises:
        ResourceError: PyTorch is older than 2.9.
    """

    def __init__(self, parameters: Any, lr: float, weight_decay: float) -> None:
        if not hasattr(torch.optim, "Muon"):
            raise ResourceError(f"optimizer muon needs PyTorch 2.9 or newer, this is {torch.__version__}; take adamw")
        parameters = list(parameters)
        is_matrix = [value.ndim == 2 and min(value.shape) >= LEAST_SIDE for value in parameters]
        matrices = [value for value, is_one in zip(parameters, is_matrix, strict=True) if is_one]
        others = [value for value, is_one in zip(parameters, is_matrix, strict=True) if not is_one]
        self._parts: list[torch.optim.Optimizer] = []
        if matrices:
            self._parts.append(
                torch.optim.Muon(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
            )
        if others:
            self._parts.append(torch.optim.AdamW(others, lr=lr, weight_decay=weight_decay))
        super().__init__([group for part in self._parts for group in part.param_groups], {})
        self._share()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """See `torch.optim.Optimizer.load_state_dict`."""
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Let both step by the groups and the state of the whole."""
        groups = iter(self.param_groups)
        for part in self._parts:
            part.param_groups = [next(groups) for _ in part.param_groups]
            part.state = self.state

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Take a step of both."""
        for part in self._parts:
            part.step()


OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "muon": MuonAdamW,
    "sgd": partial(torch.optim.SGD, momentum=0.9),
}
